"""The eight voxels around points of the map.

Two thirds of all points have them in one block: four loads of two words. The others are listed and looked up
afterwards, without branches. Later points are prefetched.
"""

import numpy as np

from dudmap.core.backends.cpu.memory import load_pair, prefetch
from dudmap.core.backends.threads import kernel, scalar

AHEAD = 16


@kernel
def load_corners(window, geometry, cell, voxel, size_y, size_z, corners, u):
    """Load the words of the eight voxels around a point into ``corners[:, u]``, int32, corner 4 dx + 2 dy + dz; 0 =
    unknown.

    ``cell``, ``voxel``: lower corner. Two axes, because a vector load would wait for all stores.
    """
    # 1 along the axes whose next voxel lies in the next block
    x, y, z = ((voxel >> 6) + 1) >> 3, (((voxel >> 3) & 7) + 1) >> 3, ((voxel & 7) + 1) >> 3
    for corner in range(8):
        dx, dy, dz = corner >> 2, (corner >> 1) & 1, corner & 1
        slot = window[np.uintp(cell + dx * x * size_y * size_z + dy * y * size_z + dz * z)]
        corners[corner, u] = _voxel(geometry, slot, voxel + dx * (64 - 512 * x) + dy * (8 - 64 * y) + dz * (1 - 8 * z))


@kernel
def _voxel(geometry, slot, voxel):
    """Word of a voxel, 0 without a slot; the load does not depend on the test of the slot."""
    word = geometry[np.uintp(np.int64(max(slot, 0)) * 512 + voxel)]
    return word if slot >= 0 else np.int32(0)


@scalar
def last_corner(shape):
    """Largest x, y, z of a lattice point with eight voxels in a window of ``shape`` blocks, int32."""
    return np.int32(shape[0] * 8 - 2), np.int32(shape[1] * 8 - 2), np.int32(shape[2] * 8 - 2)


@scalar
def locate(x, y, z, last, size_y, size_z):
    """Address, for ``load_row``, of the eight voxels around a lattice point, voxels.

    Args:
        x, y, z: The point, float32.
        last: See ``last_corner``.
        size_y, size_z: Blocks of the window.

    Returns:
        Cell; voxel; 1 if in several blocks, else 0; whether inside; fractions of the coordinates. Outside, the others
        belong to another point.
    """
    lx, ly, lz = np.floor(x), np.floor(y), np.floor(z)
    jx, jy, jz = np.int32(lx), np.int32(ly), np.int32(lz)
    kx = min(max(jx, np.int32(0)), last[0])
    ky = min(max(jy, np.int32(0)), last[1])
    kz = min(max(jz, np.int32(0)), last[2])
    inside = (jx == kx) & (jy == ky) & (jz == kz)
    cell = np.int32(((kx >> 3) * size_y + (ky >> 3)) * size_z + (kz >> 3))
    voxel = np.int32(((kx & 7) * 8 + (ky & 7)) * 8 + (kz & 7))
    crosses = np.int32((((kx & 7) + 1) | ((ky & 7) + 1) | ((kz & 7) + 1)) >> 3)
    return cell, voxel, crosses, inside, x - lx, y - ly, z - lz


@scalar
def load_row(window, shape, geometry, cells, voxels, crossing, outer, words):
    """Words of the eight voxels around each point of a row, 0 = unknown.

    Args:
        window, shape, geometry: See ``VoxelGrid``; ``geometry`` is flat.
        cells: (w + AHEAD,) int32, window cell of the point; any after the last.
        voxels: (w + AHEAD,) int32, number in the block of its lower corner.
        crossing: (w,) int32, 1 if in several blocks; 0 for unused points.
        outer: (w,) int32, work space.
        words: (8, >= w) int32 out, corner 4 dx + 2 dy + dz.
    """
    num_outer = np.uintp(0)
    for u in range(len(crossing)):
        outer[num_outer] = u
        num_outer += np.uintp(crossing[u])
    for u in range(len(crossing)):
        coming, used = _first_word(window, cells[u + AHEAD], voxels[u + AHEAD])
        prefetch(geometry, np.uintp(coming & used))
        prefetch(geometry, np.uintp(coming & used) + np.uintp(64))
        first, used = _first_word(window, cells[u], voxels[u])
        used &= np.int64(crossing[u]) - 1
        place = np.uintp(first & used)
        near, beside = load_pair(geometry, place) & used, load_pair(geometry, place + np.uintp(8)) & used
        words[0, u], words[1, u] = np.int32(near), np.int32(near >> 32)
        words[2, u], words[3, u] = np.int32(beside), np.int32(beside >> 32)
        near = load_pair(geometry, place + np.uintp(64)) & used
        beside = load_pair(geometry, place + np.uintp(72)) & used
        words[4, u], words[5, u] = np.int32(near), np.int32(near >> 32)
        words[6, u], words[7, u] = np.int32(beside), np.int32(beside >> 32)
    for n in range(num_outer):
        u = np.uintp(outer[n])
        load_corners(window, geometry, np.int64(cells[u]), np.int64(voxels[u]), shape[1], shape[2], words, u)


@scalar
def _first_word(window, cell, voxel):
    """Index of a voxel's word, and a mask: all bits if it exists, else none."""
    slot = np.int64(window[np.uintp(cell)])
    return slot * 512 + voxel, ~(slot >> 63)
