"""An image in the sizes that the work on its frame asks for."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.frames.observation import Level, Observation
from dudmap.frames.optical_flow import corners, grey
from dudmap.geometry.camera import Camera
from dudmap.kernels import filtering

HALVING_BAND = 0.02
"""Readings this far (m, and share of the depth) behind the nearest of a 2x2 block belong to the same surface."""


@dataclass(frozen=True, eq=False)
class Pyramid:
    """Levels of an image, each made by halvings of the camera's.

    Attributes:
        tracked: Those that are registered, coarse to fine.
        labelled: That at which is decided what moves.
    """

    tracked: list[Level]
    labelled: Level

    @classmethod
    def of(cls, observation: Observation, camera: Camera, config: Config) -> "Pyramid":
        """The levels whose widths are nearest to those configured."""
        widths = *config.tracker.widths, config.dynamics.width
        halvings = [max(0, round(np.log2(camera.width / width))) for width in widths]
        levels = {n: Level(camera.scaled(n), *halved(observation, n)) for n in sorted(set(halvings))}
        *tracked, labelled = (levels[n] for n in halvings)
        return cls(tracked, labelled)

    @property
    def coarse(self) -> Level:
        """The first level that is registered."""
        return self.tracked[0]

    @property
    def fine(self) -> Level:
        """The last level that is registered."""
        return self.tracked[-1]

    @cached_property
    def grey(self) -> NDArray[np.uint8]:
        """Intensities (h, w) of the finest level, of 255."""
        return grey(self.fine)

    @cached_property
    def corners(self) -> NDArray[np.int64]:
        """Corners (n, 2) int of the finest level, pixels u, v."""
        return corners(self.fine, self.grey)


def reduced(mask: NDArray[np.bool_], level: Level) -> NDArray[np.bool_]:
    """Mask (H, W) at the size of a level: pixels any part of which lies in it."""
    import cv2

    size = level.depth.shape[::-1]
    return np.asarray(cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)) > 0


def is_majority_dynamic(moving: NDArray[np.bool_], level: Level) -> bool:
    """Whether more than half of the readings of an image move (h, w)."""
    return bool(2 * np.count_nonzero(moving) > np.count_nonzero(level.depth))


def halved(observation: Observation, level: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth and intensity (H >> level, W >> level) of ``camera.scaled(level)``: ``level`` halvings by 2x2 blocks.

    Intensity is the mean of a block; depth the mean of its readings on the nearest surface. Each halving is computed
    once per observation.
    """
    halvings = observation._halvings
    while len(halvings) < level:
        depth, intensity = halvings[-1] if halvings else (observation.depth, observation.intensity)
        halvings.append(_halved(depth, intensity))
    return halvings[level - 1] if level else (observation.depth, observation.intensity)


def _halved(
    depth: NDArray[np.float32], intensity: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    shape = (depth.shape[0] // 2, depth.shape[1] // 2)
    small = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
    filtering.halve_depth(0, shape[0], depth, np.float32(HALVING_BAND), small[0])
    filtering.halve_intensity(0, shape[0], intensity, small[1])
    return small
