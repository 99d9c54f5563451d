"""The eight voxels around points of the map: what a trilinear interpolation loads.

For two thirds of all points one block holds all eight, and four loads of two words fetch them. A branch on that is
mispredicted for every third point: of a row of points, those of the other third are listed first, without a branch, and
looked up once more on their own. The voxels of points that come later in the row are prefetched.
"""

import numpy as np

from dudmap.core.backends.cpu.memory import load_pair, prefetch
from dudmap.core.backends.threads import kernel, scalar

AHEAD = 16
"""Points between that whose voxels are loaded and that whose voxels are prefetched."""


@kernel
def load_corners(window, geometry, cell, voxel, size_y, size_z, corners, u):
    """Words of the eight voxels around a point into ``corners[:, u]``, int32, corner 4 dx + 2 dy + dz; 0 = unknown.

    ``cell`` and ``voxel`` say which one lies at its lower corner. ``corners`` has two axes: eight words in a row would
    be read back by one vector load, which waits for all stores.
    """
    # 1 along the axes where the next voxel lies in the next block
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
    """Largest x, y, z of a lattice point of a window of ``shape`` blocks that has eight voxels around it, int32."""
    return np.int32(shape[0] * 8 - 2), np.int32(shape[1] * 8 - 2), np.int32(shape[2] * 8 - 2)


@scalar
def locate(x, y, z, last, size_y, size_z):
    """Where ``load_row`` finds the eight voxels around a point of the window's lattice, voxels.

    Args:
        x, y, z: The point, float32.
        last: See ``last_corner``.
        size_y, size_z: Blocks of the window.

    Returns:
        Cell; voxel; 1 where the eight voxels lie in more than one block, else 0; whether the point lies inside, without
        which the others are those of another point; fractions of its coordinates.
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

    Those of the points, a third, whose eight voxels lie in several blocks are looked up on their own.

    Args:
        window: (Wx * Wy * Wz,) int32 voxel slots, negative = no voxels.
        shape: (3,) int64 blocks of the window.
        geometry: (slots * 512,) int32 packed voxels.
        cells: (w + AHEAD,) int32, cell of the window that holds the point; any cell behind the last one.
        voxels: (w + AHEAD,) int32, number within the block of the voxel at its lower corner.
        crossing: (w,) int32, 1 where the eight voxels of a point lie in more than one block, else 0, and 0 for points
            whose words are not used.
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
    """Place of a voxel's word, and all bits where there is one, else none."""
    slot = np.int64(window[np.uintp(cell)])
    return slot * 512 + voxel, ~(slot >> 63)
