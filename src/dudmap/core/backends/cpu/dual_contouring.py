"""Surface of a map with several voxel sizes by dual contouring (Ju et al. 2002).

Each cell that the surface crosses has one vertex (``cell_vertices.py``), and each edge of the smallest cells whose
ends have different signs a polygon of the vertices of the cells around it: four, or three where a larger cell takes the
place of two. All cells see the same field (``octree_field.py``), so an even number of edges around each face of a cell
changes its sign, and the surface is closed wherever the field is known, across levels too.
"""

import numpy as np

from dudmap.core.backends.cpu.cell_vertices import is_known, is_trusted, place_vertex
from dudmap.core.backends.cpu.octree_field import PAD, SPAN, child_of, fill, finest_level, may_hold_surface
from dudmap.core.backends.threads import kernel, scalar

f32 = np.float32
CELL_BITS = 18
"""Bits of the number of a cell within its block: three times six, for 8 x 4 cells along an edge."""


@kernel
def _cell_key(x, y, z, top, rows):
    """Number of the cell at lattice point (x, y, z): row of its block << CELL_BITS | its place there; -1 = no block."""
    edge, pad = 8 << top, PAD << top
    i, j, k = x - pad, y - pad, z - pad
    bx, by, bz = (i + edge) // edge, (j + edge) // edge, (k + edge) // edge
    row = rows[9 * bx + 3 * by + bz]
    if row < 0:
        return np.int64(-1)
    i, j, k = i - (bx - 1) * edge, j - (by - 1) * edge, k - (bz - 1) * edge
    finer = 2 - top
    return (np.int64(row) << CELL_BITS) | (((i << finer) << 12) | ((j << finer) << 6) | (k << finer))


@scalar
def _mixed_color(near, children, colors, top, x, y, z, edge, place, out):
    """Colour (3,) uint8 at a place of a cell: mean of the corners that have one, weighed trilinearly."""
    total = f32(0)
    sums = np.zeros(3, f32)
    width, pad = 8 << top, PAD << top
    for m in range(8):
        i, j, k = x + edge * (m >> 2) - pad, y + edge * ((m >> 1) & 1) - pad, z + edge * (m & 1) - pad
        weight = f32(1e-3)
        wx, wy, wz = place[0] / f32(edge), place[1] / f32(edge), place[2] / f32(edge)
        weight += (
            (wx if m >> 2 else f32(1) - wx) * (wy if (m >> 1) & 1 else f32(1) - wy) * (wz if m & 1 else f32(1) - wz)
        )
        bx, by, bz = (i + width) // width, (j + width) // width, (k + width) // width
        slot = near[9 * bx + 3 * by + bz]
        if slot < 0:
            continue
        i, j, k = i - (bx - 1) * width, j - (by - 1) * width, k - (bz - 1) * width
        color = np.int32(0)
        for level in range(top + 1):
            shift = top - level
            if slot >= 0 and ((i | j | k) & ((1 << shift) - 1)) == 0:
                found = colors[level][slot, (((i >> shift) & 7) << 6) | (((j >> shift) & 7) << 3) | ((k >> shift) & 7)]
                color = found if found != 0 else color
            if level < top:
                half = shift + 2
                octant = 4 * ((i >> half) & 1) + 2 * ((j >> half) & 1) + ((k >> half) & 1)
                slot = child_of(children[level], slot, octant)
        if color == 0 or weight <= f32(0):
            continue
        total += weight
        for channel in range(3):
            sums[channel] += weight * f32((color >> (20 - 10 * channel)) & 1023)
    for channel in range(3):
        value = f32(0.25) * sums[channel] / max(total, f32(1e-6)) + f32(0.5)
        out[channel] = np.uint8(min(value, f32(255)))


@kernel
def _changes_sign(field, size, x, y, z):
    """Whether corners of a finest cell have different signs; unknown ones have none."""
    negative, positive = False, False
    n = (x * size + y) * size + z
    for m in range(8):
        value = field[n + (m >> 2) * size * size + ((m >> 1) & 1) * size + (m & 1)]
        negative |= value < 0
        positive |= value >= 0
    return negative & positive


@kernel
def _may_cross(field, size, p, stride, top):
    """Whether the surface crosses a lattice edge from point ``p``, of any of the cells' sizes."""
    crosses = False
    for level in range(top + 1):
        crosses |= (field[p + (stride << level)] < 0) != (field[p] < 0)
    return crosses


