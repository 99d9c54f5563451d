"""The eight voxels around points of the map: what a trilinear interpolation loads.

For two thirds of all points one block holds all eight. A branch on that is mispredicted for every third point. A single
point therefore always takes eight look-ups; of a row of points, those of the other third are listed first, without a
branch, and both kinds are loaded by vector instructions.
"""

import numpy as np

from dudmap.core.backends.cpu.gathers import LANES, load_voxels, load_voxels_of_blocks
from dudmap.core.backends.threads import kernel, scalar


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
def load_row(window, shape, geometry, cells, voxels, crossing, wanted, outer, words):
    """Words of the eight voxels around each point of a row, 0 = unknown.

    Those of the points, a third, whose eight voxels lie in several blocks are looked up on their own.

    Args:
        window: (Wx * Wy * Wz,) int32 voxel slots, negative = no voxels.
        shape: (3,) int64 blocks of the window.
        geometry: (slots * 512,) int32 packed voxels.
        cells: (w,) int32, cell of the window that holds the point; w is a multiple of ``LANES``.
        voxels: (w,) int32, number within the block of the voxel at its lower corner.
        crossing: (w,) int32, 1 where the eight voxels of a wanted point lie in more than one block, else 0.
        wanted: (w,) uint8, 0 where nothing need be loaded; points are left out by ``LANES``.
        outer: (w + LANES,) int32, work space.
        words: (8, w) int32 out, corner 4 dx + 2 dy + dz.
    """
    flat, groups, num_outer = words.reshape(-1), wanted.view(np.uint64), np.uintp(0)
    for u in range(len(cells)):
        outer[num_outer] = u
        num_outer += np.uintp(crossing[u])
    for start in range(0, len(cells), LANES):
        if groups[start // LANES] != 0:
            load_voxels(window, geometry, cells, voxels, crossing, start, flat, len(cells))
    if num_outer > 0:
        outer[num_outer : num_outer + np.uintp(LANES)] = outer[num_outer - np.uintp(1)]
    for start in range(0, num_outer, LANES):
        load_voxels_of_blocks(window, shape[1], shape[2], geometry, cells, voxels, outer, start, flat, len(cells))
