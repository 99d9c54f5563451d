"""Loops over a map with several voxel sizes: ray casting by the finest voxels, where to refine, and how to begin there.

The lattice is the coarsest level; a finer voxel is found through the children of its blocks (``kernels/finest.py``).
"""

import warp as wp

from dudmap.gpu.kernels.formulas import (
    Motion,
    distance_bend,
    finest_at,
    half_word,
    intensity_bend,
    mean_color,
    mean_voxel,
    quarter_word,
    ray,
    root_mean,
    rotate,
    sdf_steps,
    step_length,
    to_block_boundary,
    trilinear,
)
from dudmap.gpu.kernels.images import Image
from dudmap.gpu.kernels.raycasting import FAR, INFINITE, TILE, mixed_channel_at, normal_at, range_inside
from dudmap.gpu.kernels.structs import Camera, Lattice
from dudmap.gpu.kernels.surface import Corners, corners_at
from dudmap.kernels import refinement

wp.set_module_options({"enable_backward": False})

NEAR = wp.constant(wp.float32(float(refinement.NEAR)))
PRIOR = wp.constant(refinement.PRIOR)
Blocks = wp.array2d(dtype=wp.int32)


@wp.struct
class Levels:
    """The finer levels.

    Attributes:
        children1, children2: (slots, 8) slot of the block in each octant of a block of the next coarser level.
        voxels1, voxels2: (slots, 512) packed voxels, or colours.
    """

    children1: wp.array2d(dtype=wp.int32)
    children2: wp.array2d(dtype=wp.int32)
    voxels1: wp.array2d(dtype=wp.int32)
    voxels2: wp.array2d(dtype=wp.int32)


@wp.func
def shape_of(lattice: Lattice):
    """Blocks of the window along each axis."""
    return wp.vec3i(lattice.nx, lattice.ny, lattice.nz)


@wp.func
def corners_of(lattice: Lattice, levels: Levels, level: int, x: wp.float32, y: wp.float32, z: wp.float32):
    """The eight packed voxels of a level around a point in its lattice, corner 4 dx + 2 dy + dz."""
    i, j, k = wp.int32(wp.floor(x)), wp.int32(wp.floor(y)), wp.int32(wp.floor(z))
    c = Corners()
    if level == 0:
        c = corners_at(lattice, i, j, k)
    else:
        shape = shape_of(lattice)
        for m in range(8):
            a, b, e = i + (m >> 2), j + ((m >> 1) & 1), k + (m & 1)
            if level == 1:
                c[m] = half_word(lattice.cells, shape, levels.children1, levels.voxels1, a, b, e)
            else:
                c[m] = quarter_word(lattice.cells, shape, levels.children1, levels.children2, levels.voxels2, a, b, e)
    return c


@wp.func
def value_at(lattice: Lattice, levels: Levels, x: wp.float32, y: wp.float32, z: wp.float32, least: int):
    """Signed distance in stored steps by the finest voxels that are known, and their level: see
    ``adaptive_raycasting._value``."""
    value, found = float(wp.nan), int(0)
    level = int(finest_at(lattice.cells, shape_of(lattice), levels.children1, levels.children2, x, y, z))
    while level >= 0:
        scale = wp.float32(1 << level)
        px, py, pz = x * scale, y * scale, z * scale
        c = corners_of(lattice, levels, level, px, py, pz)
        known = bool(True)
        for m in range(8):
            if ((c[m] >> 8) & 0xFF) < least:
                known = False
        if known:
            value, _gx, _gy, _gz = trilinear(
                sdf_steps(c[0]), sdf_steps(c[1]), sdf_steps(c[2]), sdf_steps(c[3]),
                sdf_steps(c[4]), sdf_steps(c[5]), sdf_steps(c[6]), sdf_steps(c[7]),
                px - wp.floor(px), py - wp.floor(py), pz - wp.floor(pz),
            )  # fmt: skip
            found = level
            level = -1  # ends the loop
        else:
            level -= 1
    return value, found


@wp.func
def refine(
    lattice: Lattice, levels: Levels, o: wp.vec3, d: wp.vec3, outside: wp.float32, at_outside: wp.float32,
    inside: wp.float32, at_inside: wp.float32, unit: wp.float32, least: int,
):  # fmt: skip
    """Zero between two depths by false position (Illinois variant): see ``adaptive_raycasting._refine``."""
    a, at_a, b, at_b = float(outside), float(at_outside), float(inside), float(at_inside)
    side, turn = int(0), int(0)
    t = float(a + (b - a) * at_a / (at_a - at_b))
    while turn < 5:  # a loop that Warp does not write out, which would take long to compile
        turn += 1
        steps, _level = value_at(lattice, levels, o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2], least)
        value = steps * unit
        if wp.isnan(value) or abs(value) < wp.float32(0.005):
            turn = 5
        else:
            if value > wp.float32(0.0):
                a = t
                at_a = value
                if side > 0:
                    at_b *= wp.float32(0.5)
                side = 1
            else:
                b = t
                at_b = value
                if side < 0:
                    at_a *= wp.float32(0.5)
                side = -1
            t = a + (b - a) * at_a / (at_a - at_b)
    return t


