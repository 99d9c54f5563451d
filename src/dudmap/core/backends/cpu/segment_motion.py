"""Motion of whole segments, and segments still at their place in an older frame."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.median import nth
from dudmap.core.backends.parameters import SURFACE, UNKNOWN
from dudmap.core.backends.threads import exact, exact_scalar

MAX_SHARE = 0.15
"""Largest share of the image of a movable segment; larger ones need nearly all pixels dynamic."""
MIN_DYNAMIC, NEARLY_ALL = 0.2, 0.8
"""Smallest dynamic share of a dynamic segment, with evidence of the others' motion, and without."""
STARTED_SHARE = 0.1
"""Smallest share of seeds in a segment that moves in unknown space, and in a grown region."""
DISTANCE_SCALE = 1.0
"""Mean distance of a moved segment, standard deviations."""
MISMATCH_SCALE = 1 / 3
"""Intensity mismatch of a moved segment, pixels at REFERENCE_WIDTH."""
COMMON_DISTANCE, COMMON_MISMATCH = 0.4, 0.17
"""Upper quartiles of both over static segments; larger ones scale the limits."""
GRADIENT_NOISE = 0.03
"""Intensity gradient of noise, per pixel at REFERENCE_WIDTH."""
SETTLED_SIGMAS = 4
"""Distance of a moved point, standard deviations."""
LEAST_SHARE = np.float32(1e-3)
"""Smallest compared share of a window."""
SIZE, COMPARED, DYNAMIC, DISTANCE, MISMATCH = range(5)
"""Evidence of a segment: pixels; compared share (a surface is near); dynamic share; mean distance / sigma of static
compared pixels; their intensity mismatch D G / (G + noise)^2, pixels, with mean absolute deviation D of differences and
mean gradient G."""
MEAN_DEVIATION = 1.183
"""Mean over median absolute deviation of normal values."""
f64 = np.float64


class SegmentImage(NamedTuple):
    """The segments of an image, and scales of residuals.

    Attributes:
        labels: (h, w) int32 from 1, 0 = none.
        count: Number of segments.
        min_pixels: Smallest segment classified as a whole.
        gradient: (h, w) float32, magnitude of the intensity gradient.
        window: Side of the averaging window, pixels, odd.
        sigma: (h, w) float32, of a static distance, metres.
        least_sigma: Float32, its lower bound.
    """

    labels: NDArray[np.int32]
    count: int
    min_pixels: float
    gradient: NDArray[np.float32]
    window: int
    sigma: NDArray[np.float32]
    least_sigma: float


@exact_scalar
def mirrored(n, size):
    """Index of a pixel mirrored at the border: 1 for -1."""
    n = -n if n < 0 else n
    n = 2 * size - 2 - n if n >= size else n
    return min(max(n, 0), size - 1)


@exact_scalar
def window_means(compared, difference, window):
    """Mean difference (h, w) over compared pixels of a square window."""
    h, w = compared.shape
    half, by_area = window // 2, 1.0 / (window * window)
    ones, sums, means = np.zeros((h, w)), np.zeros((h, w)), np.empty((h, w), np.float32)
    one, value = np.empty(w + 2 * half), np.empty(w + 2 * half)
    for v in range(h):
        for u in range(-half, w + half):
            n = mirrored(u, w)
            one[u + half] = 1.0 if compared[v, n] else 0.0
            value[u + half] = f64(difference[v, n]) if compared[v, n] else 0.0
        for k in range(window):
            for u in range(w):
                ones[v, u] += one[np.uintp(u + k)]
                sums[v, u] += value[np.uintp(u + k)]
    for v in range(h):
        one[:] = 0
        value[:] = 0
        for k in range(-half, half + 1):
            n = mirrored(v + k, h)
            for u in range(w):
                one[np.uintp(u)] += ones[n, u]
                value[np.uintp(u)] += sums[n, u]
        for u in range(w):
            share = max(np.float32(one[np.uintp(u)] * by_area), LEAST_SHARE)
            means[v, u] = np.float32(value[np.uintp(u)] * by_area) / share
    return means


