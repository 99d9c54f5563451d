"""The part of an image that shows a moving body."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.dynamics.masks import full_size
from dudmap.frames.exposure import exposed_color
from dudmap.frames.observation import Level, Observation
from dudmap.frames.pyramid import halved
from dudmap.objects.object_tracker import Mover

FEWEST_PIXELS = 60
"""Pixels at the labels' resolution that a body is looked at from."""
MOST_PIXELS = 16000
"""Pixels of a body that are registered and fused; a larger image of it is halved."""
LEAST = 128
"""Smallest width and height of the part of an image that is looked at, pixels."""
RIM = 0.05
"""Width of the border of a body's image that is left out, as a share of its size: readings at grazing angles."""


@dataclass(frozen=True, eq=False)
class ObjectView:
    """A body in an image: the levels around it, coarse to fine, their weights, and the finest one's colours."""

    levels: list[Level]
    weights: list[NDArray[np.float32]]
    color: NDArray[np.uint8]

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Pixels (h, w) of the finest level that show it."""
        return self.weights[-1] > 0

    @property
    def area(self) -> float:
        """Visible surface across the line of sight, square metres."""
        level = self.levels[-1]
        return float(np.sum(np.square(level.depth[self.mask]))) / (level.camera.fx * level.camera.fy)


def crop_object(
    observation: Observation, mover: Mover, level: Level, exposure: tuple[float, float]
) -> ObjectView | None:
    """The part of the images that shows a body, halved until few enough pixels do; None if it is too small."""
    import cv2

    if np.count_nonzero(mover.mask) < FEWEST_PIXELS:
        return None
    stride = observation.camera.width // mover.mask.shape[1]
    rows, columns = np.flatnonzero(mover.mask.any(axis=1)), np.flatnonzero(mover.mask.any(axis=0))
    low = tuple(
        _around(part, LEAST // stride, size) for part, size in zip((rows, columns), mover.mask.shape, strict=True)
    )
    crop = tuple(slice(part.start * stride, part.stop * stride) for part in low)
    mask = full_size(mover.mask[low], level.depth[low], np.ascontiguousarray(observation.depth[crop])).astype(np.uint8)
    margin = max(2, round(RIM * float(np.sqrt(np.count_nonzero(mask)))))
    mask = cv2.erode(mask, np.ones((2 * margin + 1, 2 * margin + 1), np.uint8))
    pixels = int(np.count_nonzero(mask))
    finest = 0
    while pixels >> (2 * finest) > MOST_PIXELS:
        finest += 1
    y, x = crop[0].start, crop[1].start
    camera = replace(
        observation.camera, cx=observation.camera.cx - x, cy=observation.camera.cy - y,
        width=crop[1].stop - x, height=crop[0].stop - y,
    )  # fmt: skip
    gain, offset = np.float32(exposure[0]), np.float32(exposure[1])
    levels, weights = [], []
    for halvings in range(finest + 2, finest - 1, -1):
        if min(camera.width, camera.height) >> halvings < 16:
            continue
        small = camera.scaled(halvings)
        cut = np.s_[y >> halvings : (y >> halvings) + small.height, x >> halvings : (x >> halvings) + small.width]
        depth, intensity = (np.ascontiguousarray(image[cut]) for image in halved(observation, halvings))
        inner = cv2.resize(mask.astype(np.float32), (small.width, small.height), interpolation=cv2.INTER_AREA) > 0.99
        levels.append(Level(small, depth, gain * intensity + offset))
        weights.append((inner & (depth > 0)).astype(np.float32))
    if np.count_nonzero(weights[-1]) < FEWEST_PIXELS:
        return None
    color = exposed_color(np.ascontiguousarray(observation.rgb[crop]), exposure)
    if finest:
        color = np.asarray(cv2.resize(color, weights[-1].shape[::-1], interpolation=cv2.INTER_AREA), np.uint8)
    return ObjectView(levels, weights, color)


def _around(inside: NDArray[np.int64], least: int, size: int) -> slice:
    """Range of at least ``least`` numbers below ``size`` that holds these and one more at each end."""
    start, stop = int(inside[0]) - 1, int(inside[-1]) + 2
    missing = max(0, least - (stop - start))
    start, stop = start - missing // 2, stop + (missing + 1) // 2
    if stop > size:
        start, stop = start - (stop - size), size
    start = max(start, 0)
    return slice(start, min(max(stop, start + least), size))
