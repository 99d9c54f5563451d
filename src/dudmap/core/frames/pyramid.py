"""Image pyramid of an observation."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.backends.cpu.filtering import halve
from dudmap.core.frames.observation import Level, Observation
from dudmap.core.frames.optical_flow import corners, grey
from dudmap.core.geometry.camera import Camera

HALVING_BAND = 0.02
"""Readings this far (m, and share of the depth) behind the nearest of a 2x2 block belong to the same surface."""


@dataclass(frozen=True, eq=False)
class Pyramid:
    """Image pyramid of an observation, each level the camera's image halved several times: those of the registration,
    coarse to fine, and that of the dynamic labels."""

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
        """Coarsest level of the registration."""
        return self.tracked[0]

    @property
    def fine(self) -> Level:
        """Finest level of the registration."""
        return self.tracked[-1]

    @cached_property
    def grey(self) -> NDArray[np.uint8]:
        """Intensities (h, w) of the finest level, 0..255."""
        return grey(self.fine)

    @cached_property
    def corners(self) -> NDArray[np.int64]:
        """Corners (n, 2) int of the finest level, pixels u, v."""
        return corners(self.fine, self.grey)

    @cached_property
    def corner_points(self) -> NDArray[np.float64]:
        """Points (n, 3) at the corners, metres, camera frame."""
        (u, v), level = self.corners.T, self.fine
        return level.camera.points(u, v, level.depth[v, u].astype(np.float64))


def reduced(mask: NDArray[np.bool_], level: Level) -> NDArray[np.bool_]:
    """Mask (H, W) at the size of a level: a pixel is set if any part of it lies in the mask."""
    import cv2

    size = level.depth.shape[::-1]
    return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0


def is_majority_dynamic(moving: NDArray[np.bool_], level: Level) -> bool:
    """Whether more than half of the readings of a level are marked as moving (h, w) bool."""
    return bool(2 * np.count_nonzero(moving) > level.num_readings)


def halved(observation: Observation, level: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth and intensity (H >> level, W >> level) of ``camera.scaled(level)``: ``level`` halvings by 2x2 blocks.

    Intensity is the mean of a block; depth the mean of its readings on the nearest surface. Each halving is computed
    once per observation.
    """
    halvings = observation._halvings
    while len(halvings) < level:
        depth, intensity = halvings[-1] if halvings else (observation.depth, observation.intensity)
        halvings.append(halve(depth, intensity, HALVING_BAND))
    return halvings[level - 1] if level else (observation.depth, observation.intensity)
