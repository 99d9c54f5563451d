"""The eight voxels around points of the map: what a trilinear interpolation loads.

Two thirds of all points have all eight in one block. Whether they do is a branch that the processor guesses wrong for
every third point, and then it also stops asking the memory for the next ones. A single point therefore always takes
eight look-ups; a row of points is divided into two lists first, without a branch.
"""

import numpy as np

from dudmap.kernels.memory import pair, prefetch
from dudmap.kernels.threads import kernel


@kernel
def load_corners(window, geometry, ix, iy, iz, corners, u, size_y, size_z):
    """Words of the eight voxels around lattice point (ix, iy, iz) into ``corners[:, u]``, int32; 0 = unknown.

    Two axes, since the eight words of one would be read back by one vector load, which waits for all of the stores.
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
    """Word of a voxel; the load does not wait for the answer whether there is one."""
    word = geometry[np.uintp(np.int64(max(slot, 0)) * 512 + voxel)]
    return word if slot >= 0 else np.int32(0)


@kernel
def load_row(window, shape, geometry, cells, voxels, crossing, lists, places, corners, pairs):
    """Words of the eight voxels around each point of a row, 0 = unknown.

    All that will be loaded is found, and asked for, before the first of it is.

    Args:
        window: (Wx * Wy * Wz,) int32 voxel slots, negative = no voxels.
        shape: (3,) int64 blocks of the window.
        geometry: (slots * 512,) int32 packed voxels.
        cells: (w,) int32, cell of the window that holds the point.
        voxels: (w,) int32, number within the block of the voxel at its lower corner.
        crossing: (w,) int32, 1 where other blocks hold some of the eight, 0 elsewhere.
        lists, places, corners: (2, w + 1) int32, (w,) int64, (w, 8) int64, to work in.
        pairs: (4, w) int64 out: two neighbours along z in each, at (x, y), (x, y + 1), (x + 1, y), (x + 1, y + 1).
    """
    inner, outer = lists[0], lists[1]
    words, row = pairs.view(np.int32).reshape(-1), np.uintp(2 * pairs.shape[1])
    num_inner, num_outer = np.uintp(0), np.uintp(0)
    for u in range(len(cells)):
        inner[num_inner] = outer[num_outer] = u
        apart = np.int64(crossing[u])
        num_outer += np.uintp(apart)
        num_inner += np.uintp(1 - apart)
        place = _place(np.int64(window[np.uintp(cells[u])]), np.int64(voxels[u]))
        places[u] = place
        own, near = np.uintp(max(place, 0)), np.uintp(apart - 1)  # near: all bits, or none where others hold the rest
        prefetch(geometry, own)
        prefetch(geometry, own + (np.uintp(8) & near))
        prefetch(geometry, own + (np.uintp(64) & near))
        prefetch(geometry, own + (np.uintp(72) & near))
    for n in range(num_outer):
        u = np.uintp(outer[n])
        _find(window, np.int64(cells[u]), np.int64(voxels[u]), shape[1], shape[2], corners[n])
        for i in range(8):
            prefetch(geometry, np.uintp(max(corners[n, i], 0)))
    for n in range(num_inner):
        u = np.uintp(inner[n])
        own, known = np.uintp(max(places[u], 0)), ~(places[u] >> 63)
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
def _find(window, cell, voxel, size_y, size_z, places):
    """Places of the eight voxels from ``voxel`` of the block in ``cell`` upwards into ``places`` (8,); -1 = unknown."""
    x, y, z = ((voxel >> 6) + 1) >> 3, (((voxel >> 3) & 7) + 1) >> 3, ((voxel & 7) + 1) >> 3  # 1 where the next crosses
    to_x, to_y, to_z = x * size_y * size_z, y * size_z, z
    step_x, step_y, step_z = 64 - 512 * x, 8 - 64 * y, 1 - 8 * z
    for i in range(2):
        for j in range(2):
            c, n = cell + i * to_x + j * to_y, voxel + i * step_x + j * step_y
            places[4 * i + 2 * j] = _place(np.int64(window[np.uintp(c)]), n)
            places[4 * i + 2 * j + 1] = _place(np.int64(window[np.uintp(c + to_z)]), n + step_z)


@kernel
def _place(slot, voxel):
    """Where a voxel of a slot is; -1 if there is no slot."""
    return slot * 512 + voxel if slot >= 0 else np.int64(-1)


@kernel
def _word(geometry, place):
    """Word of a voxel; the load does not wait for the answer whether there is one."""
    return geometry[np.uintp(max(place, 0))] & np.int32(~(place >> 63))
