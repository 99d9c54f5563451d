"""The calls that label a frame, written with NumPy and OpenCV on whole images."""

import cv2
import numpy as np

from dudmap.core.backends.cpu import labeling
from dudmap.core.backends.cpu.evidence import (
    BINS,
    BINS_PER_SIGMA,
    LARGEST,
    edge_tolerance,
    mixture_log_odds,
    noise_limit,
)
from dudmap.core.backends.cpu.exposure import fit_exposure
from dudmap.core.backends.cpu.reprojection import AGREEING_SIGMAS
from dudmap.core.backends.cpu.segment_motion import (
    COMMON_DISTANCE,
    COMMON_MISMATCH,
    GRADIENT_NOISE,
    LEAST_SHARE,
    MAX_SHARE,
    MEAN_DEVIATION,
    MIN_DYNAMIC,
    NEARLY_ALL,
    SETTLED_SIGMAS,
    STARTED_SHARE,
)
from dudmap.core.backends.median import median
from dudmap.core.backends.parameters import FREE, SURFACE, UNKNOWN


def weighed(depth, sample, noise):
    """Standard deviations, tolerances, histogram of the residuals, and share of the readings in unknown space."""
    sigma = np.sqrt((noise.base + noise.scale * (depth * depth)) ** 2 + noise.map_variance)
    tolerance = edge_tolerance.py_func(sigma, depth, noise.edge_sigmas, noise.edge_slope)
    surface, valid = sample.occupancy == SURFACE, depth > 0
    residual = np.minimum(np.abs(sample.distance[surface]) / sigma[surface], LARGEST) * BINS_PER_SIGMA
    unknown = np.count_nonzero((sample.occupancy == UNKNOWN) & valid) / max(np.count_nonzero(valid), 1)
    return sigma, tolerance, np.bincount(residual.astype(np.int64), minlength=BINS), unknown


def moving(depth, sample, sigma, tolerance, seen_free, offset, slope, noise, rules):
    """Dynamic pixels and seeds."""
    least = noise_limit.py_func(sigma, noise.floor, noise.sigmas)
    residual, limit = np.abs(sample.distance) / sigma, np.float32(rules.limit)
    odds = np.clip(mixture_log_odds.py_func(residual * residual, offset, slope), -limit, limit)
    odds = np.where(np.abs(sample.distance) < least, np.maximum(odds, np.float32(1)), odds)
    odds[sample.occupancy != SURFACE] = 0
    odds[(sample.occupancy == FREE) | seen_free] = -limit
    probability = labeling.mean_field(odds, depth, tolerance, rules.coupling, rules.sweeps)
    dynamic = (probability < 0.5) & (depth > 0)
    square = np.ones((2 * rules.half_seam + 1,) * 2, np.uint8)
    opened = cv2.morphologyEx(dynamic.astype(np.uint8), cv2.MORPH_OPEN, square) > 0
    seeds = opened | (dynamic & (sample.occupancy == FREE))
    labels, count = labeling.grow_regions(seeds, odds < 1, depth, tolerance)
    areas = np.bincount(labels.reshape(-1), minlength=count + 1)
    seeded = np.bincount(labels[seeds], minlength=count + 1)
    moves = (areas >= rules.min_area) & (seeded >= rules.seeded_share * areas)
    moves[0] = False
    return moves[labels], seeds


def quartile(values):
    return np.percentile(values, 75) if len(values) else 0.0


def evidence(segments, labels, count, compared, moves, distance, difference):
    """Columns of ``segment_motion.segment_evidence``."""
    size, members = (segments.window, segments.window), labels.reshape(-1)

    def sums(values):
        return np.bincount(members, np.asarray(values, np.float64).reshape(-1), count + 1)

    ones = cv2.blur(compared.astype(np.float32), size)
    mean = cv2.blur(np.where(compared, difference, np.float32(0)), size) / np.maximum(ones, LEAST_SHARE)
    static, sigma = compared & ~moves, np.maximum(segments.least_sigma, segments.sigma)
    pixels, number = np.maximum(sums(labels > 0), 1), np.maximum(sums(static), 1)
    average = sums(np.where(static, mean, 0)) / number
    deviation = sums(np.where(static, np.abs(mean - average[labels]), 0)) / number
    texture = sums(np.where(static, segments.gradient, 0)) / number
    return np.stack([
        sums(labels > 0), sums(compared) / pixels, sums(moves) / pixels,
        sums(np.where(static, distance / sigma, 0)) / number, deviation * texture / (texture + GRADIENT_NOISE) ** 2,
    ], axis=1)  # fmt: skip


