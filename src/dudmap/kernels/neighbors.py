"""The eight voxels around points of the map: what a trilinear interpolation loads.

For two thirds of all points one block holds all eight. A branch on that is mispredicted for every third point, which
also ends the prefetching of the next ones. A single point therefore always takes eight look-ups; a row of points is
divided into two lists first, without a branch.
"""

import numpy as np

from dudmap.kernels.memory import pair, prefetch
from dudmap.kernels.threads import kernel


@kernel
def load_corners(window, geometry, ix, iy, iz, corners, u, size_y, size_z):
    """Words of the eight voxels around lattice point (ix, iy, iz) into ``corners[:, u]``, int32; 0 = unknown.

    ``corners`` has two axes: eight words in a row would be read back by one vector load, which waits for all stores.
    """
    x0, y0, z0 = ix & 7, iy & 7, iz & 7
    x1, y1, z1 = (ix + 1) & 7, (iy + 1) & 7, (iz + 1) & 7
    bx0, by0, bz0 = (ix >> 3) * size_y, iy >> 3, iz >> 3
    bx1, by1, bz1 = ((ix + 1) >> 3) * size_y, (iy + 1) >> 3, (iz + 1) >> 3
    row = (bx0 + by0) * size_z
    slot0, slot1 = window[np.uintp(row + bz0)], window[np.uintp(row + bz1)]
    row = (bx0 + by1) * size_z
    slot2, slot3 = window[np.uintp(row + bz0)], window[np.uintp(row + bz1)]
    row = (bx1 + by0) * size_z
    slot4, slot5 = window[np.uintp(row + bz0)], window[np.uintp(row + bz1)]
    row = (bx1 + by1) * size_z
    slot6, slot7 = window[np.uintp(row + bz0)], window[np.uintp(row + bz1)]
    voxel = (x0 * 8 + y0) * 8
    corners[0, u] = _voxel(geometry, slot0, voxel + z0)
    corners[1, u] = _voxel(geometry, slot1, voxel + z1)
    voxel = (x0 * 8 + y1) * 8
    corners[2, u] = _voxel(geometry, slot2, voxel + z0)
    corners[3, u] = _voxel(geometry, slot3, voxel + z1)
    voxel = (x1 * 8 + y0) * 8
    corners[4, u] = _voxel(geometry, slot4, voxel + z0)
    corners[5, u] = _voxel(geometry, slot5, voxel + z1)
    voxel = (x1 * 8 + y1) * 8
    corners[6, u] = _voxel(geometry, slot6, voxel + z0)
    corners[7, u] = _voxel(geometry, slot7, voxel + z1)


@kernel
def _voxel(geometry, slot, voxel):
    """Word of a voxel, 0 without a slot; the load does not depend on the test of the slot."""
    word = geometry[np.uintp(np.int64(max(slot, 0)) * 512 + voxel)]
    return word if slot >= 0 else np.int32(0)


@kernel
def load_row(window, shape, geometry, cells, voxels, crossing, lists, positions, corners, pairs):
    """Words of the eight voxels around each point of a row, 0 = unknown.

    All addresses are computed and prefetched before the first load.

    Args:
        window: (Wx * Wy * Wz,) int32 voxel slots, negative = no voxels.
        shape: (3,) int64 blocks of the window.
        geometry: (slots * 512,) int32 packed voxels.
        cells: (w,) int32, cell of the window that holds the point.
        voxels: (w,) int32, number within the block of the voxel at its lower corner.
        crossing: (w,) int32, 1 where the eight voxels lie in more than one block, 0 elsewhere.
        lists, positions, corners: (2, w + 1) int32, (w,) int64, (w, 8) int64, work space.
        pairs: (4, w) int64 out: two neighbours along z in each, at (x, y), (x, y + 1), (x + 1, y), (x + 1, y + 1).
    """
    inner, outer = lists[0], lists[1]
    words, row = pairs.view(np.int32).reshape(-1), np.uintp(2 * pairs.shape[1])
    num_inner, num_outer = np.uintp(0), np.uintp(0)
    for u in range(len(cells)):
        inner[num_inner] = outer[num_outer] = u
        crosses = np.int64(crossing[u])
        num_outer += np.uintp(crosses)
        num_inner += np.uintp(1 - crosses)
        position = _position(np.int64(window[np.uintp(cells[u])]), np.int64(voxels[u]))
        positions[u] = position
        own, near = np.uintp(max(position, 0)), np.uintp(crosses - 1)  # near: all bits, or none where it crosses
        prefetch(geometry, own)
        prefetch(geometry, own + (np.uintp(8) & near))
        prefetch(geometry, own + (np.uintp(64) & near))
        prefetch(geometry, own + (np.uintp(72) & near))
    for n in range(num_outer):
        u = np.uintp(outer[n])
        _find_corners(window, np.int64(cells[u]), np.int64(voxels[u]), shape[1], shape[2], corners[n])
        for i in range(8):
            prefetch(geometry, np.uintp(max(corners[n, i], 0)))
    for n in range(num_inner):
        u = np.uintp(inner[n])
        own, known = np.uintp(max(positions[u], 0)), ~(positions[u] >> 63)
        pairs[0, u] = pair(geometry, own) & known
        pairs[1, u] = pair(geometry, own + np.uintp(8)) & known
        pairs[2, u] = pair(geometry, own + np.uintp(64)) & known
        pairs[3, u] = pair(geometry, own + np.uintp(72)) & known
    for n in range(num_outer):
        k = np.uintp(2 * outer[n])
        for i in range(4):
            words[k] = _word(geometry, corners[n, 2 * i])
            words[k + np.uintp(1)] = _word(geometry, corners[n, 2 * i + 1])
            k += row


@kernel
def _find_corners(window, cell, voxel, size_y, size_z, positions):
    """Write the indices of the eight voxels from ``voxel`` of the block in ``cell`` upwards; -1 = unknown."""
    x, y, z = ((voxel >> 6) + 1) >> 3, (((voxel >> 3) & 7) + 1) >> 3, ((voxel & 7) + 1) >> 3  # 1 where the next crosses
    to_x, to_y, to_z = x * size_y * size_z, y * size_z, z
    step_x, step_y, step_z = 64 - 512 * x, 8 - 64 * y, 1 - 8 * z
    for i in range(2):
        for j in range(2):
            c, n = cell + i * to_x + j * to_y, voxel + i * step_x + j * step_y
            positions[4 * i + 2 * j] = _position(np.int64(window[np.uintp(c)]), n)
            positions[4 * i + 2 * j + 1] = _position(np.int64(window[np.uintp(c + to_z)]), n + step_z)


@kernel
def _position(slot, voxel):
    """Index of a voxel of a slot; -1 if there is no slot."""
    return slot * 512 + voxel if slot >= 0 else np.int64(-1)


@kernel
def _word(geometry, position):
    """Word of a voxel, 0 at index -1; the load does not depend on the test of the index."""
    return geometry[np.uintp(max(position, 0))] & np.int32(~(position >> 63))
