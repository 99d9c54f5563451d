"""Pixel counts that scale with the label image: they are given for images 160 pixels wide."""

from dudmap.core.frames.observation import Level

REFERENCE_WIDTH = 160
"""Width of the label image that pixel counts are given for: the default of ``dynamics.width``."""


def pixel_scale(level: Level) -> float:
    """Pixels of a label image per pixel of one of REFERENCE_WIDTH."""
    return level.camera.width / REFERENCE_WIDTH


def scaled_length(pixels: float, level: Level) -> int:
    """A length given at REFERENCE_WIDTH, pixels of a label image; 1 at least."""
    return max(1, round(pixels * pixel_scale(level)))


def scaled_side(radius: float, level: Level) -> int:
    """Side of a square window, given by its radius at REFERENCE_WIDTH, pixels of a label image; odd, 3 at least."""
    return 2 * scaled_length(radius, level) + 1


def scaled_area(pixels: float, level: Level) -> float:
    """An area given at REFERENCE_WIDTH, pixels of a label image; 9 (a square of 3x3) at least."""
    return max(9.0, pixels * pixel_scale(level) ** 2)
