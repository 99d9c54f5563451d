"""Surface segments of an image, and the decision whether a whole segment moves."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.segmentation import SegmentImage, SegmentSums, segment_surface
from dudmap.core.dynamics.label_scale import pixel_scale, scaled_area, scaled_length, scaled_side
from dudmap.core.frames.observation import Level

EDGE_REACH = 3
"""Pixels from a concave edge to the normals that are compared on either side, at REFERENCE_WIDTH."""
NORMAL_REACH = 2
"""Pixels to either side over which a normal is estimated, at REFERENCE_WIDTH."""
CONCAVITY = 0.2
"""Sine of half the smallest angle between the normals across a concave edge: 23 degrees."""
MIN_PIXELS = 60
"""Segments of fewer pixels are not classified as a whole, at REFERENCE_WIDTH: 0.3 % of an image of 4:3."""
MAX_SHARE = 0.15
"""Segments that cover more than this share of the readings belong to the room: they are dynamic only if nearly all of
their pixels are."""
MIN_DYNAMIC, NEARLY_ALL = 0.2, 0.8
"""Shares of the pixels of a segment that must be dynamic by themselves for all of it to be: with evidence that the
others have moved as well, and without."""
DISTANCE_SCALE = 1.0
"""Mean distance to the map of a segment that has moved, standard deviations of a reading."""
MISMATCH_SCALE = 1 / 3
"""Intensity mismatch of a segment that has moved, pixels of motion at REFERENCE_WIDTH."""
COMMON_DISTANCE, COMMON_MISMATCH = 0.4, 0.17
"""Upper quartiles of both over the static segments of a well registered frame; where the quartiles of a frame are
larger, the scales grow in proportion."""
GRADIENT_NOISE = 0.03
"""Intensity gradient of noise, per pixel at REFERENCE_WIDTH: smaller ones give no evidence."""


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Surface segments of one image.

    Attributes:
        labels: (h, w) int32 segment numbers from 1, 0 = no reading.
        count: Number of segments.
        gradient: (h, w) float32, local mean of the magnitude of the intensity gradient, per pixel at REFERENCE_WIDTH.
        min_pixels: Fewest pixels of a segment that is classified as a whole.
        window: Side of the window for local means of intensities, pixels.
    """

    labels: NDArray[np.int32]
    count: int
    gradient: NDArray[np.float32]
    min_pixels: float = MIN_PIXELS
    window: int = 3

    def with_noise(self, sigma: NDArray[np.float32]) -> SegmentImage:
        """The segments as kernels take them; sigma (h, w) is that of the distance of a static point."""
        return SegmentImage(self.labels, self.count, sigma, self.gradient, self.window)

    def share(self, pixels: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Share (count + 1,) of each segment's pixels that lie in a mask (h, w) bool; entry 0 is meaningless."""
        total = np.bincount(self.labels.reshape(-1), minlength=self.count + 1)
        return np.bincount(self.labels[pixels], minlength=self.count + 1) / np.maximum(total, 1)


@dataclass(frozen=True, eq=False)
class SegmentEvidence:
    """Evidence of motion per segment, gathered over its pixels; all arrays (count + 1,) float64, entry 0 is
    meaningless.

    A pixel of a segment is compared where the map (or an older frame) has a surface near it, and counts as static
    where it is compared and is not dynamic by itself.

    Attributes:
        size: Number of pixels.
        compared: Share of the pixels that are compared.
        dynamic: Share of the pixels that are dynamic by themselves.
        distance: Mean of distance / sigma over the static pixels.
        mismatch: Intensity mismatch of the static pixels in pixels of motion: the mean absolute deviation D of their
            intensity difference from its mean, over their mean gradient G, damped where G is no larger than noise:
            D G / (G + GRADIENT_NOISE)^2.
        min_pixels: Fewest pixels of a segment that is classified as a whole.
    """

    size: NDArray[np.float64]
    compared: NDArray[np.float64]
    dynamic: NDArray[np.float64]
    distance: NDArray[np.float64]
    mismatch: NDArray[np.float64]
    min_pixels: float = MIN_PIXELS


def segment(level: Level, tolerance: NDArray[np.float32]) -> Segmentation:
    """Cut the surface an image shows along depth edges and concave edges (Stein et al. 2014).

    Args:
        level: The image.
        tolerance: (h, w) float32, largest depth step to a neighbour of the same surface, metres.
    """
    edge_reach, normal_reach = scaled_length(EDGE_REACH, level), scaled_length(NORMAL_REACH, level)
    labels, count = segment_surface(
        level.depth, level.camera.intrinsics, tolerance, edge_reach, normal_reach, CONCAVITY
    )
    return Segmentation(labels, count, intensity_gradient(level), scaled_area(MIN_PIXELS, level), scaled_side(1, level))


def intensity_gradient(level: Level) -> NDArray[np.float32]:
    """Local mean (h, w) of the magnitude of the intensity gradient, per pixel at REFERENCE_WIDTH."""
    import cv2

    scale, window = pixel_scale(level), scaled_side(1, level)
    du = cv2.Sobel(level.intensity, cv2.CV_32F, 1, 0, scale=scale / 8)
    dv = cv2.Sobel(level.intensity, cv2.CV_32F, 0, 1, scale=scale / 8)
    return np.asarray(cv2.blur(cv2.magnitude(du, dv), (window, window)), dtype=np.float32)


def split_mixed_segments(
    segmentation: Segmentation, dynamic_before: NDArray[np.bool_], total: NDArray[np.int64], part: NDArray[np.int64]
) -> Segmentation:
    """Segmentation in which segments that were separate in the last frame, a dynamic and a static one, stay separate.

    A segment is split where each part holds at least a fifth of its pixels; a smaller part has merely come into view.

    Args:
        segmentation: The segments.
        dynamic_before: (h, w) bool, pixels that belonged to a dynamic segment in the last frame.
        total, part: (count + 1,) pixels of each segment, and those that did.
    """
    mixed = np.minimum(part, total - part) >= np.maximum(segmentation.min_pixels, 0.2 * total)
    mixed[0] = False
    if not mixed.any():
        return segmentation
    count = segmentation.count + int(np.count_nonzero(mixed))
    number = np.zeros(segmentation.count + 1, dtype=np.int32)
    number[mixed] = np.arange(segmentation.count + 1, count + 1)
    split = np.asarray(dynamic_before) & mixed[segmentation.labels]
    labels = np.where(split, number[segmentation.labels], segmentation.labels)
    return replace(segmentation, labels=labels, count=count)


def evidence_of(sums: SegmentSums, min_pixels: float) -> SegmentEvidence:
    """Evidence of motion of each segment, from the sums over its pixels and the fewest pixels of a large one."""
    size, static = np.maximum(sums.pixels, 1), np.maximum(sums.static, 1)
    texture = sums.gradient / static
    return SegmentEvidence(
        size=sums.pixels,
        compared=sums.compared / size,
        dynamic=sums.moving / size,
        distance=sums.distance / static,
        mismatch=sums.deviation / static * texture / (texture + GRADIENT_NOISE) ** 2,
        min_pixels=min_pixels,
    )


def classify_segments(evidence: SegmentEvidence, dynamic_before: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Segments that move as a whole, (count + 1,) bool.

    A segment of at least ``min_pixels`` is dynamic if

    - at least NEARLY_ALL of its pixels are dynamic by themselves, or
    - it covers at most MAX_SHARE of the readings, at least MIN_DYNAMIC of its pixels are dynamic by themselves, and
      the mean distance s and the intensity mismatch m of its static pixels say that these have moved as well:

          (s / S)^2 + (m / M)^2 >= 1,    or 1/2 where most of the segment was dynamic in the last frame,

    with S = DISTANCE_SCALE and M = MISMATCH_SCALE, larger in a badly registered frame: in proportion to the upper
    quartiles of |s| and m over the static segments of the frame, where these exceed COMMON_DISTANCE and
    COMMON_MISMATCH.

    Args:
        evidence: Evidence of each segment.
        dynamic_before: (count + 1,) share of the pixels that belonged to a dynamic segment in the last frame.
    """
    large = evidence.size >= evidence.min_pixels
    static = large & (evidence.compared > 0.5) & (evidence.dynamic < 0.5)
    static[0] = False
    distance_scale = DISTANCE_SCALE * max(1.0, upper_quartile(np.abs(evidence.distance[static])) / COMMON_DISTANCE)
    mismatch_scale = MISMATCH_SCALE * max(1.0, upper_quartile(evidence.mismatch[static]) / COMMON_MISMATCH)
    score = (evidence.distance / distance_scale) ** 2 + (evidence.mismatch / mismatch_scale) ** 2
    moved = score >= np.where(dynamic_before > 0.5, 0.5, 1.0)
    small = evidence.size <= MAX_SHARE * evidence.size[1:].sum()
    dynamic = large & ((evidence.dynamic >= NEARLY_ALL) | (small & moved & (evidence.dynamic >= MIN_DYNAMIC)))
    dynamic[0] = False
    return dynamic


def upper_quartile(values: NDArray[np.float64]) -> float:
    """75th percentile, linear between two values; 0 of no values. NumPy's takes ten times as long for so few."""
    if len(values) == 0:
        return 0.0
    ordered = np.sort(values)
    place = 0.75 * (len(values) - 1)
    low = int(place)
    below, above, share = float(ordered[low]), float(ordered[min(low + 1, len(values) - 1)]), place - low
    return below + (above - below) * share
