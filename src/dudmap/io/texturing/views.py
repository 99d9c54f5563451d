"""Images of a run for a texture: static pixels, map exposure, no distortion."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.texturing import draw_triangles
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.lens import Lens, OtherView
from dudmap.core.geometry.mesh import Mesh
from dudmap.errors import DatasetError, FrameError
from dudmap.io.exporting.run_content import RunContent
from dudmap.io.sequences.images import read_mask

if TYPE_CHECKING:
    from dudmap.io.sequences import Sequence as Recording

APART, APART_DEG, SECONDS = 0.05, 3.0, 1.0
"""Motion (metres, degrees) and time to the next view, the sharpest of its frames: a dozen views of a surface 1.5 m
away."""
TRIED = 3
"""Frames read to find the sharpest."""
MOST = 300
"""Most views; one takes a tenth of a second."""
MARGIN = 12 / 640
"""Growth of masks, share of the width: blur, mixed pixels, and 20 ms of walking (1 m/s at 1.5 m)."""
FADE = 24 / 640
"""Distance from masks and depth edges to full weight, share of the width."""
LEAST = 0.02
"""Share of the weight at a depth edge, for thin objects."""
TOLERANCE = 0.03
"""Largest relative difference of depth and mesh: two standard deviations at 4 m (0.8 %), and as much for the map."""
EDGE = 0.05
"""Relative depth difference across an object's edge: surfaces below 85 degrees at a focal length of 525 pixels."""
FARTHEST = 16 / 640
"""Largest shift of an image onto the map, share of the width."""
STRIDE, SMOOTH = 2, 1 / 24
"""Pixels per sample; standard deviation of the exposure's smoothing, share of the width."""
TWIST_TIME = 1 / 30
"""Seconds between the poses that give the velocity."""
BRIGHTEST = 250
"""Brightest value of a channel that is not saturated."""


class View(NamedTuple):
    """A source of colours.

    Attributes:
        T_world_camera: (4, 4) pose of the image.
        image: (h, w, 3) uint8, undistorted, map exposure.
        depth: (h, w) float32, metres, of the mesh; infinite without.
        weights: (h, w) float32, 0 = unused, to 1.
        triangles: (h, w) int32; -1 = none.
    """

    T_world_camera: NDArray[np.float64]
    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    weights: NDArray[np.float32]
    triangles: NDArray[np.int32]


@dataclass(frozen=True)
class Taken:
    """A frame with pose and mask: its number, pose (4, 4) of the depth image, mask file."""

    index: int
    T_world_camera: NDArray[np.float64]
    mask: Path


def groups(run: RunContent, sequence: "Recording", every: int = 1) -> list[list[Taken]]:
    """Frames in groups from nearly the same place, to use one of each.

    Raises:
        DatasetError: The run has no masks, or none of its poses belongs to the recording.
    """
    frames = [Taken(*frame) for frame in run.frames_of(sequence)][::every]
    stamps, out = sequence.timestamps, [frames[:1]]
    factor = 1.0
    while True:
        out = [frames[:1]]
        for frame in frames[1:]:
            first = out[-1][0]
            near = se3.agree(first.T_world_camera, frame.T_world_camera, factor * APART, factor * APART_DEG)
            if near and stamps[frame.index] - stamps[first.index] < factor * SECONDS:
                out[-1].append(frame)
            else:
                out.append([frame])
        if len(out) <= MOST:
            return out
        factor *= 1.3


