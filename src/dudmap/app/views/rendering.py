"""Artificial views (thesis section 4.5) along a trajectory, as picture, video or recording."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dudmap.app.viewing.snapshot import shading
from dudmap.atomic_file import atomic_path, write_image, write_text
from dudmap.core.frames.frame import GREY
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import ConfigError, DatasetError, MapError, printable
from dudmap.io.exporting.mesh_editing import without_small_pieces
from dudmap.io.exporting.run_content import RunContent

CODECS = {".mp4": "vp09", ".avi": "XVID"}
"""Codec by suffix: VP9 for browsers (0.1 s per frame), MPEG-4 for desktop players (3 ms)."""
PICTURE = ".png"
"""Suffix of a single picture."""
SIZE = (1280, 720)
"""Width and height of views of the whole map, pixels."""
NEAREST, EDGE, BEYOND = 0.3, 0.04, 0.005
"""Distance of an orbit's camera from the map (metres), picture margin (share of half the size), and share of the
surface beyond each side."""
SAMPLES = 20_000
"""Points of the surface: 100 beyond each side."""
EMPTY = 32


class TumFolder:
    """Writes PNG files and a list with a title per kind of image."""

    def __init__(self, out: Path, title: str, kinds: Iterable[str]) -> None:
        self._out, self._title = out, title
        self._lines: dict[str, list[str]] = {kind: [] for kind in kinds}
        for kind in self._lines:
            (out / kind).mkdir(parents=True, exist_ok=True)

    def add(self, kind: str, timestamp: float, image: NDArray) -> str:
        """Write an image, (H, W, 3) uint8 RGB, (H, W) uint16 or bool; return its line of the list."""
        line = f"{timestamp:.6f} {kind}/{timestamp:.6f}.png"
        write_image(self._out / line.split()[1], image, sync=False)
        self._lines[kind].append(line)
        return line

    def finish(self, camera: Camera, associations: Iterable[str] = (), more: Iterable[str] = ()) -> None:
        """Write lists and intrinsics.txt: the depth camera, then ``more`` lines."""
        lists = self._lines | ({"associations": list(associations)} if associations else {})
        for name, lines in lists.items():
            write_text(self._out / f"{name}.txt", "\n".join([f"# {self._title}", *lines]) + "\n")
        numbers = [*camera_lines(camera), f"depth_scale {camera.depth_scale}", *more]
        write_text(self._out / "intrinsics.txt", "\n".join(numbers) + "\n")


def camera_lines(camera: Camera) -> list[str]:
    """Lines of intrinsics.txt for a camera."""
    lines = [f"{key} {getattr(camera, key)}" for key in ("fx", "fy", "cx", "cy", "width", "height")]
    lens = zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion, strict=False)
    return [*lines, *(f"{key} {value}" for key, value in lens)]


def depth_units(depth: NDArray[np.float32], camera: Camera) -> NDArray[np.uint16]:
    """Depth in a camera's units; 0 beyond 16 bits."""
    units = np.rint(depth * camera.depth_scale)
    return np.where(units > 65535, 0, units).astype(np.uint16)


@contextmanager
def video_file(path: Path, size: tuple[int, int], fps: float) -> Iterator[Callable[[NDArray[np.uint8]], None]]:
    """Write a video (width, height); yield a function that adds an RGB image (H, W, 3).

    Raises:
        ConfigError: An unknown suffix, or OpenCV cannot write it.
    """
    codec = CODECS.get(path.suffix.lower())
    if codec is None:
        known = ", ".join(CODECS)
        raise ConfigError(f"cannot write {path.name!r}; the ending must be one of {known}, or .png for a picture")
    if str(path) != printable(path):  # OpenCV ends the process at a name that is no UTF-8
        raise ConfigError(f"cannot write a video as {path}; expected a name of printable characters")
    with atomic_path(path) as temporary:
        writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter.fourcc(*codec), fps, size)
        if not writer.isOpened():
            raise ConfigError(f"this build of OpenCV cannot write {path} (codec {codec}); name a folder for images")
        try:

            def write(color: NDArray[np.uint8]) -> None:
                writer.write(np.ascontiguousarray(color[..., ::-1]))

            yield write
        finally:
            writer.release()


def orbit(
    run: RunContent, up: NDArray[np.float64], sweep_deg: float, frames: int, fps: float, camera: Camera
) -> Trajectory:
    """Trajectory on an arc around the mesh, 27 degrees above, that keeps 98 % of the surface visible.

    Centred on the recording cameras' side; spans ``sweep_deg``, there and back; 360 gives a circle. ``up`` (3,): unit
    vector against gravity.
    """
    large = without_small_pieces(run.surface)
    points = _spread(large if len(large.faces) else run.surface)
    if len(points) == 0:
        raise MapError(f"the mesh of {run.folder} is empty: there is nothing to render")
    Ts = run.trajectory.Ts_world_camera
    arm = Ts[:, :3, 3].mean(axis=0) - np.median(points, axis=0)
    choices = [arm, -Ts[:, :3, 2].mean(axis=0), Ts[:, :3, 1].mean(axis=0)]
    level = [choice - (choice @ up) * up for choice in choices]
    # a recording camera is behind its mean view direction; one that looks straight up or down, below its image
    first = next((one for one, least in zip(level, (0.5, 0.1, 0.0), strict=True) if np.linalg.norm(one) > least), up)
    first /= np.linalg.norm(first)
    share = np.arange(frames) / frames
    angles = 2 * np.pi * share if sweep_deg >= 360 else np.radians(sweep_deg) / 2 * np.sin(2 * np.pi * share)
    poses, distances = [], []
    for angle in angles:
        T, distance = _framing(
            points, np.cos(angle) * first + np.sin(angle) * np.cross(up, first) + 0.5 * up, up, camera
        )
        poses.append(T)
        distances.append(distance)
    for T, distance in zip(poses, distances, strict=True):
        T[:3, 3] -= (max(distances) - distance) * T[:3, 2]
    return Trajectory(np.arange(frames) / fps, np.array(poses))