@scalar
def _block_vertices(
    field, levels, near, row, top, jump, children, paint, coords, spacing, work, keys, places, colors, count
):  # fmt: skip
    """Vertices of the cells of a block; the new number of vertices. See ``contour_blocks``."""
    cells, size, pad, width = SPAN << top, (SPAN << top) + 1, PAD << top, 8 << top
    vertex, planes = np.empty(6, f32), np.empty((540, 5), f32)
    for i in range(width):
        for j in range(width):
            for k in range(width):
                x, y, z = i + pad, j + pad, k + pad
                level = np.int64(levels[(x * cells + y) * cells + z])
                edge = 1 << (top - level)
                if (i | j | k) & (edge - 1):
                    continue
                if edge == 1 and not _changes_sign(field, size, x, y, z):
                    continue
                border = not is_known(field, size, x, y, z, edge, jump / f32(1 << level))
                if not place_vertex(field, levels, size, x, y, z, edge, border, top, jump, work, planes, vertex):
                    continue
                finer = 2 - top
                keys[count] = (np.int64(row) << CELL_BITS) | (((i << finer) << 12) | ((j << finer) << 6) | (k << finer))
                place = places[count]
                for axis in range(3):
                    first = (i if axis == 0 else (j if axis == 1 else k)) + width * np.int64(coords[axis])
                    place[axis] = f32(spacing * (np.float64(first) + np.float64(vertex[axis])))
                    place[3 + axis] = vertex[3 + axis]
                _mixed_color(near, children, paint, top, x, y, z, edge, vertex, colors[count])
                count += 1
    return count


@scalar
def _block_polygons(field, levels, rows, top, jump, polygons, count):
    """Polygons around the edges that begin in a block; the new number of polygons. See ``contour_blocks``."""
    cells, size, pad, width = SPAN << top, (SPAN << top) + 1, PAD << top, 8 << top
    corner = np.empty((4, 3), np.int64)
    ring = np.empty(4, np.int64)
    for i in range(width):
        for j in range(width):
            for k in range(width):
                x, y, z = i + pad, j + pad, k + pad
                p = (x * size + y) * size + z
                if np.isnan(field[p]):
                    continue
                for axis in range(3):
                    stride = size * size if axis == 0 else (size if axis == 1 else 1)
                    if not _may_cross(field, size, p, stride, top):
                        continue
                    finest = 0
                    for m in range(4):  # counter-clockwise, seen from the end of the edge
                        b, c = (-1 if m == 0 or m == 3 else 0), (-1 if m < 2 else 0)
                        corner[m, axis] = x if axis == 0 else (y if axis == 1 else z)
                        corner[m, (axis + 1) % 3] = (y if axis == 0 else (z if axis == 1 else x)) + b
                        corner[m, (axis + 2) % 3] = (z if axis == 0 else (x if axis == 1 else y)) + c
                        finest = max(finest, levels[(corner[m, 0] * cells + corner[m, 1]) * cells + corner[m, 2]])
                    step = 1 << (top - finest)
                    if (i | j | k) & (step - 1):
                        continue
                    other = field[p + step * stride]
                    if np.isnan(other) or (other < 0) == (field[p] < 0):
                        continue
                    if not is_trusted(field, levels, size, x, y, z, axis, top, jump):
                        continue
                    missing, absent = 0, 0
                    for m in range(4):
                        cx, cy, cz = corner[m, 0], corner[m, 1], corner[m, 2]
                        edge = 1 << (top - np.int64(levels[(cx * cells + cy) * cells + cz]))
                        ring[m] = _cell_key(cx & ~(edge - 1), cy & ~(edge - 1), cz & ~(edge - 1), top, rows)
                        if ring[m] < 0:
                            missing += 1
                            absent = m
                    if missing > 1:
                        continue
                    if missing == 1:  # no block there: the triangle of the other three
                        ring[absent] = ring[(absent + 1) & 3]
                    for m in range(4):
                        polygons[count, m] = ring[m if field[p] < 0 else 3 - m]
                    count += 1
    return count


