"""Distance field with one or several voxel sizes, for rendering."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.neighbors import load_corners
from dudmap.core.backends.threads import scalar, written_out
from dudmap.core.formulas.residual import trilinear
from dudmap.core.formulas.voxel import sdf_steps


class FinerLevels(NamedTuple):
    """Finer levels of a map, larger voxels first.

    Attributes:
        children: Per level (slots of the next coarser, 8) int32 slot in each octant, -1 = none, also beyond the last
            row.
        geometry, colors: Per level (slots, 512) int32 packed voxels and colours.
    """

    children: tuple[NDArray[np.int32], ...] = (np.full((0, 8), -1, np.int32),)
    geometry: tuple[NDArray[np.int32], ...] = ()
    colors: tuple[NDArray[np.int32], ...] = ()


@scalar
def block_at(window, shape, children, level, i, j, k):
    """Slot of a level's block with voxel (i, j, k); negative = none."""
    bits = level + 3
    bx, by, bz = i >> bits, j >> bits, k >> bits
    if bx < 0 or by < 0 or bz < 0 or bx >= shape[0] or by >= shape[1] or bz >= shape[2]:
        return np.int32(-1)
    slot = window[(bx * shape[1] + by) * shape[2] + bz]
    for finer in range(level):
        bit = bits - 1 - finer
        octant = 4 * ((i >> bit) & 1) + 2 * ((j >> bit) & 1) + ((k >> bit) & 1)
        slot = children[finer][slot, octant] if 0 <= slot < len(children[finer]) else np.int32(-1)
    return slot


@scalar
def load(window, shape, children, voxels, level, x, y, z, corners):
    """Load a level's words around a lattice point into ``corners[:, 0]``, number 4 dx + 2 dy + dz, 0 = none; returns
    its position between them, in [0, 1)."""
    scale = np.float32(1 << level)
    x, y, z = x * scale, y * scale, z * scale
    lx, ly, lz = np.floor(x), np.floor(y), np.floor(z)
    if level == 0:
        i, j, k = np.int64(lx), np.int64(ly), np.int64(lz)
        cell, voxel = ((i >> 3) * shape[1] + (j >> 3)) * shape[2] + (k >> 3), ((i & 7) * 8 + (j & 7)) * 8 + (k & 7)
        load_corners(window, voxels[0], cell, voxel, shape[1], shape[2], corners, np.uintp(0))
        return x - lx, y - ly, z - lz
    for m in range(8):
        i, j, k = np.int64(lx) + (m >> 2), np.int64(ly) + ((m >> 1) & 1), np.int64(lz) + (m & 1)
        slot = np.int64(block_at(window, shape, children, level, i, j, k))
        voxel = ((i & 7) * 8 + (j & 7)) * 8 + (k & 7)
        corners[m, 0] = voxels[level][slot * 512 + voxel] if slot >= 0 else np.int32(0)
    return x - lx, y - ly, z - lz


@scalar
def blend(values, ax, ay, az):
    """Trilinear interpolation of eight corner values."""
    value, _, _, _ = trilinear(
        values[0], values[1], values[2], values[3], values[4], values[5], values[6], values[7], ax, ay, az
    )
    return value


@scalar
def sample(window, shape, children, voxels, x, y, z, least, corners, values):
    """Signed distance in steps at lattice point (x, y, z) by the smallest known voxels, and its level; NaN if
    unknown."""
    for above in range(len(voxels)):
        level = len(voxels) - 1 - above
        if level > 0:
            scale = np.float32(1 << level)
            i, j, k = np.int64(np.floor(x * scale)), np.int64(np.floor(y * scale)), np.int64(np.floor(z * scale))
            if block_at(window, shape, children, level, i, j, k) < 0:
                continue
        ax, ay, az = load(window, shape, children, voxels, level, x, y, z, corners)
        known = True
        for k in range(8):
            word = corners[k, 0]
            known &= ((word >> 8) & 0xFF) >= least
            values[k] = sdf_steps(word)
        if known:
            return blend(values, ax, ay, az), level
    return np.float32(np.nan), 0


@written_out
def corner_gradient(s0, s1, s2, s3, s4, s5, s6, s7, fx, fy, fz):
    """Gradient of trilinear interpolation of eight corners, 4 dx + 2 dy + dz, at (fx, fy, fz) in [0, 1]^3."""
    one = np.float32(1)
    wy, wz = one - fy, one - fz
    wx = one - fx
    gx = ((s4 - s0) * wz + (s5 - s1) * fz) * wy + ((s6 - s2) * wz + (s7 - s3) * fz) * fy
    gy = ((s2 - s0) * wz + (s3 - s1) * fz) * wx + ((s6 - s4) * wz + (s7 - s5) * fz) * fx
    gz = ((s1 - s0) * wy + (s3 - s2) * fy) * wx + ((s5 - s4) * wy + (s7 - s6) * fy) * fx
    return gx, gy, gz
