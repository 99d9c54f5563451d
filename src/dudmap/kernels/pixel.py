"""Scalar mathematics of a pixel: rays, rigid motions, projection, the noise of a reading and its truncation band.

Each function is plain arithmetic on float32 numbers, so that other compilers than Numba can take the same text.
A rigid motion (3, 4) is passed as its twelve elements, row by row (``elements``).
"""

import numpy as np

from dudmap.kernels.threads import scalar

f32 = np.float32


@scalar
def elements(T):
    """Elements of a motion (3, 4), row by row, as a tuple: held in registers, they need no loads in inner loops."""
    return (
        T[0, 0], T[0, 1], T[0, 2], T[0, 3],
        T[1, 0], T[1, 1], T[1, 2], T[1, 3],
        T[2, 0], T[2, 1], T[2, 2], T[2, 3],
    )  # fmt: skip


@scalar
def rotate(t, x, y, z):
    """Linear part of a motion, applied to a vector."""
    return t[0] * x + t[1] * y + t[2] * z, t[4] * x + t[5] * y + t[6] * z, t[8] * x + t[9] * y + t[10] * z


@scalar
def transform(t, x, y, z):
    """Motion, applied to a point."""
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
    """Standard deviation of a reading at depth ``z``, metres (thesis eq. 3.91)."""
    return noise.base + noise.scale * z * z


@scalar
def band_front(z, band):
    """Width of the truncation band in front of a reading at depth ``z``, metres: at least ``band.sigmas`` sigma(z)."""
    return max(band.front, band.sigmas * sigma(z, band.noise))


@scalar
def band_behind(z, band):
    """Width of the truncation band behind a reading at depth ``z``, metres."""
    return max(band.behind, band.sigmas * sigma(z, band.noise))