@kernel
def contour_blocks(
    start, stop, near, rows, meshed, coords, geometry, children, paint, least, unit, voxel_size, jump
):  # fmt: skip
    """Vertices and polygons of blocks ``start`` to ``stop`` of the coarsest level.

    Args:
        start, stop: Range of blocks.
        near: (n, 27) int32 slots of the blocks and their neighbours.
        rows: (n, 27) int32 numbers of these neighbours among the blocks; -1 = none.
        meshed: (n,) bool, whether the polygons of a block are wanted; its vertices always are.
        coords: (n, 3) int32 coordinates of the blocks.
        geometry, paint: Packed voxels and colours (slots, 512) int32 of each of three levels.
        children: (slots, 8) int32 slots of the children in each of the two finer levels, see ``FinerLevels``.
        least: Smallest trusted weight, at least 1.
        unit: Metres per step of a stored distance.
        voxel_size: Of the coarsest level, metres.
        jump: Largest change of the distance within a coarsest cell, metres.

    Returns:
        Keys (v,) int64 of the vertices, ascending; places and normals (v, 6) float32, metres, world frame; colours (v,
        3) uint8; keys (p, 4) int64 of the polygons, two of them equal in a triangle; their blocks (p,) int32.
    """
    top = 0
    for row in range(start, stop):
        top = max(top, finest_level(near[row], children))
    sizes = (SPAN + 1, (SPAN << 1) + 1 if top > 0 else 1, (SPAN << 2) + 1 if top > 1 else 1)
    buffers = (np.empty(sizes[0] ** 3, f32), np.empty(sizes[1] ** 3, f32), np.empty(sizes[2] ** 3, f32))
    levels = np.empty((SPAN << top) ** 3, np.uint8)
    work = np.empty((192, 7), f32)
    capacity = 1 << 12
    keys, places = np.empty(capacity, np.int64), np.empty((capacity, 6), f32)
    colors, polygons = np.empty((capacity, 3), np.uint8), np.empty((capacity, 4), np.int64)
    owners = np.empty(capacity, np.int32)
    num_vertices, num_polygons = 0, 0
    for row in range(start, stop):
        if not may_hold_surface(near[row], geometry[0], children[0], least):
            continue
        top = finest_level(near[row], children)
        most = 512 << (3 * top)
        if num_vertices + most > len(keys):
            keys, places = _longer(keys, num_vertices, most), _longer(places, num_vertices, most)
            colors = _longer(colors, num_vertices, most)
        if num_polygons + 3 * most > len(owners):
            polygons, owners = _longer(polygons, num_polygons, 3 * most), _longer(owners, num_polygons, 3 * most)
        fill(near[row], geometry, children, least, unit, top, buffers, levels)
        field, spacing = buffers[top], voxel_size / (1 << top)
        num_vertices = _block_vertices(
            field, levels, near[row], row, top, jump, children, paint, coords[row], spacing, work, keys, places, colors,
            num_vertices,
        )  # fmt: skip
        if meshed[row]:
            before = num_polygons
            num_polygons = _block_polygons(field, levels, rows[row], top, jump, polygons, num_polygons)
            owners[before:num_polygons] = row
    return (
        keys[:num_vertices].copy(), places[:num_vertices].copy(), colors[:num_vertices].copy(),
        polygons[:num_polygons].copy(), owners[:num_polygons].copy(),
    )  # fmt: skip


@scalar
def _longer(array, used, more):
    """Copy of an array with room for ``more`` rows after those in use."""
    out = np.empty((2 * (used + more), *array.shape[1:]), array.dtype)
    out[:used] = array[:used]
    return out


@kernel
def split_polygons(polygons, vertices, faces):
    """Triangles of polygons, cut along their shorter diagonal.

    Args:
        polygons: (p, 4) int32 vertices.
        vertices: (v, 3) float32.
        faces: (2 p, 3) int32 out.

    Returns:
        Number of triangles, and of those of each polygon (p,).
    """
    count = 0
    each = np.zeros(len(polygons), np.int64)
    for n in range(len(polygons)):
        a, b, c, d = polygons[n, 0], polygons[n, 1], polygons[n, 2], polygons[n, 3]
        ac, bd = f32(0), f32(0)
        for axis in range(3):
            ac += (vertices[a, axis] - vertices[c, axis]) ** 2
            bd += (vertices[b, axis] - vertices[d, axis]) ** 2
        before = count
        for part in range(2):
            if ac <= bd:
                i, j, k = (a, b, c) if part == 0 else (a, c, d)
            else:
                i, j, k = (a, b, d) if part == 0 else (b, c, d)
            if i != j and j != k and k != i:
                faces[count, 0], faces[count, 1], faces[count, 2] = i, j, k
                count += 1
        each[n] = count - before
    return count, each
