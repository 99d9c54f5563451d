"""Whether a whole piece of surface moves: what its pixels say of it together, and how long it has stood still."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.frames.observation import Level
from dudmap.kernels import segmentation

REACH = 3
"""Pixels to either side of a hollow."""
CONCAVITY = 0.2
"""Sine of half the angle by which the surface turns in a hollow."""
SMALLEST = 60
"""Segments of fewer pixels are not judged as a whole."""
LARGEST = 0.15
"""Segments larger than this share of the image belong to the room and move only if nearly all their pixels do."""
SHIFT = 2.8
"""Mean distance to the map, in standard deviations of a reading, of a piece that surely moved."""
MISMATCH = 0.48
"""Mean difference of intensity over mean gradient of intensity of a piece that surely moved: pixels of motion."""
ORDINARY_SHIFT, ORDINARY_MISMATCH = 0.4, 0.17
"""What three of four pieces of a good frame stay below; where they have more, so must one that moved."""
FLOOR = 0.03
"""Gradients smaller than this tell nothing, intensity per pixel."""


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Segmentation of surface of one image.

    Attributes:
        labels: (h, w) int32 numbers from 1, 0 = no reading.
        count: How many there are.
        gradient: (h, w) float32, intensity per pixel, mean over 3x3.
    """

    labels: NDArray[np.int32]
    count: int
    gradient: NDArray[np.float32]

    def share(self, pixels: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Share (count + 1,) of the pixels of each piece that are among these (h, w) bool; entry 0 means nothing."""
        total = np.bincount(self.labels.reshape(-1), minlength=self.count + 1)
        return np.bincount(self.labels[pixels], minlength=self.count + 1) / np.maximum(total, 1)


@dataclass(frozen=True, eq=False)
class SegmentEvidence:
    """What the pixels of each piece say together; all (count + 1,), entry 0 means nothing.

    Attributes:
        size: Pixels.
        known: Share of the pixels that could be compared.
        moving: Share of the pixels that move by themselves.
        rest: Number of pixels that could be compared and do not move by themselves.
        shift: Of these, mean distance over its standard deviation,
        mismatch: mean difference of the intensities from their mean difference, in pixels of motion,
        texture: and mean gradient of the intensity.
    """

    size: NDArray[np.float64]
    known: NDArray[np.float64]
    moving: NDArray[np.float64]
    rest: NDArray[np.float64]
    shift: NDArray[np.float64]
    mismatch: NDArray[np.float64]
    texture: NDArray[np.float64]


def segment(level: Level, tolerance: NDArray[np.float32]) -> Segmentation:
    """Cut an image's surface along depth edges and concave_edges.

    Args:
        level: The image.
        tolerance: (h, w) float32, largest depth step to a neighbour of the same surface, metres.
    """
    import cv2

    labels, count = segmentation.segment_surface(level.depth, level.camera.intrinsics, tolerance, REACH, 2, CONCAVITY)
    du = cv2.Sobel(level.intensity, cv2.CV_32F, 1, 0, scale=1 / 8)
    dv = cv2.Sobel(level.intensity, cv2.CV_32F, 0, 1, scale=1 / 8)
    gradient = cv2.blur(cv2.magnitude(du, dv), (3, 3))
    return Segmentation(labels, count, np.asarray(gradient, dtype=np.float32))


def split(surface: Segmentation, body: NDArray[np.bool_]) -> Segmentation:
    """Segmentation in which a moving and a resting piece of the last frame have met, as two.

    Args:
        surface: The pieces.
        body: (h, w) bool, pixels that belonged to a moving piece.
    """
    total = np.bincount(surface.labels.reshape(-1), minlength=surface.count + 1)
    part = np.bincount(surface.labels[body], minlength=surface.count + 1)
    mixed = np.minimum(part, total - part) >= np.maximum(SMALLEST, 0.2 * total)  # less is what came into view
    mixed[0] = False
    if not mixed.any():
        return surface
    number = np.zeros(surface.count + 1, dtype=np.int32)
    number[mixed] = np.arange(surface.count + 1, surface.count + 1 + np.count_nonzero(mixed))
    labels = np.where(body & mixed[surface.labels], number[surface.labels], surface.labels)
    return Segmentation(labels, surface.count + int(np.count_nonzero(mixed)), surface.gradient)


def judge(
    surface: Segmentation,
    used: NDArray[np.bool_],
    moving: NDArray[np.bool_],
    distance: NDArray[np.float32],
    sigma: NDArray[np.float32],
    difference: NDArray[np.float32],
) -> SegmentEvidence:
    """Evidence of each piece as a whole.

    Args:
        surface: The pieces.
        used: (h, w) bool, pixels whose distance and difference are known.
        moving: (h, w) bool, pixels that move by themselves.
        distance: (h, w) float32, metres; anything where not used.
        sigma: (h, w) float32, metres.
        difference: (h, w) float32, of intensities; anything where not used.
    """
    import cv2

    ones = used.astype(np.float32)
    mean = cv2.blur(np.where(used, difference, np.float32(0)), (3, 3)) / np.maximum(
        cv2.blur(ones, (3, 3)), np.float32(1e-3)
    )
    sums = segmentation.segment_sums(
        surface.labels, surface.count, used, moving, distance, sigma, np.asarray(mean, np.float32), surface.gradient
    )
    size, known = np.maximum(sums.pixels, 1), np.maximum(sums.static, 1)
    texture = sums.gradient / known
    return SegmentEvidence(
        sums.pixels, sums.compared / size, sums.moving / size, sums.static, sums.distance / known,
        sums.deviation / known * texture / (texture + FLOOR) ** 2, texture,
    )  # fmt: skip


def classify_segments(verdict: SegmentEvidence, moved: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which pieces (count + 1,) move, all of each.

    A piece moves if nearly all of its pixels do by themselves. A piece that is not too large also moves if a part of it
    does and the rest fits badly, by its distances and intensities together and by more than is common in this frame;
    the larger the part, the less will do, and still less where it moved in the last frame: a thing does not move by
    halves.

    Args:
        verdict: Evidence of each piece.
        moved: (count + 1,) share of the pixels that moved in the last frame.
    """
    counted = np.flatnonzero((verdict.known > 0.5) & (verdict.size >= SMALLEST))
    resting = counted[verdict.moving[counted] < 0.5]
    shift = SHIFT * max(1.0, upper_quartile(np.abs(verdict.shift[resting])) / ORDINARY_SHIFT)
    mismatch = MISMATCH * max(1.0, upper_quartile(verdict.mismatch[resting]) / ORDINARY_MISMATCH)
    score = np.zeros(len(verdict.size))
    score[counted] = ((np.maximum(verdict.shift, 0) / shift) ** 2 + (verdict.mismatch / mismatch) ** 2)[counted]
    doubt = (verdict.shift / (0.35 * shift)) ** 2 + (verdict.mismatch / (0.7 * mismatch)) ** 2
    telling = (verdict.texture > FLOOR) & (verdict.rest >= 0.5 * SMALLEST)
    whole = (score >= 1) & (verdict.moving >= 0.1)
    whole |= np.where(telling, (verdict.moving >= 0.2) & (doubt >= 1), verdict.moving >= 0.6)
    whole |= (moved >= 0.7) & (verdict.moving >= 0.2) & (doubt >= 0.4)
    whole |= (moved >= 0.4) & (verdict.moving >= 0.4) & (doubt >= 0.5)
    whole &= verdict.size <= LARGEST * verdict.size[1:].sum()
    whole |= verdict.moving >= 0.8
    whole &= verdict.size >= SMALLEST
    whole[0] = False
    return whole


def upper_quartile(values: NDArray[np.float64]) -> float:
    """What three of four values stay below; 0 if there is none."""
    return float(np.percentile(values, 75)) if len(values) else 0.0