@wp.func
def trace_ray(
    lattice: Lattice, levels: Levels, o: wp.vec3, d: wp.vec3, first: wp.float32, last: wp.float32, unit: wp.float32,
    least: int,
):  # fmt: skip
    """First crossing from outside to inside along a lattice ray; -1 = none: see ``adaptive_raycasting._trace``."""
    zero, half, one = wp.float32(0.0), wp.float32(0.5), wp.float32(1.0)
    per_voxel = one / wp.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    nudge = wp.float32(1.0e-2) * per_voxel
    start, stop = range_inside(lattice, o, d, nudge, first, last)
    rx = wp.where(d[0] != zero, one / d[0], INFINITE)
    ry = wp.where(d[1] != zero, one / d[1], INFINITE)
    rz = wp.where(d[2] != zero, one / d[2], INFINITE)
    t, t_before, before, found = float(start), float(-1.0), float(-1.0), float(-1.0)
    while t < stop:
        x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
        i, j, k = wp.int32(x + half), wp.int32(y + half), wp.int32(z + half)
        slot = lattice.cells[((i >> 3) * lattice.ny + (j >> 3)) * lattice.nz + (k >> 3)]
        if slot < 0:
            steps = min(to_block_boundary(x + half, d[0], rx), to_block_boundary(y + half, d[1], ry))
            t += min(steps, to_block_boundary(z + half, d[2], rz)) + nudge
            before = -one
        else:
            word = lattice.geometry[slot, ((i & 7) * 8 + (j & 7)) * 8 + (k & 7)]
            coarse = sdf_steps(word) * unit
            if ((word >> 8) & 0xFF) >= least and coarse > FAR:
                t_before = t
                before = coarse
                t += (coarse - one) * per_voxel
            else:
                finest, level = value_at(lattice, levels, x, y, z, least)
                value = finest * unit
                scale = wp.float32(1 << level)  # the least step is a share of the voxels that were read
                if value > zero:
                    t_before = t
                    before = value
                    t += step_length(value * scale) / scale * per_voxel
                elif value <= zero:
                    if before > zero:
                        found = refine(lattice, levels, o, d, t_before, before, t, value, unit, least)
                        t = stop  # ends the loop
                    else:
                        t += step_length(value * scale) / scale * per_voxel
                else:
                    before = -one
                    t += per_voxel
    return found


@wp.kernel
def trace_levels(
    lattice: Lattice, levels: Levels, paint: Lattice, paints: Levels, camera: Camera, to_lattice: Motion, near: Image,
    far: Image, depth_min: wp.float32, depth_max: wp.float32, unit: wp.float32, least: int,
    depth: Image, color: wp.array3d(dtype=wp.uint8), normals: wp.array2d(dtype=wp.vec3),
):  # fmt: skip
    """Depth, colour and normal of one pixel of a view of the map: see ``adaptive_raycasting._trace_rows``; ``paint``
    and ``paints`` hold the colours."""
    v, u = wp.tid()
    zero, one = wp.float32(0.0), wp.float32(1.0)
    depth[v, u] = zero
    for channel in range(3):
        color[v, u, channel] = wp.uint8(0)
    normals[v, u] = wp.vec3(zero, zero, zero)
    start, end = max(near[v / TILE, u / TILE], depth_min), min(far[v / TILE, u / TILE], depth_max)
    if start >= end:
        return
    m = to_lattice
    dx, dy, dz = rotate(m, ray(u, camera.cx, camera.fx), ray(v, camera.cy, camera.fy), one)
    o, d = wp.vec3(m[3], m[7], m[11]), wp.vec3(dx, dy, dz)
    t = trace_ray(lattice, levels, o, d, start, end, unit, least)
    if t <= zero or t > depth_max:
        return
    depth[v, u] = t
    x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
    _value, level = value_at(lattice, levels, x, y, z, least)
    scale = wp.float32(1 << level)
    x, y, z = x * scale, y * scale, z * scale
    fx, fy, fz = x - wp.floor(x), y - wp.floor(y), z - wp.floor(z)
    c = corners_of(lattice, levels, level, x, y, z)
    normals[v, u] = normal_at(c, fx, fy, fz)
    c = corners_of(paint, paints, level, x, y, z)
    for channel in range(3):
        color[v, u, channel] = mixed_channel_at(c, channel, fx, fy, fz)


