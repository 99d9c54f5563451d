"""``dudmap demo``: a run on a built-in synthetic recording."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

from dudmap.app.pipeline.observer import RunObserver
from dudmap.app.terminal import show_log
from dudmap.cli import options as o
from dudmap.cli.output import free_folder, print_report
from dudmap.cli.view import observers
from dudmap.errors import FrameError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from dudmap.app.pipeline.frame_source import FrameRead
    from dudmap.core.frames.frame import Frame
    from dudmap.core.result import FrameResult
    from dudmap.core.slam import Slam


def demo(
    watching: o.WatchingOptions,
    out: Annotated[Path | None, Option(help="Run folder; default: runs/demo.")] = None,
    max_frames: o.FramesOption = 120,
    assignments: o.SetOption = None,
    quiet: o.QuietOption = False,
    as_json: o.JsonOption = False,
) -> None:
    """Render a short recording with a walking person and run on it.

    The depth has the noise of a Kinect; poses and masks are known exactly. The run folder also receives demo.png:
    colour, depth, mask, residuals and the map without the person, rendered from the same pose. Its folder
    images/ holds frames for a texture (dudmap export --texture).
    """
    from dudmap.app.pipeline.image_keeper import ImageKeeper
    from dudmap.app.pipeline.run import run
    from dudmap.lab.synthetic import sequence
    from dudmap.lab.warmup import compiled_for_demo

    show_log(quiet=quiet, verbose=watching.verbose)
    config = o.read_config(None, None, assignments)
    recording = sequence(scene="room", movers=("person",), frames=max_frames, noise="kinect", seed=0)
    out = out or free_folder(Path("runs") / "demo")
    keeper = MostDynamicFrame()
    with observers(watching) as watchers, compiled_for_demo():
        done = run(
            recording, config, out, save_masks=True, progress=not quiet, ahead=0,
            observers=(*watchers, keeper, ImageKeeper(recording)),
        )  # fmt: skip
        print_report(done.metrics, done.out, quiet=quiet, as_json=as_json)


class MostDynamicFrame(RunObserver):
    """Observer that keeps the tracked frame with the largest true dynamic mask, and writes demo.png at the end."""

    def __init__(self) -> None:
        self._coverage = -1.0
        self._kept: tuple[Frame, NDArray[np.bool_], FrameResult] | None = None
        self._slam: Slam | None = None

    def start(self, slam: "Slam", out: Path, count: int | None) -> None:
        """Keep the system, whose map is rendered."""
        self._slam = slam

    def frame(self, index: int, read: "FrameRead", result: "FrameResult", ms: float) -> None:
        """Keep the frame if its dynamic share is the largest so far."""
        frame, mask = read.frame, read.true_mask
        if (
            isinstance(frame, FrameError)
            or isinstance(mask, FrameError)
            or mask is None
            or result.T_world_camera is None
        ):
            return
        if mask.mean() > self._coverage:
            self._coverage, self._kept = float(mask.mean()), (frame, mask, result)

    def finish(self, out: Path) -> None:
        """Write demo.png into the run folder ``out``."""
        from dudmap.app.viewing.snapshot import save_sheet

        if self._kept is None or self._slam is None:
            return
        frame, mask, result = self._kept
        assert result.T_world_camera is not None
        view = self._slam.volume.raycast(result.T_world_camera, self._slam.camera)
        path = out / "demo.png"
        save_sheet(path, frame, result.dynamic_mask, result.residuals, view, result.T_world_camera, mask)
