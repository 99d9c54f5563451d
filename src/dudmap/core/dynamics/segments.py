"""Surface segments of an image, and scaling of pixel counts."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.segment_motion import SegmentImage
from dudmap.core.backends.cpu.segmentation import segment_surface
from dudmap.core.frames.observation import Level

REFERENCE_WIDTH = 160
"""Label image width of pixel counts: the default of ``dynamics.width``."""


def pixel_scale(level: Level) -> float:
    """Pixels of a label image per pixel at REFERENCE_WIDTH."""
    return level.camera.width / REFERENCE_WIDTH


def scaled_length(pixels: float, level: Level) -> int:
    """Pixels of a label image, from pixels at REFERENCE_WIDTH; at least 1."""
    return max(1, round(pixels * pixel_scale(level)))


def scaled_side(radius: float, level: Level) -> int:
    """Odd side of a square window in a label image, from its radius at REFERENCE_WIDTH; at least 3."""
    return 2 * scaled_length(radius, level) + 1


def scaled_area(pixels: float, level: Level) -> float:
    """Area in a label image, from the area at REFERENCE_WIDTH; at least 9 (3x3)."""
    return max(9.0, pixels * pixel_scale(level) ** 2)


EDGE_REACH = 3
"""Distance of compared normals from a concave edge, pixels at REFERENCE_WIDTH."""
NORMAL_REACH = 2
"""Half width of the window of a normal, pixels at REFERENCE_WIDTH."""
CONCAVITY = 0.2
"""Sine of half the smallest angle between normals across a concave edge: 23 degrees."""
MIN_PIXELS = 60
"""Smallest segment classified as a whole, pixels at REFERENCE_WIDTH: 0.3 % of a 4:3 image."""


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Surface segments of one image.

    Attributes:
        labels: (h, w) int32 segment numbers from 1, 0 = no measurement.
        count: Number of segments.
        gradient: (h, w) float32, local mean of the intensity gradient's magnitude, per pixel at REFERENCE_WIDTH.
        min_pixels: Smallest segment classified as a whole.
        window: Side of the window for mean intensities, pixels.
    """

    labels: NDArray[np.int32]
    count: int
    gradient: NDArray[np.float32]
    min_pixels: float = MIN_PIXELS
    window: int = 3

    def with_noise(self, sigma: NDArray[np.float32], least: float) -> SegmentImage:
        """The segments for kernels. ``sigma``: (h, w) standard deviation of a static distance, metres, at least
        ``least``."""
        least_sigma: Any = np.float32(least)
        return SegmentImage(self.labels, self.count, self.min_pixels, self.gradient, self.window, sigma, least_sigma)

    def share(self, pixels: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Share (count + 1,) of each segment's pixels in a mask (h, w) bool; entry 0 has no meaning."""
        total = np.bincount(self.labels.reshape(-1), minlength=self.count + 1)
        return np.bincount(self.labels[pixels], minlength=self.count + 1) / np.maximum(total, 1)


def segment(level: Level, tolerance: NDArray[np.float32]) -> Segmentation:
    """Segment the visible surface along depth edges and concave edges (Stein et al. 2014).

    Args:
        level: The image.
        tolerance: (h, w) float32, largest depth step within a surface, metres.
    """
    edge_reach, normal_reach = scaled_length(EDGE_REACH, level), scaled_length(NORMAL_REACH, level)
    labels, count = segment_surface(
        level.depth, level.camera.intrinsics, tolerance, edge_reach, normal_reach, CONCAVITY
    )
    return Segmentation(labels, count, intensity_gradient(level), scaled_area(MIN_PIXELS, level), scaled_side(1, level))


def intensity_gradient(level: Level) -> NDArray[np.float32]:
    """Local mean (h, w) of the intensity gradient's magnitude, per pixel at REFERENCE_WIDTH."""
    import cv2

    scale, window = pixel_scale(level), scaled_side(1, level)
    du = cv2.Sobel(level.intensity, cv2.CV_32F, 1, 0, scale=scale / 8)
    dv = cv2.Sobel(level.intensity, cv2.CV_32F, 0, 1, scale=scale / 8)
    magnitude = np.sqrt(du * du + dv * dv)  # OpenCV's magnitude depends on the address of the array
    return np.asarray(cv2.blur(magnitude, (window, window)), dtype=np.float32)