class Views:
    """Reads views of a mesh.

    Args:
        run: Poses, masks and calibration.
        sequence: The recording of the run.
        mesh: The surface.
        colors: (n, 3) corners and shares (n, 3) to colours (n, 3) of the mesh, for registration.
        level: Whether images take the mesh's exposure.

    Attributes:
        camera: Of all views.

    Raises:
        DatasetError: The run lacks the calibration of a separate colour camera.
    """

    def __init__(
        self, run: RunContent, sequence: "Recording", mesh: Mesh, colors: "Colors | None" = None, *, level: bool = True
    ) -> None:
        self._run, self._sequence, self._mesh, self._level = run, sequence, mesh, level
        self._colors = vertex_colors(mesh) if colors is None else colors
        self._depth_lens = Lens(sequence.camera)
        color = run.color_camera(sequence)  # also checks
        self._color_lens = Lens(color if run.calibration is None else run.calibration.camera)
        registered = sequence.calibration is None
        self._other = None if registered else OtherView(self._depth_lens, self._color_lens)
        self.camera: Camera = self._color_lens.straight
        plane = self.camera.backproject(np.ones(self.camera.shape)).reshape(-1, 3).astype(np.float64)
        self._bent = self._color_lens.project(plane)[0] - self.camera.project(plane)  # by the lens
        one = run.calibration
        self._readouts = (0.0, 0.0) if one is None else (one.depth_readout + one.readout, one.depth_readout)

    def __call__(self, chosen: Sequence[Sequence[Taken]]) -> Iterator[View]:
        """The sharpest view of each group; unreadable frames are omitted."""
        for group in chosen:
            read: list[tuple[float, Taken, Frame]] = []
            for frame in group[:: -(-len(group) // TRIED)]:
                try:
                    images = self._sequence[frame.index]
                except FrameError:
                    continue
                if images.color is not None:
                    read.append((sharpness(images.color), frame, images))
            if read:
                yield self.view(*max(read, key=lambda one: one[0])[1:])

    def view(self, taken: Taken, frame: Frame) -> View:
        """View of a frame."""
        import cv2

        stamp = frame.timestamp if frame.color_timestamp is None else frame.color_timestamp
        T_world_color = self._run.color_pose(stamp)
        triangles, depth = drawn(self._mesh, T_world_color, self.camera)
        known = triangles >= 0
        points = self.camera.backproject(np.where(known, depth, 1)).reshape(-1, 3).astype(np.float64)
        moving = read_mask(taken.mask)
        if moving.shape != frame.depth.shape:
            raise DatasetError(f"the masks of {self._run.folder} do not have the size of the images")
        T_depth_color = se3.inverse(taken.T_world_camera) @ T_world_color
        pixels = self._pixels(points, stamp, self._color_lens.straight, self._readouts[0], self._bent)
        bent, around = pixels, cv2.BORDER_REPLICATE
        image = np.asarray(cv2.remap(frame.rgb, *bent, cv2.INTER_CUBIC, borderMode=around), np.uint8)
        if self._other is not None:
            moving = self._other.mask(moving, frame.depth, se3.inverse(T_depth_color))
            measured, expected = self._other.depth(frame.depth, se3.inverse(T_depth_color)), depth
        else:
            points = points @ T_depth_color[:3, :3].T + T_depth_color[:3, 3]
            measured, expected = frame.depth, points[:, 2].reshape(depth.shape)
            pixels = self._pixels(points, frame.timestamp, self._sequence.camera, self._readouts[1])
        moving = _grown(moving, MARGIN)
        # outside of the image nothing is known
        measured = np.asarray(cv2.remap(measured, *pixels, cv2.INTER_NEAREST, borderValue=0))
        moving = np.asarray(cv2.remap(moving, *pixels, cv2.INTER_NEAREST, borderValue=1)) > 0
        agree = known & (measured > 0) & (np.abs(measured - expected) < TOLERANCE * expected)
        agree = cv2.morphologyEx(agree.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0
        used = agree & known & ~moving
        inner = used & ~_edges(depth)
        distance = np.asarray(cv2.distanceTransform(inner.astype(np.uint8), cv2.DIST_L2, 3))
        weights = np.where(used, np.clip(distance / (FADE * depth.shape[1]), LEAST, 1), 0).astype(np.float32)
        shown = self._mesh_colors(T_world_color, triangles, depth)
        columns, rows = aligned(image, shown, weights)
        bent = bent[0] + columns, bent[1] + rows
        image = np.asarray(cv2.remap(frame.rgb, *bent, cv2.INTER_CUBIC, borderMode=around), np.uint8)
        image = levelled(image, shown, weights) if self._level else image
        return View(T_world_color, image, depth, weights, triangles)

    def _pixels(
        self,
        points: NDArray[np.float64],
        stamp: float,
        camera: Camera,
        readout: float,
        bent: float | NDArray[np.float64] = 0.0,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        lens = Lens(camera)
        uv = lens.project(points)[0] + bent
        if readout:
            times = self._run.trajectory.timestamps
            first, last = np.clip([stamp - TWIST_TIME / 2, stamp + TWIST_TIME / 2], times[0], times[-1]).tolist()
            step = se3.inverse(self._run.trajectory.interpolate(first)) @ self._run.trajectory.interpolate(last)
            twist = se3.log(step) / max(last - first, 1e-9)
            tau = readout * (uv[:, 1:] / camera.height - 0.5)
            uv = lens.project(points - tau * (twist[:3] + np.cross(twist[3:], points)))[0] + bent
        columns, rows = uv.astype(np.float32).reshape(*self.camera.shape, 2).transpose(2, 0, 1).copy()
        return columns, rows

    def _mesh_colors(
        self, T: NDArray[np.float64], triangles: NDArray[np.int32], depth: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        height, width = (STRIDE * (size // STRIDE) for size in depth.shape)
        rows, columns = np.mgrid[STRIDE // 2 : height : STRIDE, STRIDE // 2 : width : STRIDE]
        faces = triangles[rows, columns]
        out = np.full((*faces.shape, 3), np.nan, np.float32)
        seen = faces >= 0
        corners, shares = hit(self._mesh, T, self.camera, rows[seen], columns[seen], faces[seen], depth)
        out[seen] = self._colors(corners, shares)
        return out


Colors = Callable[[NDArray[np.int32], NDArray[np.float64]], NDArray]


def vertex_colors(mesh: Mesh) -> Colors:
    """Colours (n, 3) between corners (n, 3) with shares (n, 3), by vertex colours."""
    return lambda corners, shares: np.einsum("nk,nkc->nc", shares, mesh.colors[corners])


def drawn(
    mesh: Mesh, T_world_camera: NDArray[np.float64], camera: Camera
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Triangle (h, w) at each pixel, -1 = none, and depth (h, w), infinite without."""
    T = se3.inverse(T_world_camera)
    points = mesh.vertices.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    projected = np.empty((len(points), 3), np.float32)
    with np.errstate(invalid="ignore", divide="ignore"):
        projected[:, :2] = np.nan_to_num(camera.project(points), nan=0.0)
    projected[:, 2] = points[:, 2]
    triangles, depth = np.full(camera.shape, -1, np.int32), np.full(camera.shape, np.inf, np.float32)
    draw_triangles(projected, mesh.faces, np.float32(0), triangles, depth)
    return triangles, depth


def hit(
    mesh: Mesh,
    T_world_camera: NDArray[np.float64],
    camera: Camera,
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    faces: NDArray[np.int32],
    depth: NDArray[np.float32],
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Corners (n, 3) of the triangles at pixels (n,), and shares (n, 3)."""
    points = camera.points(columns, rows, depth[rows, columns].astype(np.float64))
    points = points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    corners = mesh.faces[faces]
    a, b, c = (mesh.vertices[corners[:, k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    scale = np.maximum(np.sum(normal**2, axis=1), 1e-30)
    wa, wb = (np.sum(np.cross(e, points - s) * normal, axis=1) / scale for e, s in ((c - b, b), (a - c, c)))
    shares = np.clip(np.stack([wa, wb, 1 - wa - wb], axis=1), 0, 1)
    return corners, shares / shares.sum(axis=1, keepdims=True)


def levelled(
    image: NDArray[np.uint8], expected: NDArray[np.float32], weights: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Image (h, w, 3) in the map's exposure: each channel times a smooth gain, which compensates exposure, white
    balance, vignetting and shine.

    ``expected``: the map's colours at every ``STRIDE``-th pixel.
    """
    import cv2

    size = expected.shape[1::-1]
    used = ((weights > 0) & (image.max(axis=2) < BRIGHTEST)).astype(np.float32)
    share = np.where(np.isfinite(expected[..., 0]), _averaged(used, size), 0).astype(np.float32)
    seen = _averaged(image * used[..., None], size)
    wanted = np.nan_to_num(expected) * share[..., None]
    seen = np.where(share[..., None] > 0, seen, 0).astype(np.float32)
    overall = (wanted.sum(axis=(0, 1)) + 1) / (seen.sum(axis=(0, 1)) + 1)
    sigma = SMOOTH * size[0]
    wide, seen_wide = (np.asarray(cv2.GaussianBlur(part, (0, 0), sigma)) for part in (wanted, seen))
    support = 1.0  # grey values; the gain of the whole image holds far from its used pixels
    gain = (wide + support * overall) / (seen_wide + support)
    gain = np.asarray(cv2.resize(gain.astype(np.float32), image.shape[1::-1], interpolation=cv2.INTER_LINEAR))
    return np.clip(image * gain + 0.5, 0, 255).astype(np.uint8)


def aligned(
    image: NDArray[np.uint8], expected: NDArray[np.float32], weights: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Shift (h, w) of columns and rows of an image (h, w, 3) onto the map's colours; 0 if none is found.

    Compensates pose errors of a pixel or two by the affine motion of largest correlation (Evangelidis and Psarakis
    2008).
    """
    import cv2

    size = expected.shape[1::-1]
    inside = _averaged((weights > LEAST).astype(np.float32), size) > 0.5
    mask = (inside & np.isfinite(expected[..., 0])).astype(np.uint8)
    wanted = np.nan_to_num(expected).mean(axis=2).astype(np.float32)
    given = _averaged(image.mean(axis=2, dtype=np.float32), size)
    W, stop = np.eye(2, 3, dtype=np.float32), (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-4)
    none = np.zeros(image.shape[:2], np.float32)
    try:
        _, W = cv2.findTransformECC(wanted, given, W, cv2.MOTION_AFFINE, stop, mask, 3)
    except cv2.error:  # not enough texture
        return none, none
    v, u = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float32)
    x, y = ((pixels - STRIDE // 2) / STRIDE for pixels in (u, v))  # expected colours are of these pixels
    x, y = (STRIDE * (row[0] * x + row[1] * y + row[2]) + (STRIDE - 1) / 2 for row in W)
    columns, rows = x - u, y - v
    far = max(np.abs(columns).max(), np.abs(rows).max()) > FARTHEST * image.shape[1]
    return (none, none) if far else (columns.astype(np.float32), rows.astype(np.float32))


def _averaged(image: NDArray, size: tuple[int, int]) -> NDArray[np.float32]:
    import cv2

    whole = image[: STRIDE * size[1], : STRIDE * size[0]]
    return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), np.float32)


def sharpness(image: NDArray[np.uint8]) -> float:
    """Mean square of the Laplacian of an image (h, w, 3)."""
    import cv2

    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return float(np.mean(np.asarray(cv2.Laplacian(grey, cv2.CV_32F)) ** 2))


def _grown(mask: NDArray[np.bool_], share: float) -> NDArray[np.uint8]:
    import cv2

    radius = max(1, round(share * mask.shape[1]))
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disk), np.uint8)


def _edges(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    import cv2

    far = np.where(np.isfinite(depth), depth, np.float32(1e6))
    window = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(far, window)) > (1 + EDGE) * np.asarray(cv2.erode(far, window))
