"""The distance field of a map with several voxel sizes as one lattice around a block of the coarsest level.

The field has one value at every point of the finest lattice: that of the finest voxel there, or, where no such voxel
has been observed, the linear interpolation between the points of the next coarser lattice. All cells that meet at a
point see the same value, on whatever level they are.
"""

import numpy as np

from dudmap.core.backends.threads import kernel, scalar

PAD = 3
"""Coarsest voxels around a block that the lattice reaches."""
SPAN = 8 + 2 * PAD
"""Coarsest cells along the edge of the lattice."""


@kernel
def finest_level(near, children1, children2):
    """Finest level, 0 to 2, among a block of the coarsest level and its neighbours ``near`` (27,)."""
    level = 0
    for n in range(27):
        slot = near[n]
        if slot < 0 or slot >= len(children1):
            continue
        for octant in range(8):
            child = children1[slot, octant]
            if child < 0:
                continue
            level = max(level, 1)
            if child < len(children2):
                for part in range(8):
                    if children2[child, part] >= 0:
                        return 2
    return level


@kernel
def may_hold_surface(near, geometry0, children1, least):
    """Whether a block of the coarsest level has finer voxels, or observed ones of both signs, up to one voxel beyond
    its upper sides; else there is no surface in its cells."""
    negative, positive = False, False
    for m in range(8):
        dx, dy, dz = m >> 2, (m >> 1) & 1, m & 1
        slot = near[13 + 9 * dx + 3 * dy + dz]
        if slot < 0:
            continue
        if slot < len(children1):
            for octant in range(8):
                if children1[slot, octant] >= 0:
                    return True
        for i in range(1 if dx else 8):
            for j in range(1 if dy else 8):
                for k in range(1 if dz else 8):
                    word = geometry0[slot, (i * 8 + j) * 8 + k]
                    known = ((word >> 8) & 0xFF) >= least
                    negative |= known & (word < 0)
                    positive |= known & (word >= 0)
    return negative & positive


@kernel
def _put(geometry, slot, x, y, z, size, least, unit, field):
    """Write the observed distances, metres, of a block whose first voxel is at (x, y, z) into a lattice."""
    for i in range(max(0, -x), min(8, size - x)):
        for j in range(max(0, -y), min(8, size - y)):
            for k in range(max(0, -z), min(8, size - z)):
                word = geometry[slot, (i * 8 + j) * 8 + k]
                if ((word >> 8) & 0xFF) >= least:
                    field[((x + i) * size + y + j) * size + z + k] = np.float32(word >> 16) * unit


@scalar
def _upsample(coarse, size, fine):
    """Field on a lattice of half the spacing, by linear interpolation; NaN where a point around is not known."""
    double = 2 * size - 1
    half = np.float32(0.5)
    for i in range(size):  # along z, then y, then x
        for j in range(size):
            for k in range(size):
                here = coarse[(i * size + j) * size + k]
                n = (2 * i * double + 2 * j) * double + 2 * k
                fine[n] = here
                if k + 1 < size:
                    fine[n + 1] = half * (here + coarse[(i * size + j) * size + k + 1])
    for i in range(size):
        for j in range(size - 1):
            n = (2 * i * double + 2 * j + 1) * double
            for k in range(double):
                fine[n + k] = half * (fine[n - double + k] + fine[n + double + k])
    plane = double * double
    for i in range(size - 1):
        n = (2 * i + 1) * plane
        for k in range(plane):
            fine[n + k] = half * (fine[n - plane + k] + fine[n + plane + k])


@kernel
def _mark(levels, cells, x, y, z, edge, level):
    """Set the level of the cells of a cube."""
    for i in range(max(0, x), min(cells, x + edge)):
        for j in range(max(0, y), min(cells, y + edge)):
            for k in range(max(0, z), min(cells, z + edge)):
                levels[(i * cells + j) * cells + k] = level


@kernel
def fill(near, geometry0, geometry1, geometry2, children1, children2, least, unit, top, buffers, levels):
    """Field around a block and level of each cell.

    Args:
        near: (27,) int32 slots of the block and its neighbours.
        geometry0, geometry1, geometry2: (slots, 512) int32 voxels of the levels.
        children1, children2: (slots, 8) int32 of the levels 1 and 2.
        least: Smallest trusted weight.
        unit: Metres per step of a stored distance.
        top: Finest level around the block; its lattice has ``SPAN * 2^top`` cells along each edge.
        buffers: Three float32 arrays for the fields of the levels, flat; that of ``top`` is the result, NaN where
            nothing is known.
        levels: uint8 out, flat, by cell of the finest lattice.
    """
    cells = SPAN << top
    levels[: cells * cells * cells] = 0
    size = SPAN + 1
    field = buffers[0]
    field[: size * size * size] = np.float32(np.nan)
    for n in range(27):
        if near[n] >= 0:
            x, y, z = 8 * (n // 9 - 1) + PAD, 8 * ((n // 3) % 3 - 1) + PAD, 8 * (n % 3 - 1) + PAD
            _put(geometry0, near[n], x, y, z, size, least, unit, field)
    for level in range(1, top + 1):
        _upsample(buffers[level - 1], size, buffers[level])
        size = 2 * size - 1
        field = buffers[level]
        for n in range(27):
            slot = near[n]
            if slot < 0 or slot >= len(children1):
                continue
            bx, by, bz = 8 * (n // 9 - 1) + PAD, 8 * ((n // 3) % 3 - 1) + PAD, 8 * (n % 3 - 1) + PAD
            for octant in range(8):
                child = children1[slot, octant]
                if child < 0:
                    continue
                x, y, z = 2 * bx + 8 * (octant >> 2), 2 * by + 8 * ((octant >> 1) & 1), 2 * bz + 8 * (octant & 1)
                if level == 1:
                    _put(geometry1, child, x, y, z, size, least, unit, field)
                    shift = top - 1
                    _mark(levels, cells, x << shift, y << shift, z << shift, 8 << shift, 1)
                elif child < len(children2):
                    for part in range(8):
                        small = children2[child, part]
                        if small >= 0:
                            i, j, k = 2 * x + 8 * (part >> 2), 2 * y + 8 * ((part >> 1) & 1), 2 * z + 8 * (part & 1)
                            _put(geometry2, small, i, j, k, size, least, unit, field)
                            _mark(levels, cells, i, j, k, 8, 2)
