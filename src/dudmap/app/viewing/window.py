"""A page in the browser with map, camera, moving objects, images and plots, served by viser."""

import io
import threading
from contextlib import redirect_stdout
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dudmap.app.viewing.mesh_feed import MeshChanges
from dudmap.app.viewing.page_access import PageAccess, port_problem
from dudmap.app.viewing.snapshot import KINDS, FrameFigures
from dudmap.core.geometry import se3
from dudmap.core.map.incremental_mesh import Chunk
from dudmap.errors import DudmapError
from dudmap.extras import extra
from dudmap.io.exporting.mesh_files import encoded

if TYPE_CHECKING:
    from dudmap.core.geometry.camera import Camera

MAX_IMAGES = 300
"""Frames whose images are kept for the time slider: about 20 MB; more are thinned evenly."""
PLOT_POINTS = 500
"""Points of a plot over time."""
MOVER_COLORS = ((255, 77, 109), (77, 171, 247), (255, 212, 59), (105, 219, 124), (218, 119, 242), (59, 201, 219))
CHANGE_COLORS = {"appeared": (60, 200, 90), "disappeared": (230, 60, 60)}
PATH_COLOR, CAMERA_COLOR = (0, 150, 220), (255, 120, 40)


class Window:
    """The page; safe to use from several threads.

    Args:
        host: Address to serve at; 127.0.0.1 for this machine only.
        token: Secret part of the address; None generates one unless ``host`` is this machine only.

    Raises:
        MissingExtraError: viser is not installed.
        DudmapError: The port is in use, or the token is invalid.
    """

    def __init__(self, host: str, port: int, title: str, token: str | None = None) -> None:
        with extra("view", "the page in the browser"):
            import viser  # pyright: ignore[reportMissingImports]
        self.access = PageAccess(host, port, token)
        problem = port_problem(host, port)
        if problem:  # viser would silently take another port
            raise DudmapError(f"cannot show a page at {host}:{port} ({problem}); name another --port or --host")
        self._lock = threading.RLock()
        with redirect_stdout(io.StringIO()):  # viser prints a banner, also when JSON is expected
            self._server = viser.ViserServer(host=host, port=port, verbose=False)
        self.access.guard(self._server)
        self.url = self.access.url
        self._camera: Camera | None = None
        self._handles: dict[str, Any] = {}
        self._chunks: set[Chunk] = set()
        self._frames: list[FrameFigures] = []
        self._images: dict[float, dict[str, bytes]] = {}
        self._shown = -1
        self._server.gui.set_panel_label(title)
        self._make_controls(title)
        self._server.scene.set_up_direction("-y")
        self._server.initial_camera.position = (0.0, -0.9, -1.6)
        self._server.initial_camera.look_at = (0.0, 0.0, 1.5)

    def set_camera(self, camera: "Camera") -> None:
        """Set the camera whose frustum is shown."""
        with self._lock:
            self._camera = camera

    def stay(self) -> None:
        """Show single frames instead of the latest one."""
        self._follow.value = False

    def clear(self) -> None:
        """Remove all frames and the map."""
        with self._lock:
            self.show_mesh(MeshChanges(reset=True))
            self._frames.clear()
            self._images.clear()
            self._shown = -1
            for name in [name for name in self._handles if name.startswith("/changes/")]:
                self._remove(name)

    def show_mesh(self, changes: MeshChanges) -> None:
        """Replace the changed parts of the map."""
        with self._lock:
            if changes.reset:
                for key in self._chunks:
                    self._remove(_mesh_name(key))
                self._chunks.clear()
            for key, mesh in changes.chunks.items():
                if mesh is None or len(mesh.faces) == 0:
                    self._chunks.discard(key)
                    self._remove(_mesh_name(key))
                else:
                    self._chunks.add(key)
                    file = encoded(mesh, double_sided=False)  # rooms are viewed from outside
                    self._add(_mesh_name(key), "add_glb", file)

    def add_frames(self, frames: list[FrameFigures], poses: dict[float, NDArray] | None = None) -> None:
        """Append frames; ``poses`` (4, 4) by time replace poses of earlier frames after a correction."""
        with self._lock:
            self._frames += frames
            if poses is not None:
                self._frames = [
                    replace(frame, T_world_camera=poses.get(frame.timestamp, frame.T_world_camera))
                    for frame in self._frames
                ]
            if not self._frames:
                return
            self._slider.max = max(len(self._frames) - 1, 1)
            self._draw_path()
            self._draw_plots()
            if self._follow.value:
                self.show_frame(len(self._frames) - 1)

    def show_change(self, change: dict[str, Any]) -> None:
        """Show the box of a change since an earlier visit, an object of changes.jsonl."""
        with self._lock:
            low, high = np.array(change["box"])
            name, middle = f"/changes/{change['id']}", (low + high) / 2
            if change["kind"] == "withdrawn":
                self._remove(f"{name}/box")
                self._remove(f"{name}/label")
                return
            color = CHANGE_COLORS[change["kind"]]
            self._add(f"{name}/box", "add_box", color=color, dimensions=high - low, position=middle, wireframe=True)
            self._add(f"{name}/label", "add_label", text=f"{change['id']}: {change['kind']}", position=middle)

    def add_images(self, timestamp: float, files: dict[str, bytes]) -> None:
        """Add JPEG files of a frame by the names of ``KINDS``; shown at once while the page follows the run."""
        with self._lock:
            self._images[timestamp] = files
            if len(self._images) > MAX_IMAGES:
                for stamp in list(self._images)[1:-1:2]:
                    del self._images[stamp]
            if self._follow.value:
                self._draw_images(timestamp)

    def show_frame(self, number: int) -> None:
        """Show camera, moving objects and images of a frame."""
        with self._lock:
            if not 0 <= number < len(self._frames):
                return
            frame = self._frames[number]
            self._shown = number
            if self._slider.value != number:
                self._slider.value = number
            state = f"lost: {frame.lost_reason}" if frame.T_world_camera is None else "tracked"
            self._state.content = (
                f"**{frame.timestamp - self._frames[0].timestamp:.2f} s**, {state}, {frame.ms:.0f} ms, "
                f"{frame.dynamic_share:.0%} of the readings move"
            )
            self._draw_camera(frame)
            self._draw_movers(frame)
            if not self._follow.value and self._images:
                self._draw_images(min(self._images, key=lambda stamp: abs(stamp - frame.timestamp)))

    def stop(self) -> None:
        """End the server."""
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    # -- controls -----------------------------------------------------------------------------------------------------

    def _make_controls(self, title: str) -> None:
        gui = self._server.gui
        gui.configure_theme(control_layout="fixed", control_width="large", show_logo=False, show_share_button=False)
        gui.add_markdown(f"### {title}")
        self._state = gui.add_markdown("waiting for the first frame")
        self._slider = gui.add_slider("frame", min=0, max=1, step=1, initial_value=0)
        self._follow = gui.add_checkbox("follow the run", initial_value=True)
        self._slider.on_update(lambda event: self._slide(event))
        self._follow.on_update(lambda _: self.show_frame(len(self._frames) - 1) if self._follow.value else None)
        empty = np.zeros((48, 64, 3), dtype=np.uint8)
        self._pictures = {kind: gui.add_image(empty, label=kind, format="jpeg") for kind in KINDS}
        nothing, seconds = (np.zeros(1), np.zeros(1)), _series("s")
        self._time_plot = gui.add_uplot(nothing, (seconds, _series("ms per frame")), title="time, ms", height=150)
        self._residual_plot = gui.add_uplot(
            nothing, (seconds, _series("residual")), title="residual at 1 m, mm", height=150
        )

    def _slide(self, event: Any) -> None:  # noqa: ANN401 - an event of viser
        if event.client is None or self._slider.value == self._shown:  # set by the program
            return
        with self._lock:
            self._follow.value = False
            self.show_frame(int(self._slider.value))

    # -- scene --------------------------------------------------------------------------------------------------------

    def _draw_path(self) -> None:
        points = np.array([frame.T_world_camera[:3, 3] for frame in self._frames if frame.T_world_camera is not None])
        if len(points) < 2:
            return
        points = points[np.unique(np.linspace(0, len(points) - 1, 2000).astype(int))]
        segments = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)
        self._add("/path", "add_line_segments", points=segments, colors=PATH_COLOR, thickness=0.008)

    def _draw_camera(self, frame: FrameFigures) -> None:
        if frame.T_world_camera is None or self._camera is None:
            return
        x, y, z, w = se3.rotation_to_quat_xyzw(frame.T_world_camera[:3, :3])
        place = {"wxyz": (w, x, y, z), "position": frame.T_world_camera[:3, 3]}
        if "/camera" in self._handles:
            self._handles["/camera"].wxyz, self._handles["/camera"].position = place["wxyz"], place["position"]
            return
        height, width = self._camera.shape
        fov = 2 * np.arctan(height / 2 / self._camera.fy)
        look = {"fov": float(fov), "aspect": width / height, "scale": 0.15, "color": CAMERA_COLOR}
        self._add("/camera", "add_camera_frustum", **look, **place)

    def _draw_movers(self, frame: FrameFigures) -> None:
        for name in [name for name in self._handles if name.startswith("/movers/")]:
            self._remove(name)
        for mover in frame.movers:
            color, center = MOVER_COLORS[mover.id % len(MOVER_COLORS)], mover.box.mean(axis=0)
            box = {"color": color, "dimensions": mover.box[1] - mover.box[0], "position": center, "wireframe": True}
            self._add(f"/movers/{mover.id}/box", "add_box", **box)
            above = np.array([center[0], mover.box[0, 1], center[2]])
            text = f"{mover.id}: {mover.speed:.2f} m/s"
            self._add(f"/movers/{mover.id}/label", "add_label", text=text, position=above)

    def _draw_images(self, timestamp: float) -> None:
        import cv2

        for kind, data in self._images.get(timestamp, {}).items():
            decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
            self._pictures[kind].image = np.asarray(decoded)[..., ::-1]

    def _draw_plots(self) -> None:
        step = max(1, len(self._frames) // PLOT_POINTS)
        chosen = self._frames[::step]
        t = np.array([frame.timestamp for frame in chosen]) - self._frames[0].timestamp
        self._time_plot.data = (t, np.array([frame.ms for frame in chosen]))
        residuals = 1000 * np.array([frame.residual for frame in chosen])
        self._residual_plot.visible = bool(np.isfinite(residuals).any())  # a run folder does not hold them
        self._residual_plot.data = (t, np.nan_to_num(residuals))

    def _add(self, name: str, method: str, *content: Any, **values: Any) -> None:  # noqa: ANN401 - arguments of viser
        self._handles[name] = getattr(self._server.scene, method)(name, *content, **values)

    def _remove(self, name: str) -> None:
        handle = self._handles.pop(name, None)
        if handle is not None:
            handle.remove()


def _mesh_name(key: Chunk) -> str:
    return "/map/{}_{}_{}".format(*key)


def _series(label: str) -> Any:  # noqa: ANN401 - viser's type of it is known where viser is installed
    return {"label": label, "stroke": "#c2410c", "width": 1.5}
