"""A browser page with map, camera, moving objects, images and plots, by viser."""

import io
import threading
from contextlib import redirect_stdout
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dudmap.app.viewing.mesh_feed import MeshChanges
from dudmap.app.viewing.page_access import PageAccess, port_problem
from dudmap.app.viewing.picking import first_hit
from dudmap.app.viewing.snapshot import KINDS, FrameFigures
from dudmap.core.geometry import se3
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.map.incremental_mesh import Chunk
from dudmap.errors import DudmapError
from dudmap.extras import extra
from dudmap.io.exporting.mesh_files import encoded

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from dudmap.core.geometry.camera import Camera

MAX_IMAGES = 300
"""Frames with images on the slider: 20 MB; more are thinned."""
PLOT_POINTS = 500
MOVER_COLORS = ((255, 77, 109), (77, 171, 247), (255, 212, 59), (105, 219, 124), (218, 119, 242), (59, 201, 219))
CHANGE_COLORS = {"appeared": (60, 200, 90), "disappeared": (230, 60, 60)}
PATH_COLOR, CAMERA_COLOR, KEYFRAME_COLOR, MARK_COLOR = (0, 150, 220), (255, 120, 40), (120, 90, 200), (255, 200, 0)
CAMERA_SIZE, KEYFRAME_SIZE, MARK_SIZE = 0.25, 0.08, 0.025
"""Lengths of camera and keyframe pyramids, and radius of a marked point, metres."""
LAYERS = {
    "map": "map", "path": "trajectory", "camera": "camera", "labels": "labels",
    "movers": "moving objects", "keyframes": "keyframes",
}  # fmt: skip
MEASURE = "click on the map for a point, again for a distance"


