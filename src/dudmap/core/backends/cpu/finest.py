"""The finest observed voxels around a point of a map with several voxel sizes.

Blocks of the coarsest level are found in the window, finer ones through their parents: ``children1[slot, octant]`` is
the slot of the block that covers an octant with voxels of half the size, and ``children2`` likewise a level deeper.
"""

import numpy as np

from dudmap.core.backends.cpu.neighbors import load_corners
from dudmap.core.backends.threads import kernel

i64 = np.int64


@kernel
def _slot_at(window, shape, bx, by, bz):
    """Slot of a block of the window, -1 outside of it; negative where there is none."""
    if bx < 0 or by < 0 or bz < 0 or bx >= shape[0] or by >= shape[1] or bz >= shape[2]:
        return np.int32(-1)
    return window[(bx * shape[1] + by) * shape[2] + bz]


@kernel
def half_word(window, shape, children1, voxels1, i, j, k):
    """Word of the voxel (i, j, k) of the lattice with half the spacing; 0 = none."""
    slot = _slot_at(window, shape, i >> 4, j >> 4, k >> 4)
    if slot < 0 or slot >= len(children1):
        return np.int32(0)
    child = children1[slot, 4 * ((i >> 3) & 1) + 2 * ((j >> 3) & 1) + ((k >> 3) & 1)]
    return voxels1[child, ((i & 7) * 8 + (j & 7)) * 8 + (k & 7)] if child >= 0 else np.int32(0)


@kernel
def quarter_word(window, shape, children1, children2, voxels2, i, j, k):
    """Word of the voxel (i, j, k) of the lattice with a quarter of the spacing; 0 = none."""
    slot = _slot_at(window, shape, i >> 5, j >> 5, k >> 5)
    if slot < 0 or slot >= len(children1):
        return np.int32(0)
    child = children1[slot, 4 * ((i >> 4) & 1) + 2 * ((j >> 4) & 1) + ((k >> 4) & 1)]
    if child < 0 or child >= len(children2):
        return np.int32(0)
    small = children2[child, 4 * ((i >> 3) & 1) + 2 * ((j >> 3) & 1) + ((k >> 3) & 1)]
    return voxels2[small, ((i & 7) * 8 + (j & 7)) * 8 + (k & 7)] if small >= 0 else np.int32(0)


@kernel
def finest_at(window, shape, children1, children2, x, y, z):
    """Finest level whose block covers a point of the window's lattice (coarsest voxels), 0 to 2."""
    i, j, k = i64(np.floor(x)), i64(np.floor(y)), i64(np.floor(z))
    slot = window[((i >> 3) * shape[1] + (j >> 3)) * shape[2] + (k >> 3)]
    if slot < 0 or slot >= len(children1):
        return 0
    child = children1[slot, 4 * ((i >> 2) & 1) + 2 * ((j >> 2) & 1) + ((k >> 2) & 1)]
    if child < 0:
        return 0
    if child >= len(children2):
        return 1
    small = children2[child, 4 * ((i >> 1) & 1) + 2 * ((j >> 1) & 1) + ((k >> 1) & 1)]
    return 2 if small >= 0 else 1


@kernel
def corners_at(level, window, shape, children1, children2, voxels0, voxels1, voxels2, x, y, z, corners):
    """Words of the eight voxels of a level around a point of the window's lattice; 0 = none.

    Args:
        level: 0 to 2.
        window, shape: Of the coarsest level.
        children1, children2: (slots, 8) int32.
        voxels0: (slots * 512,) int32; voxels1, voxels2: (slots, 512) int32.
        x, y, z: Point in coarsest voxels, inside the window less one voxel.
        corners: (8, 1) int32 out, number 4 dx + 2 dy + dz.

    Returns:
        Place of the point between the voxels, in [0, 1).
    """
    scale = np.float32(1 << level)
    x, y, z = x * scale, y * scale, z * scale
    lx, ly, lz = np.floor(x), np.floor(y), np.floor(z)
    i, j, k = i64(lx), i64(ly), i64(lz)
    if level == 0:
        load_corners(window, voxels0, i, j, k, corners, 0, shape[1], shape[2])
    else:
        for m in range(8):
            a, b, c = i + (m >> 2), j + ((m >> 1) & 1), k + (m & 1)
            if level == 1:
                corners[m, 0] = half_word(window, shape, children1, voxels1, a, b, c)
            else:
                corners[m, 0] = quarter_word(window, shape, children1, children2, voxels2, a, b, c)
    return x - lx, y - ly, z - lz


@kernel
def least_weight(corners):
    """Smallest weight among eight words."""
    least = np.int32(255)
    for m in range(8):
        least = min(least, (corners[m, 0] >> 8) & 0xFF)
    return least
