"""``dudmap clean``: a recording as it would have been without what moves."""

from pathlib import Path
from typing import Annotated

import typer

from dudmap.app.terminal import counted
from dudmap.cli import options as o
from dudmap.cli.output import answer
from dudmap.errors import DatasetError

app = typer.Typer(add_completion=False)


@app.command()
def clean(
    sequence: o.RecordingArgument,
    out: Annotated[Path, typer.Argument(help="New folder for the recording without what moves, in TUM layout.")],
    run: Annotated[
        Path | None, typer.Option(help="Run over this recording with --save-masks; by default one is made in OUT/run.")
    ] = None,
    config: o.ConfigOption = None,
    assignments: o.SetOption = None,
    preset: o.PresetOption = None,
    camera: o.CameraOption = None,
    fps: o.FpsOption = None,
    depth_unit: o.DepthUnitOption = None,
    color: o.ColorOption = None,
    depth: o.DepthOption = None,
    passes: Annotated[int, typer.Option(min=1, max=2, help="Passes of the run that is made; 2 finds more.")] = 2,
    max_frames: o.MaxFramesOption = None,
    quiet: o.QuietOption = False,
    as_json: o.JsonOption = False,
) -> None:
    """Replace what moves in every frame of a recording by the map and by what other frames show there."""
    from dataclasses import asdict

    from dudmap.app.pipeline.run import run as run_sequence
    from dudmap.app.views.cleaning import clean_recording
    from dudmap.io.exporting.run_content import RunContent
    from dudmap.io.sequences import open_sequence

    recording = open_sequence(sequence, camera, fps, depth_unit, color=color, depth=depth)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DatasetError(f"{out} exists and is not an empty folder; name another one")
    if run is None:
        parameters = o.read_config(config, preset, assignments)
        run_sequence(
            recording, parameters, out / "run",
            max_frames=max_frames, save_masks=True, passes=passes, progress=not (quiet or as_json), calibrate=True,
        )  # fmt: skip
    with counted("cleaning", quiet=quiet or as_json) as progress:
        report = clean_recording(RunContent.load(run or out / "run"), recording, out, progress, max_frames)
    text = (
        f"{report.frames} frames written to {out}: {report.replaced:.1%} of the pixels replaced, of which "
        f"{report.unknown / max(report.replaced, 1e-9):.1%} were never seen; {len(report.left_out)} frames without "
        "a pose left out"
    )
    answer(asdict(report), text, as_json=as_json, quiet=quiet)