def _spread(mesh: Mesh) -> NDArray[np.float64]:
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    area = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    if len(area) == 0 or area[-1] == 0:
        return mesh.vertices.astype(np.float64)
    chosen = np.searchsorted(area, (np.arange(SAMPLES) + 0.5) / SAMPLES * area[-1])
    return (a[chosen] + b[chosen] + c[chosen]) / 3


def _framing(
    points: NDArray[np.float64], back: NDArray[np.float64], up: NDArray[np.float64], camera: Camera
) -> tuple[NDArray[np.float64], float]:
    """Pose of a camera that looks against ``back`` and just sees 98 % of the points, ``BEYOND`` of them beyond each
    side, and its distance."""
    forward = -back / np.linalg.norm(back)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    T = np.eye(4)
    T[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    x = points @ T[:3, :3]
    place = np.array([0.0, 0.0, np.quantile(x[:, 2], BEYOND) - NEAREST])
    for axis, tangent in enumerate((camera.width / 2 / camera.fx, camera.height / 2 / camera.fy)):
        reach = tangent * (1 - EDGE)
        low, high = (np.quantile(x[:, 2] + sign * x[:, axis] / reach, BEYOND) for sign in (1, -1))
        place[axis] = reach * (low - high) / 2
        place[2] = min(place[2], (low + high) / 2)
    T[:3, 3] = T[:3, :3] @ place
    return T, -float(place[2])


def render_run(
    run: RunContent,
    trajectory: Trajectory,
    out: Path,
    *,
    camera: Camera | None = None,
    fps: float = 30.0,
    progress: Callable[[int, int], None] | None = None,
    whole: bool = False,
) -> int:
    """Render the map along a trajectory; return the frames' number.

    ``out``: .png a picture from the first pose, another known suffix a video, none a recording in TUM layout: rgb/,
    depth/, lists, intrinsics.txt, groundtruth.txt.

    Args:
        whole: Render to the far end of the map, beyond the run's depth range.

    Raises:
        ConfigError: The suffix is unknown.
        DatasetError: The folder is not empty.
        MapError: There is no map.
        OSError: A file cannot be written.
    """
    camera = camera or run.volume.camera
    if whole:
        run.volume.extend_range(_farthest(run, trajectory))
    if out.suffix.lower() == PICTURE and not out.is_dir():
        color, _ = _view(run, trajectory.Ts_world_camera[0], camera)
        write_image(out, color)
        return 1
    if out.suffix and not out.is_dir():
        with video_file(out, (camera.width, camera.height), fps) as add, ThreadPoolExecutor(1) as encoder:
            added = None
            for number, T in enumerate(trajectory.Ts_world_camera, start=1):
                color = _view(run, T, camera)[0]
                if added is not None:
                    added.result()
                added = encoder.submit(add, color)
                if progress is not None:
                    progress(number, len(trajectory))
            if added is not None:
                added.result()
        return len(trajectory)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DatasetError(
            f"{out} exists and is not an empty folder; name another one, a video ({', '.join(CODECS)}) "
            f"or a picture ({PICTURE})"
        )
    folder = TumFolder(out, f"views of {run.folder.name}", ("rgb", "depth"))
    for number, (stamp, T) in enumerate(zip(trajectory.timestamps, trajectory.Ts_world_camera, strict=True), start=1):
        color, depth = _view(run, T, camera)
        folder.add("rgb", stamp, color)
        folder.add("depth", stamp, depth_units(depth, camera))
        if progress is not None:
            progress(number, len(trajectory))
    folder.finish(camera)
    trajectory.save(out / "groundtruth.txt")
    return len(trajectory)


def wide_camera(camera: Camera, size: tuple[int, int]) -> Camera:
    """Camera with square pixels and another's vertical field of view, for images (width, height)."""
    (width, height), focal = size, camera.fy * size[1] / camera.height
    return Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height, depth_scale=camera.depth_scale)


def _farthest(run: RunContent, trajectory: Trajectory) -> float:
    points = run.surface.vertices.astype(np.float64)
    return max(float(((points - T[:3, 3]) @ T[:3, 2]).max()) for T in trajectory.Ts_world_camera)


def _view(run: RunContent, T: NDArray[np.float64], camera: Camera) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    seen = run.volume.raycast(T, camera)
    color, known = seen.color, seen.depth > 0
    if known.any() and np.median(color[known].reshape(-1, 3), axis=0).tolist() == [GREY] * 3:
        color = (255 * shading(seen.normals, T)[..., None]).astype(np.uint8).repeat(3, axis=2)
    return np.where(known[..., None], color, np.uint8(EMPTY)), seen.depth