@exact_scalar
def segment_evidence(segments, labels, count, compared, moving, distance, means):
    """Evidence (count + 1, 5) of each segment; row 0 has no meaning.

    Args:
        segments: SegmentImage.
        labels, count: Its labels, or others.
        compared, moving: (h, w) bool.
        distance: (h, w) float32, metres.
        means: (h, w) float32, ``window_means``.
    """
    h, w = labels.shape
    sums, deviations, out = np.zeros((count + 1, 7)), np.zeros(count + 1), np.empty((count + 1, 5))
    for v in range(h):
        for u in range(w):
            n = labels[v, u]
            if n == 0:
                continue
            sums[n, 0] += 1
            sums[n, 1] += compared[v, u]
            sums[n, 2] += moving[v, u]
            if compared[v, u] and not moving[v, u]:
                sums[n, 3] += 1
                sums[n, 4] += distance[v, u] / max(segments.least_sigma, segments.sigma[v, u])
                sums[n, 5] += means[v, u]
                sums[n, 6] += segments.gradient[v, u]
    for v in range(h):
        for u in range(w):
            n = labels[v, u]
            if n > 0 and compared[v, u] and not moving[v, u]:
                deviations[n] += abs(means[v, u] - sums[n, 5] / sums[n, 3])
    for n in range(count + 1):
        size, static = max(sums[n, 0], 1.0), max(sums[n, 3], 1.0)
        texture = sums[n, 6] / static
        out[n, SIZE], out[n, COMPARED], out[n, DYNAMIC] = sums[n, 0], sums[n, 1] / size, sums[n, 2] / size
        out[n, DISTANCE] = sums[n, 4] / static
        out[n, MISMATCH] = deviations[n] / static * texture / ((texture + GRADIENT_NOISE) * (texture + GRADIENT_NOISE))
    return out


@exact_scalar
def upper_quartile(values):
    """75th percentile of a few values, sorted in place; 0 without."""
    count = len(values)
    if count == 0:
        return 0.0
    for n in range(1, count):
        value, place = values[n], n
        while place > 0 and values[place - 1] > value:
            values[place] = values[place - 1]
            place -= 1
        values[place] = value
    place = 0.75 * (count - 1)
    low = int(place)
    below, above = values[low], values[min(low + 1, count - 1)]
    return below + (above - below) * (place - low)


@exact_scalar
def classify_segments(evidence, before, min_pixels):
    """Segments that move as a whole, (count + 1,) bool: of at least ``min_pixels``,

    - with at least NEARLY_ALL dynamic pixels, or
    - mostly dynamic, like the view, in the last frame, and mostly off the map's surface, or
    - within MAX_SHARE of the image, with MIN_DYNAMIC dynamic pixels, and the others moved.

    With mean distance s and mismatch m, static pixels have moved if

        (s / S)^2 + (m / M)^2 >= 1,    or 1/2 if most of the segment was dynamic in the last frame.

    S = DISTANCE_SCALE and M = MISMATCH_SCALE grow with upper quartiles of |s| and m above COMMON_DISTANCE and
    COMMON_MISMATCH.

    Args:
        evidence: (count + 1, 5).
        before: (count + 1,) share in a dynamic segment of the last frame.
        min_pixels: Smallest segment classified as a whole.
    """
    count, readings, moved_before = len(evidence) - 1, 0.0, 0.0
    distances, mismatches, static = np.empty(count), np.empty(count), 0
    for n in range(1, count + 1):
        readings += evidence[n, SIZE]
        moved_before += before[n] * evidence[n, SIZE]
        if evidence[n, SIZE] >= min_pixels and evidence[n, COMPARED] > 0.5 and evidence[n, DYNAMIC] < 0.5:
            distances[static], mismatches[static] = abs(evidence[n, DISTANCE]), evidence[n, MISMATCH]
            static += 1
    distance_scale = DISTANCE_SCALE * max(1.0, upper_quartile(distances[:static]) / COMMON_DISTANCE)
    mismatch_scale = MISMATCH_SCALE * max(1.0, upper_quartile(mismatches[:static]) / COMMON_MISMATCH)
    moving = np.zeros(count + 1, np.bool_)
    for n in range(1, count + 1):
        far, unlike = evidence[n, DISTANCE] / distance_scale, evidence[n, MISMATCH] / mismatch_scale
        moved = far * far + unlike * unlike >= (0.5 if before[n] > 0.5 else 1.0)
        small = evidence[n, SIZE] <= MAX_SHARE * readings
        nearly_all, some = evidence[n, DYNAMIC] >= NEARLY_ALL, evidence[n, DYNAMIC] >= MIN_DYNAMIC
        unseen = before[n] > 0.5 and evidence[n, COMPARED] < 0.5 and moved_before > 0.5 * readings
        moving[n] = evidence[n, SIZE] >= min_pixels and (nearly_all or unseen or (small and moved and some))
    return moving


