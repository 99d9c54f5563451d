"""Comparison of an image with an older one that is seen from its pose."""

import numpy as np

from dudmap.core.backends.cpu.evidence import edge_tolerance, exact_sigma
from dudmap.core.backends.cpu.exposure import fit_exposure
from dudmap.core.backends.median import nth
from dudmap.core.backends.threads import exact

AGREEING_SIGMAS = 3 * np.sqrt(2)
"""Difference of two readings of one surface that noise explains, in standard deviations of one of them."""
ZERO, HALF = np.float32(0), np.float32(0.5)


@exact
def compare_images(depth, intensity, moving, gap, difference, marks, noise, fewest):
    """Distance by which two images lie beside each other, and how many of their readings agree.

    Args:
        depth, intensity: (h, w) float32; depth in metres, 0 = none.
        moving: (h, w) bool, pixels that move.
        gap, difference, marks: Of the older image, whose moving pixels are marked, see ``Reprojection``.
        noise: NoiseParameters, all float32.
        fewest: Pixels that must show the same static surface in both.

    Returns:
        The distance, see ``ImageConsistency.compare``; pixels, NaN where it is not known. Readings whose depth agrees
        within AGREEING_SIGMAS, all readings, and those at whose place the older image has one.
    """
    h, w = depth.shape
    agreeing, readings, seen, count = 0, 0, 0, 0
    common, contrasts, errors = np.empty((h, w), np.bool_), np.empty(h * w, np.float32), np.empty(h * w, np.float32)
    for v in range(h):
        for u in range(w):
            z, step = depth[v, u], abs(gap[v, u])
            sigma = exact_sigma(z, noise.base, noise.scale)
            agreeing += step < AGREEING_SIGMAS * sigma
            readings += z != ZERO
            seen += np.isfinite(step)
            tolerance = edge_tolerance(sigma, z, noise.edge_sigmas, noise.edge_slope)
            common[v, u] = marks[v, u] == 0 and not moving[v, u] and step < tolerance
            count += common[v, u]
    if count < fewest:
        return np.nan, agreeing, readings, seen
    gain, offset = fit_exposure(intensity, difference, common)
    slope, shift, count = np.float32(1 - gain), np.float32(offset), 0
    for v in range(h):
        for u in range(w):
            if common[v, u]:
                down = intensity[min(v + 1, h - 1), u] - intensity[max(v - 1, 0), u]
                across = intensity[v, min(u + 1, w - 1)] - intensity[v, max(u - 1, 0)]
                down = HALF * down if 0 < v < h - 1 else down
                across = HALF * across if 0 < u < w - 1 else across
                contrasts[count] = np.sqrt(down * down + across * across)
                errors[count] = abs(difference[v, u] + slope * intensity[v, u] - shift)
                count += 1
    contrast = np.float64(nth(contrasts[:count], count // 2))
    error = np.float64(nth(errors[:count], count // 2))
    return (np.sqrt(2.0) * error / contrast if contrast > 0 else np.nan), agreeing, readings, seen
