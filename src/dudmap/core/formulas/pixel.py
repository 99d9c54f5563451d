"""Scalar formulas of a pixel: rays, rigid motions, projection, depth noise and truncation band.

Each function is plain arithmetic on float32 numbers, so that compilers other than Numba accept the same source. A rigid
motion (3, 4) is passed as its twelve elements, row by row (``elements``).
"""

import numpy as np

from dudmap.config import reading_sigma
from dudmap.core.backends.threads import scalar, written_out

f32, sqrt = np.float32, np.sqrt
STEEPEST = f32(7.9)
"""Tangent of 83 degrees, the largest angle between surface and image plane at which neighbours define the normal;
sensors measure up to 84."""
UNKNOWN_COSINE = f32(0.3)
"""Cosine of the angle of incidence assumed at depth edges."""

_sigma = scalar(reading_sigma)


@scalar
def elements(T):
    """Elements of a motion (3, 4), row by row, as a tuple: registers need no loads in inner loops."""
    return (
        T[0, 0], T[0, 1], T[0, 2], T[0, 3],
        T[1, 0], T[1, 1], T[1, 2], T[1, 3],
        T[2, 0], T[2, 1], T[2, 2], T[2, 3],
    )  # fmt: skip


@scalar
def rotate(t, x, y, z):
    """Apply the linear part of a motion to a vector."""
    return t[0] * x + t[1] * y + t[2] * z, t[4] * x + t[5] * y + t[6] * z, t[8] * x + t[9] * y + t[10] * z


@scalar
def transform(t, x, y, z):
    """Apply a motion to a point."""
    return (
        t[0] * x + t[1] * y + t[2] * z + t[3],
        t[4] * x + t[5] * y + t[6] * z + t[7],
        t[8] * x + t[9] * y + t[10] * z + t[11],
    )


@scalar
def ray(u, c, f):
    """Coordinate, at depth 1, of the ray through pixel coordinate ``u``; principal point ``c``, focal length ``f``."""
    return (f32(u) - c) / f


@scalar
def project(x, by_z, f, c):
    """Pixel coordinate of a point with coordinate ``x`` and reciprocal depth ``by_z`` (thesis eq. 4.4)."""
    return x * by_z * f + c


@scalar
def sigma(z, noise):
    """Standard deviation of a depth measurement at depth ``z``, metres."""
    return _sigma(z, noise.base, noise.scale)


@scalar
def band_front(z, band):
    """Width of the truncation band in front of a measurement at depth ``z``, metres: at least ``band.sigmas``
    sigma(z).
    """
    return max(band.front, band.sigmas * sigma(z, band.noise))


@scalar
def band_behind(z, band):
    """Width of the truncation band behind a measurement at depth ``z``, metres."""
    return max(band.behind, band.sigmas * sigma(z, band.noise))


@written_out
def free_depth(z, near, band):
    """Depth up to which a pixel certainly sees free space, metres: the nearest depth around it minus its truncation
    band.

    Args:
        z: Depth at the pixel, 0 = none.
        near: Nearest depth of its neighbourhood.
        band: TruncationBand.
    """
    free = near - min(band_front(near, band), band.limit)
    return max(free, f32(0)) if z > f32(0) else f32(0)


@written_out
def reading_weight(z, left, right, up, down, x, y, fx, by_rows, best, noise):
    """Weight of a depth measurement, 1 to 16, 0 without one: cos(theta) / err(z) (eq. 4.20).

    Args:
        z: Depth, metres.
        left, right, up, down: Depths of the neighbouring pixels.
        x, y: Coordinates of its ray at depth 1.
        fx: Focal length, pixels.
        by_rows: Focal length in rows over the rows between ``up`` and ``down``.
        best: Weight at normal incidence and the reference depth.
        noise: SensorNoise, whose sigma(z) is err(z).
    """
    zero, half, one = f32(0), f32(0.5), f32(1)
    # gradient of the surface z(u, v) in pixels; the normal is (fx dz/du, fy dz/dv, -(z + x fx dz/du + ..)), and its
    # product with the ray (x, y, 1) is -z
    gu, gv = half * fx * (right - left), by_rows * (down - up)
    nz = z + x * gu + y * gv
    cosine = z / sqrt((gu * gu + gv * gv + nz * nz) * (x * x + y * y + one))
    smooth = (min(min(left, right), min(up, down)) > zero) & (max(abs(gu), abs(gv)) < STEEPEST * z)
    cosine = cosine if smooth else UNKNOWN_COSINE
    weight = best * cosine * (noise.base + noise.scale * (noise.reference * noise.reference)) / sigma(z, noise)
    return min(max(weight + half, one), f32(16)) if z > zero else zero