@exact_scalar
def counts_in(labels, count, first, second):
    """Pixels (count + 1,) of each segment, in all and in two masks (h, w) bool."""
    total, ones, twos = np.zeros(count + 1, np.int64), np.zeros(count + 1, np.int64), np.zeros(count + 1, np.int64)
    for v in range(labels.shape[0]):
        for u in range(labels.shape[1]):
            n = labels[v, u]
            total[n] += 1
            ones[n] += first[v, u]
            twos[n] += second[v, u]
    return total, ones, twos


@exact_scalar
def split_mixed_segments(labels, count, before, total, part, min_pixels):
    """Split segments that merge a dynamic and a static one of the last frame, of at least a fifth each; returns labels
    and number.

    Args:
        labels, count, min_pixels: As for ``SegmentImage``.
        before: (h, w) bool, in a dynamic segment of the last frame.
        total, part: (count + 1,) int64 pixels, and pixels in ``before``.
    """
    number, first = np.zeros(count + 1, np.int32), count
    for n in range(1, len(total)):
        if min(part[n], total[n] - part[n]) >= max(min_pixels, 0.2 * total[n]):
            count += 1
            number[n] = count
    if count > first:
        labels = labels.copy()
        for v in range(labels.shape[0]):
            for u in range(labels.shape[1]):
                if before[v, u] and number[labels[v, u]] > 0:
                    labels[v, u] = number[labels[v, u]]
    return labels, count


@exact
def moving_segments(segments, before, seeds, sample, intensity, gain, offset, dynamic):
    """Update dynamic pixels by segments, after ``split_mixed_segments``.

    1. Unknown space is dynamic only in segments with STARTED_SHARE seeds.
    2. Moving segments (``classify_segments``) are dynamic as a whole.

    Args:
        segments: SegmentImage.
        before: (h, w) bool, in a dynamic segment of the last frame.
        seeds: (h, w) bool.
        sample: MapSample at the points of the image.
        intensity: (h, w) float32.
        gain, offset: Float32, 1 minus the exposure gain, and offset: ``gain * intensity - offset`` is added to
            differences.
        dynamic: (h, w) bool in and out.

    Returns:
        Labels and number of segments.
    """
    labels, count = segments.labels, segments.count
    total, started, part = counts_in(labels, count, seeds, before)
    labels, count = split_mixed_segments(labels, count, before, total, part, segments.min_pixels)
    if count > segments.count:
        total, started, part = counts_in(labels, count, seeds, before)
    (h, w), size = labels.shape, np.maximum(total, 1)
    begins = started / size >= STARTED_SHARE
    compared, difference = np.empty((h, w), np.bool_), np.empty((h, w), np.float32)
    for v in range(h):
        for u in range(w):
            occupancy = sample.occupancy[v, u]
            dynamic[v, u] = dynamic[v, u] and (occupancy != UNKNOWN or begins[labels[v, u]])
            compared[v, u] = occupancy == SURFACE
            lit = sample.difference[v, u] + (gain * intensity[v, u] - offset)
            difference[v, u] = np.float32(0) if np.isnan(lit) else lit  # no surface
    means = window_means(compared, difference, segments.window)
    evidence = segment_evidence(segments, labels, count, compared, dynamic, sample.distance, means)
    moving = classify_segments(evidence, part / size, segments.min_pixels)
    for v in range(h):
        for u in range(w):
            dynamic[v, u] = dynamic[v, u] or moving[labels[v, u]]
    return labels, count


