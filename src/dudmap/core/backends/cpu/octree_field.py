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
def child_of(children, slot, octant):
    """Slot of the block in an octant of the block in ``slot``; -1 = none."""
    return children[slot, octant] if 0 <= slot < len(children) else np.int32(-1)


@kernel
def finest_level(near, children):
    """Finest level, 0 to 2, among a block of the coarsest level and its neighbours ``near`` (27,)."""
    level = 0
    for n in range(27):
        for octant in range(8):
            child = child_of(children[0], near[n], octant)
            if child >= 0:
                level = max(level, 1)
                for part in range(8):
                    if child_of(children[1], child, part) >= 0:
                        return 2
    return level


@kernel
def may_hold_surface(near, coarsest, children, least):
    """Whether a block of the coarsest level has finer voxels, or observed ones of both signs, up to one voxel beyond
    its upper sides; else there is no surface in its cells."""
    negative, positive = False, False
    for m in range(8):
        dx, dy, dz = m >> 2, (m >> 1) & 1, m & 1
        slot = near[13 + 9 * dx + 3 * dy + dz]
        if slot < 0:
            continue
        for octant in range(8):
            if child_of(children, slot, octant) >= 0:
                return True
        for i in range(1 if dx else 8):
            for j in range(1 if dy else 8):
                for k in range(1 if dz else 8):
                    word = coarsest[slot, (i * 8 + j) * 8 + k]
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
def fill(near, geometry, children, least, unit, top, buffers, levels):
    """Field around a block and level of each cell.

    Args:
        near: (27,) int32 slots of the block and its neighbours.
        geometry, children: As of ``contour_blocks``.
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
    buffers[0][: size * size * size] = np.float32(np.nan)
    for level in range(top + 1):
        if level > 0:
            _upsample(buffers[level - 1], size, buffers[level])
            size = 2 * size - 1
        for n in range(27):
            for part in range(1 << (3 * level)):  # the octants on the way down, three bits each
                slot = near[n]
                x, y, z = 8 * (n // 9 - 1) + PAD, 8 * ((n // 3) % 3 - 1) + PAD, 8 * (n % 3 - 1) + PAD
                for finer in range(level):
                    octant = (part >> (3 * (level - 1 - finer))) & 7
                    slot = child_of(children[finer], slot, octant)
                    x, y, z = 2 * x + 8 * (octant >> 2), 2 * y + 8 * ((octant >> 1) & 1), 2 * z + 8 * (octant & 1)
                if slot >= 0:
                    _put(geometry[level], slot, x, y, z, size, least, unit, buffers[level])
                    shift = top - level
                    _mark(levels, cells, x << shift, y << shift, z << shift, 8 << shift, level)
