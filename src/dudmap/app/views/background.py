"""Render the background behind dynamic objects: map depth, other frames' colour."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.lens import Lens, OtherView
from dudmap.core.map.volume import TsdfVolume

SAMPLES = 5
"""Frames whose median colour is used; two may show a dynamic object."""
TRIES = 24
"""Frames, nearest first, searched for a pixel."""
TOLERANCE = 0.03
"""Relative difference of depths of one surface: two standard deviations at 4 m (0.8 %), and as much for the map."""
ANGLE_LENGTH = 2.0
"""Length of a rotation by one radian, metres: a room's depth."""
LEAST_PIXELS = 500
"""Fewest pixels for the exposure of a frame."""


@dataclass(frozen=True, eq=False)
class Source:
    """A frame that provides colours.

    Attributes:
        color: (h, w, 3) uint8, of the colour camera.
        depth: (h, w) float32, metres, of the map; 0 at dynamic pixels and differences.
        T_world_color: (4, 4) pose of the colour camera.
        gain: (3,) of its colours over the map's.
    """

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    T_world_color: NDArray[np.float64]
    gain: NDArray[np.float64]


class BackgroundRenderer:
    """Renders the static scene behind dynamic objects in the frames of a recording.

    Args:
        registered: Whether both images' pixels correspond.
    """

    def __init__(
        self, volume: TsdfVolume, depth_camera: Camera, color_camera: Camera, *, registered: bool = True
    ) -> None:
        self.volume = volume
        self.depth_lens, self.color_lens = Lens(depth_camera), Lens(color_camera)
        self.other = None if registered else OtherView(self.depth_lens, self.color_lens)
        self.sources: list[Source] = []

    def in_color(
        self,
        moving: NDArray[np.bool_],
        frame: Frame,
        T_world_camera: NDArray[np.float64],
        T_world_color: NDArray[np.float64],
    ) -> NDArray[np.bool_]:
        """Moving pixels (H, W) of depth, in the colour image (h, w)."""
        if self.other is None:
            return moving
        return self.other.mask(moving, frame.depth, se3.inverse(T_world_color) @ T_world_camera)

    def add(
        self,
        frame: Frame,
        moving: NDArray[np.bool_],
        T_world_camera: NDArray[np.float64],
        T_world_color: NDArray[np.float64],
    ) -> None:
        """Add a source of colours, without moving pixels (h, w)."""
        color, depth = self._map_in_color(T_world_color)
        seen = frame.depth
        if self.other is not None:
            seen = self.other.depth(frame.depth, se3.inverse(T_world_color) @ T_world_camera)
        static = ~moving & (np.abs(seen - depth) < TOLERANCE * depth)
        gain = exposure_gain(frame.rgb, color, static)
        self.sources.append(Source(frame.rgb, np.where(static, depth, 0).astype(np.float32), T_world_color, gain))

    def colors(
        self, frame: Frame, wanted: NDArray[np.bool_], T_world_color: NDArray[np.float64]
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Background colours (h, w, 3) at wanted pixels (h, w), in the frame's exposure, and which are known (h, w)."""
        of_map, distances = self._map_in_color(T_world_color)
        gain = exposure_gain(frame.rgb, of_map, (distances > 0) & ~wanted)
        rows, columns = np.nonzero(wanted & (distances > 0))
        values = of_map[rows, columns] * gain
        found, seen = self._borrowed(rows, columns, distances[rows, columns], T_world_color)
        values[seen] = found[seen] * gain
        color, known = np.zeros_like(frame.rgb), np.zeros_like(wanted)
        color[rows, columns] = np.clip(np.rint(values), 0, 255).astype(np.uint8)
        known[rows, columns] = seen | _inner(distances > 0)[rows, columns]
        return color, known

    def map_depth(self, T_world_camera: NDArray[np.float64]) -> NDArray[np.float32]:
        """Map depth (H, W) in the depth camera, metres, 0 = unknown."""
        rendered = self.volume.raycast(T_world_camera, self.depth_lens.straight).depth
        return self.depth_lens.distorted(rendered, nearest=True)

    def _map_in_color(self, T_world_color: NDArray[np.float64]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        result = self.volume.raycast(T_world_color, self.color_lens.straight)
        return self.color_lens.distorted(result.color), self.color_lens.distorted(result.depth, nearest=True)

    def _borrowed(
        self,
        rows: NDArray[np.intp],
        columns: NDArray[np.intp],
        distances: NDArray[np.float32],
        T_world_color: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Colours of pixels in other frames, map exposure, and which were found."""
        from scipy.ndimage import map_coordinates

        points = self.color_lens.points(rows, columns, distances.astype(np.float64))
        points = points @ T_world_color[:3, :3].T + T_world_color[:3, 3]
        samples = np.full((SAMPLES, len(points), 3), np.nan, np.float32)
        counts = np.zeros(len(points), np.intp)
        for source in self._nearest(T_world_color)[:TRIES]:
            open_ = np.flatnonzero(counts < SAMPLES)
            if len(open_) == 0:
                break
            T = se3.inverse(source.T_world_color)
            uv, z = self.color_lens.project(points[open_] @ T[:3, :3].T + T[:3, 3])
            same = np.abs(_nearest_pixels(source.depth, uv) - z) < TOLERANCE * z
            taken, at = open_[same], uv[same, ::-1].T
            for channel in range(3):
                values = map_coordinates(source.color[..., channel], at, np.float32, order=1, mode="nearest")
                samples[counts[taken], taken, channel] = values / source.gain[channel]
            counts[taken] += 1
        out = np.zeros((len(points), 3))
        for count in range(1, SAMPLES + 1):
            some = counts == count
            out[some] = np.median(samples[:count, some], axis=0)
        return out, counts > 0

    def _nearest(self, T_world_color: NDArray[np.float64]) -> list[Source]:
        def distance(source: Source) -> float:
            T = se3.inverse(T_world_color) @ source.T_world_color
            return float(np.linalg.norm(T[:3, 3])) + ANGLE_LENGTH * se3.rotation_angle(T)

        return sorted(self.sources, key=distance)


def _inner(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    import cv2

    return cv2.erode(seen.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _nearest_pixels(image: NDArray[np.float32], uv: NDArray[np.float32]) -> NDArray[np.float32]:
    u, v = np.rint(uv).astype(np.intp).T
    inside = (u >= 0) & (v >= 0) & (u < image.shape[1]) & (v < image.shape[0])
    return np.where(inside, image[np.where(inside, v, 0), np.where(inside, u, 0)], np.float32(0))


def exposure_gain(
    image: NDArray[np.uint8], rendered: NDArray[np.uint8], used: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Gains (3,) of an image over map colours; 1 with too few pixels. Medians over pixels neither dark nor
    saturated."""
    gains = np.ones(3)
    for channel in range(3):
        a, b = image[..., channel], rendered[..., channel]
        valid = used & (a > 20) & (a < 235) & (b > 20) & (b < 235)
        if np.count_nonzero(valid) >= LEAST_PIXELS:
            gains[channel] = np.median(a[valid].astype(np.float64) / b[valid])
    return gains


def continued(color: NDArray[np.uint8], known: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Fill unknown colours (H, W, 3) smoothly by weighted means (pull-push, Gortler et al. 1996)."""
    if known.all() or not known.any():
        return color
    import cv2

    first: NDArray = np.dstack([color * known[..., None].astype(np.float32), known.astype(np.float32)])
    levels = [first]
    while min(levels[-1].shape[:2]) > 1:
        h, w = levels[-1].shape[:2]
        half = cv2.resize(levels[-1], ((w + 1) // 2, (h + 1) // 2), interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(half))
    filled = levels[-1][..., :3] / np.maximum(levels[-1][..., 3:], 1e-6)
    for level in reversed(levels[:-1]):
        h, w = level.shape[:2]
        coarse = cv2.resize(filled.reshape(*filled.shape[:2], 3), (w, h), interpolation=cv2.INTER_LINEAR)
        share = np.clip(level[..., 3:], 0, 1)
        filled = level[..., :3] + (1 - share) * coarse
    return np.where(known[..., None], color, np.clip(np.rint(filled), 0, 255).astype(np.uint8))