def classified(found, before, min_pixels):
    size, compared, dynamic, distance, mismatch = found.T
    static = (size >= min_pixels) & (compared > 0.5) & (dynamic < 0.5)
    static[0] = False
    s = max(1.0, quartile(np.abs(distance[static])) / COMMON_DISTANCE)
    m = max(1.0, quartile(mismatch[static]) / COMMON_MISMATCH) / 3
    moved = (distance / s) ** 2 + (mismatch / m) ** 2 >= np.where(before > 0.5, 0.5, 1.0)
    small = size <= MAX_SHARE * size[1:].sum()
    moves = (size >= min_pixels) & ((dynamic >= NEARLY_ALL) | (small & moved & (dynamic >= MIN_DYNAMIC)))
    moves[0] = False
    return moves


def moved(segments, before, seeds, sample, intensity, gain, offset, dynamic):
    """Dynamic pixels by segment; segments are not to be split."""
    labels, count = segments.labels, segments.count
    total, started, part = (
        np.bincount(labels[mask], minlength=count + 1) for mask in (np.ones_like(before), seeds, before)
    )
    total = np.maximum(total, 1)
    dynamic = dynamic & ((sample.occupancy != UNKNOWN) | (started / total >= STARTED_SHARE)[labels])
    difference = np.nan_to_num(sample.difference + (gain * intensity - offset))
    found = evidence(segments, labels, count, sample.occupancy == SURFACE, dynamic, sample.distance, difference)
    return dynamic | classified(found, part / total, segments.min_pixels)[labels]


def still(segments, dynamic, gap, difference):
    """Segments whose dynamic part stands where it was."""
    count, compared = segments.count, ~np.isnan(gap)
    displaced = np.abs(gap) > SETTLED_SIGMAS * np.maximum(segments.least_sigma, segments.sigma)
    parts = segments.labels + np.where(dynamic, count, 0)
    found = evidence(segments, parts, 2 * count, compared, displaced, gap, difference)
    size, visible, moves, distance, _ = found.T
    ones = cv2.blur(compared.astype(np.float32), (segments.window, segments.window))
    mean = cv2.blur(np.where(compared, difference, np.float32(0)), (segments.window, segments.window))
    mean /= np.maximum(ones, LEAST_SHARE)
    mismatch = np.zeros(2 * count + 1)
    for n in np.unique(parts[compared & ~displaced & (parts > 0)]):
        inside = compared & ~displaced & (parts == n)
        deviation = MEAN_DEVIATION * median(np.abs(mean[inside] - median(mean[inside])))
        texture = median(segments.gradient[inside])
        mismatch[n] = deviation * texture / (texture + GRADIENT_NOISE) ** 2
    visible = (visible > 0.7) & (size >= segments.min_pixels)
    limit = 1.2 * max(COMMON_MISMATCH, quartile(mismatch[visible]))
    return (visible & (moves < 0.1) & (np.abs(distance) < 1) & (mismatch < limit))[count + 1 :]


def compared(depth, intensity, moves, gap, difference, marks, noise):
    """Shift of two images that saturate at 1, and readings: those that agree, all, and those of the older image."""
    agreeing = np.count_nonzero(np.abs(gap) < AGREEING_SIGMAS * (noise.base + noise.scale * depth**2))
    sigma = noise.base + noise.scale * (depth * depth)
    tolerance = edge_tolerance.py_func(sigma, depth, noise.edge_sigmas, noise.edge_slope)
    common = (marks == 0) & ~moves & (np.abs(gap) < tolerance)
    gain, offset = fit_exposure(intensity, difference, common.astype(np.float32))
    older = difference + intensity
    common &= (intensity > 0) & (intensity < 1) & (older > 0) & (older < 1)
    difference = difference + np.float32(1 - gain) * intensity - np.float32(offset)
    down, across = np.gradient(intensity)
    contrast = gain * float(median(np.sqrt(down**2 + across**2)[common]))
    shift = np.sqrt(2) * median(np.abs(difference[common])) / contrast
    return shift, agreeing, np.count_nonzero(depth), np.count_nonzero(np.isfinite(gap))