@exact_scalar
def median_mismatches(segments, labels, count, compared, moving, means):
    """Intensity mismatch (count + 1,) by medians, because a static segment differs along its outline only."""
    sizes, out = np.zeros(count + 1, np.int64), np.zeros(count + 1)
    for v in range(labels.shape[0]):
        for u in range(labels.shape[1]):
            sizes[labels[v, u]] += compared[v, u] and not moving[v, u]
    ends = np.cumsum(sizes)
    places, values = ends - sizes, np.empty((2, ends[count]), np.float32)
    for v in range(labels.shape[0]):
        for u in range(labels.shape[1]):
            if compared[v, u] and not moving[v, u]:
                n = labels[v, u]
                values[0, places[n]], values[1, places[n]] = means[v, u], segments.gradient[v, u]
                places[n] += 1
    for n in range(1, count + 1):
        if sizes[n] > 0:
            middle, (differences, gradients) = sizes[n] // 2, values[:, ends[n] - sizes[n] : ends[n]]
            texture, deviations = f64(nth(gradients, middle)), np.abs(differences - nth(differences, middle))
            damped = texture / ((texture + GRADIENT_NOISE) * (texture + GRADIENT_NOISE))
            out[n] = MEAN_DEVIATION * nth(deviations, middle) * damped
    return out


@exact
def stand_still(segments, dynamic, gap, difference, settled):
    """Clear ``settled`` for segments that moved since an older frame. Conditions to stay:

    - More than 0.7 of the pixels are visible.
    - Less than 0.1 are displaced by SETTLED_SIGMAS.
    - The mean distance is below one sigma.
    - The mismatch by medians is below 1.2 times the frame's upper quartile (or COMMON_MISMATCH).

    Args:
        segments: SegmentImage.
        dynamic: (h, w) bool.
        gap, difference: (h, w) float32 to the older frame, see ``Reprojection``.
        settled: (count + 1,) bool in and out.
    """
    count, (h, w) = segments.count, dynamic.shape
    parts = np.empty((h, w), np.int32)  # the dynamic part of segment n is n + count
    compared, displaced = np.empty((h, w), np.bool_), np.empty((h, w), np.bool_)
    visible, quartile_of = np.zeros(2 * count + 1, np.bool_), np.empty(2 * count + 1)
    for v in range(h):
        for u in range(w):
            parts[v, u] = segments.labels[v, u] + (count if dynamic[v, u] else 0)
            compared[v, u] = not np.isnan(gap[v, u])
            sigma = max(segments.least_sigma, segments.sigma[v, u])
            displaced[v, u] = abs(gap[v, u]) > SETTLED_SIGMAS * sigma  # False for NaN
    means, found = window_means(compared, difference, segments.window), 0
    evidence = segment_evidence(segments, parts, 2 * count, compared, displaced, gap, means)
    mismatches = median_mismatches(segments, parts, 2 * count, compared, displaced, means)
    for n in range(2 * count + 1):
        visible[n] = evidence[n, COMPARED] > 0.7 and evidence[n, SIZE] >= segments.min_pixels
        if visible[n]:
            quartile_of[found] = mismatches[n]
            found += 1
    limit = 1.2 * max(COMMON_MISMATCH, upper_quartile(quartile_of[:found]))
    for n in range(1, count + 1):
        e = evidence[n + count]
        still = visible[n + count] and e[DYNAMIC] < 0.1 and abs(e[DISTANCE]) < 1 and mismatches[n + count] < limit
        settled[n] = settled[n] and still
