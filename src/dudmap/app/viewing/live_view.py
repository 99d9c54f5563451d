"""Fill the browser page from a running run, or a run folder."""

import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dudmap.app.pipeline.observer import RunObserver
from dudmap.app.viewing.mesh_feed import MeshChanges, MeshFeed
from dudmap.app.viewing.run_files import RunFiles
from dudmap.app.viewing.snapshot import FrameFigures, FrameImages
from dudmap.app.viewing.window import Window
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.mesh_simplification import simplified
from dudmap.errors import DudmapError, FrameError
from dudmap.input_files import damaged

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from dudmap.app.pipeline.frame_source import FrameRead
    from dudmap.core.result import FrameResult
    from dudmap.core.slam import Slam

PERIOD = 0.1
"""Seconds between updates of the page."""
TRIANGLES = 1_000_000
"""Triangles sent to the browser: 40 MB."""


@dataclass
class _Update:
    figures: list[FrameFigures] = field(default_factory=list)
    images: FrameImages | None = None
    poses: "dict[float, NDArray] | None" = None
    changes: list[dict[str, Any]] = field(default_factory=list)
    restart: bool = False


class LiveView(RunObserver):
    """Shows a running run in a window.

    A slot passes the latest data to another thread, so that the run never waits. A later image replaces an earlier one
    that is still in the slot, so that the run never waits for the page.
    """

    def __init__(self, window: Window) -> None:
        self.costs: list[float] = []
        self._window = window
        self._update = _Update()
        self._changed = threading.Condition()
        self._closed = False
        self._error: Exception | None = None
        self._slam: Slam | None = None
        self._feed = MeshFeed()
        self._thread = threading.Thread(target=self._show, name="dudmap-view", daemon=True)
        self._thread.start()

    def start(self, slam: "Slam", out: Path, count: int | None) -> None:
        """Begin with an empty page."""
        self._slam = slam
        none = np.zeros(0, dtype=np.int32)
        slam.live_volume.extract_chunks(none, none.astype(np.int64))  # loads the kernel, which would delay a frame
        self._window.set_camera(slam.camera)
        with self._changed:
            self._update = _Update(restart=True)

    def frame(self, index: int, read: "FrameRead", result: "FrameResult", ms: float) -> None:
        """Put a frame into the slot."""
        start = time.perf_counter()
        assert self._slam is not None
        images = None if isinstance(read.frame, FrameError) else FrameImages.of(read.frame, result)
        self._feed.offer(self._slam.live_volume)
        figures = FrameFigures.of(result, ms)
        with self._changed:
            self._update.figures.append(figures)
            self._update.images = images or self._update.images
            if "corrected" in result.events:
                self._update.poses = self._poses()
            self._changed.notify()
        self.costs.append(1000 * (time.perf_counter() - start))

    def event(self, name: str, **values: Any) -> None:  # noqa: ANN401 - any JSON value
        """Show a change since an earlier visit."""
        if name == "change":
            with self._changed:
                self._update.changes.append(values)
                self._changed.notify()

    def finish(self, out: Path) -> None:
        """Show the final trajectory and mesh."""
        if self._slam is not None and self._error is None:
            self._feed.offer(self._slam.live_volume, now=True)
            with self._changed:
                self._update.poses = self._poses()
                self._changed.notify()

    def close(self) -> None:
        """End the thread once all is shown.

        Raises:
            Exception: Error of the page's thread.
        """
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()
        if self._error is not None:
            raise self._error

    def _poses(self) -> "dict[float, NDArray]":
        assert self._slam is not None
        path = self._slam.trajectory
        return dict(zip(path.timestamps.tolist(), path.Ts_world_camera, strict=True))

    def _take(self) -> _Update | None:
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._has_update())
            if not self._has_update():
                return None
            update, self._update = self._update, _Update()
            return update

    def _has_update(self) -> bool:
        return bool(
            self._update.figures
            or self._update.restart
            or self._update.poses
            or self._update.changes
            or self._feed.has_copy
        )

    def _show(self) -> None:
        try:
            while (update := self._take()) is not None:
                if update.restart:
                    self._window.clear()
                self._window.show_mesh(self._feed.take())
                self._window.add_frames(update.figures, update.poses)
                for change in update.changes:
                    self._window.show_change(change)
                if update.images is not None and update.figures:
                    self._window.add_images(update.figures[-1].timestamp, update.images.files())
                time.sleep(PERIOD)
        except Exception as error:  # close raises it in the thread of the run
            self._error = error


def open_run(folder: str | Path, host: str, port: int, token: str | None = None) -> Window:
    """Open a window with a run folder.

    Raises:
        DudmapError: No complete run folder, no viser, or the port is in use.
    """
    run = RunFiles.load(folder)
    window = Window(host, port, str(run.metrics.get("sequence") or run.folder.name), token)
    try:
        show_run(window, run)
    except DudmapError:
        window.stop()
        raise
    return window


def show_run(window: Window, run: RunFiles) -> None:
    """Fill a window with the results of a run."""
    if "camera" in run.metrics:
        with damaged(DudmapError, run.folder / "metrics.json"):
            values = run.metrics["camera"]
            window.set_camera(Camera(**values | {"distortion": tuple(values.get("distortion", ()))}))
    if run.mesh is not None:
        window.show_mesh(MeshChanges({(0, 0, 0): simplified(run.mesh, TRIANGLES)}))
    window.stay()
    window.show_keyframes(run.keyframes)
    window.add_frames(run.figures())
    for stamp, images in run.thumbnails.items():
        window.add_images(float(stamp), images)
    window.show_frame(0)
