"""Scalar mathematics of a residual: trilinear interpolation, robust costs and weights."""

import numpy as np

from dudmap.kernels.threads import scalar

f32 = np.float32


@scalar
def trilinear(v0, v1, v2, v3, v4, v5, v6, v7, ax, ay, az):
    """Trilinear interpolation of eight corner values, corner 4 dx + 2 dy + dz, at (ax, ay, az) in [0, 1]^3.

    Returns:
        Value, and its derivatives along x, y and z.
    """
    v01, v23 = v0 + (v1 - v0) * az, v2 + (v3 - v2) * az
    v45, v67 = v4 + (v5 - v4) * az, v6 + (v7 - v6) * az
    low, high = v01 + (v23 - v01) * ay, v45 + (v67 - v45) * ay
    along_y = (v23 - v01) + ((v67 - v45) - (v23 - v01)) * ax
    d01, d23, d45, d67 = v1 - v0, v3 - v2, v5 - v4, v7 - v6
    d_low, d_high = d01 + (d23 - d01) * ay, d45 + (d67 - d45) * ay
    return low + (high - low) * ax, high - low, along_y, d_low + (d_high - d_low) * ax


@scalar
def huber_weight(a, k):
    """Huber weight of an absolute residual (thesis eq. 4.44)."""
    return k / max(a, k)


@scalar
def huber_cost(a, k):
    """Huber cost of an absolute residual."""
    return min(a, k) * (a - f32(0.5) * min(a, k))


@scalar
def tukey_inlier(a, by_k):
    """1 - (a / k)^2 of Tukey's biweight, 0 beyond k (thesis eq. 4.45): its square is the weight."""
    capped = min(a * by_k, f32(1))
    return f32(1) - capped * capped


@scalar
def tukey_cost(inlier, limit):
    """Tukey cost of ``tukey_inlier``; ``limit`` = k^2 / 6 is that of an outlier."""
    return limit * (f32(1) - inlier * inlier * inlier)