@wp.func
def word_near(voxels: Blocks, near: Blocks, row: int, x: int, y: int, z: int):
    """Word of a voxel at most eight beyond the sides of a block, by the block's neighbours; 0 without a block."""
    slot = near[row, 9 * ((x + 8) >> 3) + 3 * ((y + 8) >> 3) + ((z + 8) >> 3)]
    word = wp.int32(0)
    if slot >= 0:
        word = voxels[slot, ((x & 7) * 8 + (y & 7)) * 8 + (z & 7)]
    return word


@wp.kernel
def examine(
    voxels: Blocks, near: Blocks, by_voxel: wp.float32, saturated: wp.float32, out: wp.array3d(dtype=wp.float32)
):
    """How much the distance and the intensity bend in an octant of a block, and whether the surface touches it: see
    ``refinement.examine_range``."""
    row, octant = wp.tid()
    x0, y0, z0 = 4 * (octant >> 2), 4 * ((octant >> 1) & 1), 4 * (octant & 1)
    total, shades, count, shaded = float(0.0), float(0.0), int(0), int(0)
    inside, outside = int(0), int(0)
    for n in range(125):
        i, j, k = n / 25, (n / 5) % 5, n % 5
        x, y, z = x0 + i, y0 + j, z0 + k
        word = word_near(voxels, near, row, x, y, z)
        f = sdf_steps(word) * by_voxel
        if (word & 0xFF00) != 0:
            if f < wp.float32(0.25):
                inside = 1
            if f > wp.float32(-0.25):
                outside = 1
            if abs(f) <= NEAR and i < 4 and j < 4 and k < 4:
                square, shade, axes, seen = float(0.0), float(0.0), int(0), int(0)
                for axis in range(3):
                    dx, dy, dz = wp.where(axis == 0, 1, 0), wp.where(axis == 1, 1, 0), wp.where(axis == 2, 1, 0)
                    far, known = distance_bend(
                        word, word_near(voxels, near, row, x + 2 * dx, y + 2 * dy, z + 2 * dz),
                        word_near(voxels, near, row, x - 2 * dx, y - 2 * dy, z - 2 * dz), by_voxel, saturated,
                    )  # fmt: skip
                    if known:
                        square += far * far
                        axes += 1
                    dark, colored = intensity_bend(
                        word, word_near(voxels, near, row, x + dx, y + dy, z + dz),
                        word_near(voxels, near, row, x - dx, y - dy, z - dz),
                    )  # fmt: skip
                    if colored:
                        shade += dark * dark
                        seen = 1
                if axes > 0:
                    total += square * wp.float32(3.0) / wp.float32(axes)
                    count += 1
                if seen > 0:
                    shades += shade
                    shaded += 1
    out[0, row, octant] = root_mean(total, count)
    out[1, row, octant] = root_mean(shades, shaded)
    out[2, row, octant] = wp.float32(inside * outside)


@wp.kernel
def prolong(
    voxels: Blocks, colors: Blocks, near: Blocks, octants: wp.array(dtype=wp.int32), slots: wp.array(dtype=wp.int32),
    fine_voxels: Blocks, fine_colors: Blocks,
):  # fmt: skip
    """One voxel of a block that is opened, by interpolation of the coarser level: see ``refinement.prolong_range``."""
    row, n = wp.tid()
    octant = octants[row]
    i, j, k = n >> 6, (n >> 3) & 7, n & 7
    x0, y0, z0 = 4 * (octant >> 2) + (i >> 1), 4 * ((octant >> 1) & 1) + (j >> 1), 4 * (octant & 1) + (k >> 1)
    steps, shade, red, green, blue = float(0.0), float(0.0), float(0.0), float(0.0), float(0.0)
    weight, count, shades, painted = int(PRIOR), int(0), int(0), int(0)
    for m in range(8):
        a, b, c = m >> 2, (m >> 1) & 1, m & 1
        if a <= (i & 1) and b <= (j & 1) and c <= (k & 1):
            word = word_near(voxels, near, row, x0 + a, y0 + b, z0 + c)
            color = word_near(colors, near, row, x0 + a, y0 + b, z0 + c)
            weight = min(weight, (word >> 8) & 0xFF)
            steps += sdf_steps(word)
            count += 1
            if (word & 0xFF) != 0:
                shade += wp.float32(word & 0xFF)
                shades += 1
            if color != 0:
                red += wp.float32((color >> 20) & 1023)
                green += wp.float32((color >> 10) & 1023)
                blue += wp.float32(color & 1023)
                painted += 1
    fine_voxels[slots[row], n] = mean_voxel(steps, count, weight, shade, shades)
    fine_colors[slots[row], n] = mean_color(red, green, blue, painted)
