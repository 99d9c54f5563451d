"""A preprocessed frame, the levels of its image pyramid, and their exposure to the intensities of the map."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera
from dudmap.core.state import CACHE


@dataclass(frozen=True, eq=False)
class Observation:
    """A preprocessed frame.

    Attributes:
        timestamp: Seconds, of the depth image.
        camera: Camera of all images here; without lens distortion.
        depth: (H, W) float32, metres, holes filled and smoothed, 0 = none.
        intensity: (H, W) float32, 0..1.
        rgb: (H, W, 3) uint8, registered to the depth; ``intensity`` likewise. Those of a colour camera that is not
            synchronous are so only once the camera's motion is known (``core/tracking/color_motion.py``).
        recorded_rgb: (h, w, 3) uint8 of another colour camera, not registered; None where that is ``rgb``.
        color_offset: Time stamp of the colour image minus that of the depth image, seconds; 0 if not known.
    """

    timestamp: float
    camera: Camera
    depth: NDArray[np.float32]
    intensity: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    recorded_rgb: NDArray[np.uint8] | None = None
    color_offset: float = 0.0
    _recorded_halvings: list[NDArray[np.float32]] = field(default_factory=list, repr=False, metadata=CACHE)
    _halvings: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = field(
        default_factory=list, repr=False, metadata=CACHE
    )

    @cached_property
    def readings(self) -> NDArray[np.bool_]:
        """(H, W) bool, pixels with a depth."""
        return self.depth > 0

    @cached_property
    def num_readings(self) -> int:
        """Number of pixels with a depth."""
        return int(np.count_nonzero(self.readings))

    @property
    def as_recorded(self) -> Frame:
        """Depth of the observation and colour as it was recorded."""
        color = self.rgb if self.recorded_rgb is None else self.recorded_rgb
        return Frame(self.timestamp, self.depth, color, self.timestamp + self.color_offset)


@dataclass(frozen=True, eq=False)
class Level:
    """One level of the image pyramid: camera, depth (h, w) m, intensity (h, w) 0..1."""

    camera: Camera
    depth: NDArray[np.float32]
    intensity: NDArray[np.float32]

    @cached_property
    def num_readings(self) -> int:
        """Number of pixels with a depth."""
        return int(np.count_nonzero(self.depth))


def exposed_color(rgb: NDArray[np.uint8], exposure: tuple[float, float]) -> NDArray[np.uint8]:
    """Colours (H, W, 3) with gain and offset applied, comparable to those of the map."""
    import cv2

    gain, offset = exposure
    return rgb if exposure == (1.0, 0.0) else np.asarray(cv2.LUT(rgb, _curve(gain, offset)), dtype=np.uint8)


def _curve(gain: float, offset: float) -> NDArray[np.uint8]:
    return np.clip(gain * np.arange(256) + 255 * offset + 0.5, 0, 255).astype(np.uint8)


def exposed(level: Level, exposure: tuple[float, float]) -> Level:
    """Level with gain and offset applied to its intensities."""
    gain, offset = exposure
    if (gain, offset) == (1.0, 0.0):
        return level
    return Level(level.camera, level.depth, np.float32(gain) * level.intensity + np.float32(offset))


def chained(first: tuple[float, float], then: tuple[float, float]) -> tuple[float, float]:
    """Gain and offset of two exposures applied one after the other."""
    return then[0] * first[0], then[0] * first[1] + then[1]
