"""Log of a run for the viewer Rerun."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dudmap.app.pipeline.observer import RunObserver
from dudmap.app.viewing.mesh_feed import MeshChanges, MeshFeed
from dudmap.app.viewing.snapshot import FrameFigures, FrameImages, jpeg
from dudmap.atomic_file import writing
from dudmap.core.geometry.mesh import Mesh
from dudmap.errors import DudmapError, FrameError
from dudmap.extras import extra

if TYPE_CHECKING:
    from dudmap.app.pipeline.frame_source import FrameRead
    from dudmap.core.geometry.camera import Camera
    from dudmap.core.result import FrameResult
    from dudmap.core.slam import Slam

BUDGET_MS = 10.0
"""Milliseconds per frame for extracting changed map parts."""


class RerunLog(RunObserver):
    """Writes camera, images, map, moving objects and metrics into an .rrd file.

    Timelines: ``frame`` (number) and ``time`` (seconds since the first frame). Entities: ``world/camera`` with colour
    and depth, ``world/map``, ``world/movers``, ``world/trajectory``; ``images/mask`` and ``images/residuals``; the
    plots ``plots/ms``, ``plots/residual_mm``, ``plots/moving_percent``; ``lost`` with the reasons.

    Raises:
        DudmapError: No rerun-sdk, or the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        with extra("rerun", "--rerun"):
            import rerun  # pyright: ignore[reportMissingImports]
        self._rr: Any = rerun
        if path.suffix != ".rrd":
            raise DudmapError(f"the log for Rerun is {path.name!r}; expected a name that ends in .rrd")
        with writing(f"the log {path}"):
            path.open("wb").close()
        self._stream = self._rr.RecordingStream("dudmap")
        self._stream.save(path)
        self._stream.log("world", self._rr.ViewCoordinates.RDF, static=True)
        self._slam: Slam | None = None
        self._feed = MeshFeed(BUDGET_MS)
        self._parts: set[str] = set()
        self._start: float | None = None

    def start(self, slam: "Slam", out: Path, count: int | None) -> None:
        """Follow this system; a later pass overwrites frames."""
        self._slam, self._feed = slam, MeshFeed(BUDGET_MS)

    def frame(self, index: int, read: "FrameRead", result: "FrameResult", ms: float) -> None:
        """Log one frame."""
        assert self._slam is not None
        rr, stream = self._rr, self._stream
        figures = FrameFigures.of(result, ms)
        self._start = figures.timestamp if self._start is None else self._start
        stream.set_time("frame", sequence=index)
        stream.set_time("time", duration=figures.timestamp - self._start)
        if not isinstance(read.frame, FrameError):
            self._log_images(FrameImages.of(read.frame, result), self._slam.camera)
        if figures.T_world_camera is None:
            stream.log("lost", rr.TextLog(figures.lost_reason))
        else:
            T = figures.T_world_camera
            stream.log("world/camera", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        boxes = np.array([mover.box for mover in figures.movers]).reshape(-1, 2, 3)
        labels = [f"{mover.id}: {mover.speed:.2f} m/s" for mover in figures.movers]
        stream.log("world/movers", rr.Boxes3D(mins=boxes[:, 0], sizes=boxes[:, 1] - boxes[:, 0], labels=labels))
        stream.log("plots/ms", rr.Scalars(figures.ms))
        stream.log("plots/residual_mm", rr.Scalars(1000 * figures.residual))
        stream.log("plots/moving_percent", rr.Scalars(100 * figures.dynamic_share))
        self._log_map(self._feed.changes(self._slam.live_volume))

    def finish(self, out: Path) -> None:
        """Log the final map and trajectory, and close the file."""
        if self._slam is not None:
            self._log_map(self._feed.changes(self._slam.live_volume, now=True))
        self._stream.flush()
        self._stream.disconnect()

    def _log_images(self, images: FrameImages, camera: "Camera") -> None:
        rr, stream = self._rr, self._stream
        height, width = images.depth.shape
        view = camera.resized(width, height)
        pictures = images.pictures()
        stream.log("world/camera", rr.Pinhole(image_from_camera=view.K, width=width, height=height))
        stream.log("world/camera/color", rr.EncodedImage(contents=jpeg(images.color), media_type="image/jpeg"))
        stream.log("world/camera/depth", rr.DepthImage(images.depth.astype(np.float32), meter=1.0))
        for kind in pictures.keys() & {"mask", "residuals"}:
            stream.log(f"images/{kind}", rr.EncodedImage(contents=jpeg(pictures[kind]), media_type="image/jpeg"))

    def _log_map(self, changes: MeshChanges) -> None:
        assert self._slam is not None
        if changes.reset:
            for part in self._parts:
                self._stream.log(part, self._rr.Clear(recursive=False))
            self._parts.clear()
        for key, mesh in changes.chunks.items():
            part = "world/map/{}_{}_{}".format(*key)
            if mesh is None or len(mesh.faces) == 0:
                self._stream.log(part, self._rr.Clear(recursive=False))
            else:
                self._parts.add(part)
                self._stream.log(part, self._mesh(mesh))
        if changes.chunks:
            path = self._slam.trajectory.Ts_world_camera[:, :3, 3]
            self._stream.log("world/trajectory", self._rr.LineStrips3D([path]))

    def _mesh(self, mesh: Mesh) -> Any:  # noqa: ANN401 - an archetype of rerun
        return self._rr.Mesh3D(
            vertex_positions=mesh.vertices,
            triangle_indices=mesh.faces,
            vertex_normals=mesh.normals,
            vertex_colors=mesh.colors,
        )
