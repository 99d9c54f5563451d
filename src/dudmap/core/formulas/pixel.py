"""Formulas of a pixel: rays, motions, projection, depth noise, truncation band.

Plain arithmetic on float32, for other compilers than Numba. A rigid motion (3, 4) is passed as its twelve elements, row
by row (``elements``).
"""

import numpy as np

from dudmap.config import reading_sigma
from dudmap.core.backends.threads import scalar, written_out

f32, sqrt = np.float32, np.sqrt
STEEPEST = f32(7.9)
"""Tangent of 83 degrees, the largest angle to the image plane of a normal's neighbours; sensors measure up to 84."""
UNKNOWN_COSINE = f32(0.3)
"""Cosine of incidence assumed at depth edges."""

_sigma = scalar(reading_sigma)


@scalar
def elements(T):
    """Elements of a motion (3, 4) by rows, as a tuple in registers."""
    return (
        T[0, 0], T[0, 1], T[0, 2], T[0, 3],
        T[1, 0], T[1, 1], T[1, 2], T[1, 3],
        T[2, 0], T[2, 1], T[2, 2], T[2, 3],
    )  # fmt: skip


@scalar
def rotate(t, x, y, z):
    """Apply a motion's linear part to a vector."""
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
    """Ray coordinate at depth 1 of pixel ``u``; principal point ``c``, focal length ``f``."""
    return (f32(u) - c) / f


@scalar
def project(x, by_z, f, c):
    """Pixel of a point with coordinate ``x`` and reciprocal depth ``by_z`` (thesis eq. 4.4)."""
    return x * by_z * f + c


@scalar
def sigma(z, noise):
    """Standard deviation of a depth measurement at depth ``z``, metres."""
    return _sigma(z, noise.base, noise.scale)


@scalar
def band_front(z, band):
    """Truncation band in front of a measurement, metres: at least ``band.sigmas`` sigma(z)."""
    return max(band.front, band.sigmas * sigma(z, band.noise))


@scalar
def band_behind(z, band):
    """Truncation band behind a measurement, metres."""
    return max(band.behind, band.sigmas * sigma(z, band.noise))


@written_out
def free_depth(z, near, band):
    """Depth of certain free space, metres: the nearest depth around minus its band.

    Args:
        z: Depth at the pixel, 0 = none.
        near: Nearest depth around.
        band: TruncationBand.
    """
    free = near - min(band_front(near, band), band.limit)
    return max(free, f32(0)) if z > f32(0) else f32(0)


@written_out
def reading_weight(z, left, right, up, down, x, y, fx, by_rows, best, noise):
    """Weight of a measurement, 1 to 16, 0 without: cos(theta) / err(z) (eq. 4.20).

    Args:
        z: Depth, metres.
        left, right, up, down: Neighbouring depths.
        x, y: Ray at depth 1.
        fx: Focal length, pixels.
        by_rows: Focal length in rows over rows between ``up`` and ``down``.
        best: Weight at normal incidence and reference depth.
        noise: SensorNoise; err(z) is sigma(z).
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
