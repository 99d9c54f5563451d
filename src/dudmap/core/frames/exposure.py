"""Gain and offset between the intensities of an image and those of the map."""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.observation import Level


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
