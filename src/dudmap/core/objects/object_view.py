"""Crop of a frame around a moving object, for the registration and fusion of the object."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.core.dynamics.masks import full_size
from dudmap.core.frames.exposure import exposed_color
from dudmap.core.frames.observation import Level, Observation
from dudmap.core.frames.pyramid import halved
from dudmap.core.objects.object_tracker import Mover

MIN_PIXELS = 60
"""Fewest readings of an object that is registered: ten per degree of freedom of its pose."""
MAX_PIXELS = 16000
"""Most pixels of an object that are registered and fused; a larger view is halved."""
MIN_SIZE = 16 << 3
"""Smallest width and height of the crop, pixels: at most three halvings of it leave an image of at least 16 pixels."""
RIM = 0.05
"""Width of the border of the mask that is left out, as a share of its size: readings at grazing angles are noisy."""


@dataclass(frozen=True, eq=False)
class ObjectView:
    """Object in a frame.

    Attributes:
        levels: Pyramid of the crop around the object, coarse to fine.
        weights: Per level, (h, w) float32, 1 where a pixel shows the object, else 0.
        color: (h, w, 3) uint8, colours of the finest level.
    """

    levels: list[Level]
    weights: list[NDArray[np.float32]]
    color: NDArray[np.uint8]

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Pixels (h, w) of the finest level that show the object."""
        return self.weights[-1] > 0

    @property
    def area(self) -> float:
        """Visible surface across the line of sight, square metres."""
        level = self.levels[-1]
        return float(np.sum(np.square(level.depth[self.mask]))) / (level.camera.fx * level.camera.fy)


def crop_object(
    observation: Observation, mover: Mover, level: Level, exposure: tuple[float, float]
) -> ObjectView | None:
    """Crop of a frame around an object, halved until at most MAX_PIXELS show it; None if the object is too small.

    Args:
        observation: The frame.
        mover: The object.
        level: The image that its mask belongs to.
        exposure: Gain and offset of the frame's intensities.
    """
    import cv2

    if np.count_nonzero(mover.mask) < MIN_PIXELS:
        return None
    stride = observation.camera.width // mover.mask.shape[1]
    rows, columns = np.flatnonzero(mover.mask.any(axis=1)), np.flatnonzero(mover.mask.any(axis=0))
    small_crop = tuple(
        _padded_range(indices, MIN_SIZE // stride, size)
        for indices, size in zip((rows, columns), mover.mask.shape, strict=True)
    )
    crop = tuple(slice(part.start * stride, part.stop * stride) for part in small_crop)
    depth = np.ascontiguousarray(observation.depth[crop])
    mask = full_size(mover.mask[small_crop], level.depth[small_crop], depth).astype(np.uint8)
    margin = max(2, round(RIM * float(np.sqrt(np.count_nonzero(mask)))))
    mask = cv2.erode(mask, np.ones((2 * margin + 1, 2 * margin + 1), np.uint8))
    pixels = int(np.count_nonzero(mask))
    finest = 0
    while pixels >> (2 * finest) > MAX_PIXELS:
        finest += 1
    y, x = crop[0].start, crop[1].start
    full = observation.camera
    camera = replace(full, cx=full.cx - x, cy=full.cy - y, width=crop[1].stop - x, height=crop[0].stop - y)
    gain, offset = np.float32(exposure[0]), np.float32(exposure[1])
    levels, weights = [], []
    for halvings in range(finest + 2, finest - 1, -1):
        if min(camera.width, camera.height) >> halvings < 16:
            continue
        scaled = camera.scaled(halvings)
        cut = np.s_[y >> halvings : (y >> halvings) + scaled.height, x >> halvings : (x >> halvings) + scaled.width]
        depth, intensity = (np.ascontiguousarray(image[cut]) for image in halved(observation, halvings))
        inner = cv2.resize(mask.astype(np.float32), (scaled.width, scaled.height), interpolation=cv2.INTER_AREA) > 0.99
        levels.append(Level(scaled, depth, gain * intensity + offset))
        weights.append((inner & (depth > 0)).astype(np.float32))
    if np.count_nonzero(weights[-1]) < MIN_PIXELS:
        return None
    color = exposed_color(np.ascontiguousarray(observation.rgb[crop]), exposure)
    if finest:
        color = np.asarray(cv2.resize(color, weights[-1].shape[::-1], interpolation=cv2.INTER_AREA), np.uint8)
    return ObjectView(levels, weights, color)


def _padded_range(indices: NDArray[np.int64], shortest: int, size: int) -> slice:
    """Range within 0 to ``size`` of at least ``shortest`` that holds sorted indices and one more at each end."""
    start, stop = int(indices[0]) - 1, int(indices[-1]) + 2
    missing = max(0, shortest - (stop - start))
    start, stop = start - missing // 2, stop + (missing + 1) // 2
    if stop > size:
        start, stop = start - (stop - size), size
    start = max(start, 0)
    return slice(start, min(max(stop, start + shortest), size))
