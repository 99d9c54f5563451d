"""``dudmap demo``: the main job on a built-in recording with exact truth."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dudmap.cli.run import JsonOption, QuietOption, SetOption, free_folder, print_report, read_config
from dudmap.errors import FrameError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from dudmap.frames.frame import Frame
    from dudmap.geometry.camera import Camera
    from dudmap.pipeline.frame_source import Reading
    from dudmap.result import FrameResult

app = typer.Typer(add_completion=False)


@app.command()
def demo(
    out: Annotated[Path | None, typer.Option("--out", help="Run folder; default: runs/demo.")] = None,
    frames: Annotated[int, typer.Option("--frames", min=2, help="Length of the recording.")] = 120,
    assignments: SetOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Make a short recording with a walking person and run on it.

    The room is analytic, the depth has a Kinect's noise, and poses and masks are known exactly. The run folder also
    gets demo.png: colour, depth, mask, residuals and the map without the person, seen from the same pose.
    """
    from dudmap.pipeline.run import run
    from dudmap.synthetic import sequence

    config = read_config(None, None, assignments or [])
    recording = sequence(scene="room", movers=("person",), frames=frames, noise="kinect", seed=0)
    out = out or free_folder(Path("runs") / "demo")
    moment = FullestMoment()
    report = run(recording, config, out, save_masks=True, progress=not quiet, ahead=0, observe=moment.observe)
    moment.save_picture(out, recording.camera)
    print_report(report.metrics, report.out, quiet=quiet, as_json=as_json)


class FullestMoment:
    """The tracked frame in which the largest share of the image truly moves."""

    def __init__(self) -> None:
        self._coverage = -1.0
        self._moment: tuple[Frame, NDArray[np.bool_], FrameResult] | None = None

    def observe(self, index: int, reading: "Reading", result: "FrameResult") -> None:
        """Keep the frame if it is fuller than all before."""
        frame, mask = reading.frame, reading.mask
        if isinstance(frame, FrameError) or isinstance(mask, FrameError) or mask is None or result.state == "lost":
            return
        if mask.mean() > self._coverage:
            self._coverage, self._moment = float(mask.mean()), (frame, mask, result)

    def save_picture(self, out: Path, camera: "Camera") -> None:
        """Write demo.png beside the map that the run left in ``out``."""
        from dudmap.mapping.volume import TsdfVolume
        from dudmap.pipeline.contact_sheet import save_sheet

        if self._moment is None:
            return
        frame, mask, result = self._moment
        assert result.T_world_camera is not None
        view = TsdfVolume.load(out / "map.npz").raycast(result.T_world_camera, camera)
        path = out / "demo.png"
        save_sheet(path, frame, result.dynamic_mask, result.residuals, view, result.T_world_camera, mask)