class Window:
    """The page; thread-safe.

    Args:
        host: 127.0.0.1 for this machine only.
        token: Secret; None generates one unless ``host`` is this machine.

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
        self._chunks: dict[Chunk, Mesh] = {}
        self._frames: list[FrameFigures] = []
        self._images: dict[float, dict[str, bytes]] = {}
        self._shown = -1
        self._marks: list[NDArray[np.float64]] = []
        self._server.gui.set_panel_label(title)
        self._make_controls(title)
        self._server.scene.set_up_direction("-y")
        self._server.scene.on_click()(lambda event: self.mark(event.ray_origin, event.ray_direction))
        self._server.initial_camera.position = (0.0, -0.9, -1.6)
        self._server.initial_camera.look_at = (0.0, 0.0, 1.5)

    def set_camera(self, camera: "Camera") -> None:
        """Set the camera whose frustum is shown."""
        with self._lock:
            self._camera = camera

    def stay(self) -> None:
        """Show single frames, not the latest."""
        self._follow.value = False

    def clear(self) -> None:
        """Remove all frames and the map."""
        with self._lock:
            self.show_mesh(MeshChanges(reset=True))
            self._frames.clear()
            self._images.clear()
            self._marks.clear()
            self._point.content = MEASURE
            self._shown = -1
            for name in [name for name in self._handles if name.split("/")[1] in ("changes", "marks", "keyframes")]:
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
                    self._chunks.pop(key, None)
                    self._remove(_mesh_name(key))
                else:
                    self._chunks[key] = mesh
                    file = encoded(mesh, double_sided=False)  # rooms are viewed from outside
                    self._add(_mesh_name(key), "add_glb", file)

    def add_frames(self, frames: list[FrameFigures], poses: dict[float, NDArray] | None = None) -> None:
        """Append frames; ``poses`` (4, 4) by time replace corrected ones."""
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
        """Show the box of a change, an object of changes.jsonl."""
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
        """Add JPEG files of a frame by ``KINDS``; shown while following the run."""
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

    def show_keyframes(self, Ts_world_camera: NDArray[np.float64]) -> None:
        """Show the poses (N, 4, 4) of the keyframes as pyramids."""
        if self._camera is None or len(Ts_world_camera) == 0:
            return
        with self._lock:
            x, y = self._camera.width / 2 / self._camera.fx, self._camera.height / 2 / self._camera.fy
            rim = [(-x, -y, 1.0), (x, -y, 1.0), (x, y, 1.0), (-x, y, 1.0)]
            sides = [((0.0, 0.0, 0.0), corner) for corner in rim]
            edges = KEYFRAME_SIZE * np.array(sides + list(zip(rim, rim[1:] + rim[:1], strict=True)))
            R, t = Ts_world_camera[:, None, None, :3, :3], Ts_world_camera[:, None, None, :3, 3]
            points = ((R @ edges[..., None])[..., 0] + t).reshape(-1, 2, 3).astype(np.float32)
            self._add("/keyframes", "add_line_segments", points=points, colors=KEYFRAME_COLOR, thickness=0.004)

    def mark(self, origin: "ArrayLike", direction: "ArrayLike") -> None:
        """Mark the map point on a ray; a second gives the distance, a third begins again."""
        with self._lock:
            if not self._layers["map"].value:
                return
            point = first_hit(np.array(origin), np.array(direction), self._chunks.values())
            if point is None:
                return
            self._marks = [self._marks[0], point] if len(self._marks) == 1 else [point]
            text, ends = "x {:.3f}, y {:.3f}, z {:.3f} m".format(*point), np.array([self._marks[0], point])
            if len(self._marks) == 2:
                text += f"; **{np.linalg.norm(ends[1] - ends[0]):.3f} m** from the point before"
            self._point.content = text
            for number, end in enumerate(ends):
                self._add(f"/marks/{number}", "add_icosphere", radius=MARK_SIZE, color=MARK_COLOR, position=end)
            line = ends[None].astype(np.float32)
            self._add("/marks/line", "add_line_segments", points=line, colors=MARK_COLOR, thickness=MARK_SIZE / 3)

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
        self._layers = {layer: gui.add_checkbox(label, initial_value=True) for layer, label in LAYERS.items()}
        for layer in self._layers.values():
            layer.on_update(lambda _: self._switch())
        self._point = gui.add_markdown(MEASURE)
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

    def _switch(self) -> None:
        with self._lock:
            for name, handle in self._handles.items():
                handle.visible = self._is_visible(name)
            self._draw_in_camera()

    def _is_visible(self, name: str) -> bool:
        layer = self._layers.get(name.split("/")[1])
        return layer is None or layer.value

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
        look = {"fov": float(fov), "aspect": width / height, "scale": CAMERA_SIZE, "color": CAMERA_COLOR}
        self._add("/camera", "add_camera_frustum", **look, **place)

    def _draw_in_camera(self) -> None:
        if "/camera" in self._handles:
            kind = "mask" if self._layers["labels"].value else "color"
            self._handles["/camera"].image = self._pictures[kind].image

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
        self._draw_in_camera()

    def _draw_plots(self) -> None:
        step = max(1, len(self._frames) // PLOT_POINTS)
        chosen = self._frames[::step]
        t = np.array([frame.timestamp for frame in chosen]) - self._frames[0].timestamp
        self._time_plot.data = (t, np.array([frame.ms for frame in chosen]))
        residuals = 1000 * np.array([frame.residual for frame in chosen])
        self._residual_plot.visible = bool(np.isfinite(residuals).any())  # a run folder does not hold them
        self._residual_plot.data = (t, np.nan_to_num(residuals))

    def _add(self, name: str, method: str, *content: Any, **values: Any) -> None:  # noqa: ANN401 - arguments of viser
        visible = self._is_visible(name)
        self._handles[name] = getattr(self._server.scene, method)(name, *content, visible=visible, **values)

    def _remove(self, name: str) -> None:
        handle = self._handles.pop(name, None)
        if handle is not None:
            handle.remove()


def _mesh_name(key: Chunk) -> str:
    return "/map/{}_{}_{}".format(*key)


def _series(label: str) -> Any:  # noqa: ANN401 - viser's type of it is known where viser is installed
    return {"label": label, "stroke": "#c2410c", "width": 1.5}
