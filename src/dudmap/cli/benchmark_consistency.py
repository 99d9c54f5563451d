"""``dudmap benchmark consistency``: which trajectory explains the images of a recording better."""

from pathlib import Path
from typing import Annotated

import typer

from dudmap.cli import options as o
from dudmap.cli.output import answer


def consistency(
    recording: Annotated[Path, typer.Argument(help="Recording.")],
    trajectories: Annotated[
        list[Path] | None, typer.Argument(help="Trajectories of it in TUM text, or folders of runs.")
    ] = None,
    max_frames: Annotated[int | None, typer.Option(min=2, help="Number of frames from the start.")] = None,
    as_json: o.JsonOption = False,
) -> None:
    """Compare how well trajectories, and the published poses, explain a recording's own depth and intensities."""
    from dudmap.core.geometry.trajectory import Trajectory
    from dudmap.errors import DatasetError
    from dudmap.io.sequences import open_sequence
    from dudmap.lab.benchmark.consistency import measure_consistency

    source = open_sequence(recording)
    truth = {} if source.ground_truth is None else {"published": source.ground_truth}
    files = [path / "trajectory.txt" if path.is_dir() else path for path in trajectories or []]
    found = truth | {str(path): Trajectory.load(path) for path in files}
    if not found:
        raise DatasetError(f"{recording} comes without poses; name the trajectories to compare, such as a run's folder")
    result = measure_consistency(source, found, max_frames=max_frames)
    low, high = result.intervals()
    answer(result._asdict() | {"means": result.means(), "low": low, "high": high}, result.table(), as_json=as_json)
