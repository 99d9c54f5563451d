"""Sphere tracing: views of the map (thesis eq. 4.12)."""

import warp as wp

from dudmap.core.backends.cpu import raycasting
from dudmap.core.backends.warp.kernels.formulas import (
    Motion,
    corner_gradient,
    project,
    ray,
    rotate,
    sdf_steps,
    step_length,
    to_block_boundary,
    transform,
    trilinear,
)
from dudmap.core.backends.warp.kernels.structs import Camera, Image, Lattice
from dudmap.core.backends.warp.kernels.surface import Corners, corners_at

wp.set_module_options({"enable_backward": False})

TILE = wp.constant(raycasting.TILE)
INFINITE = wp.constant(wp.float32(float(raycasting.INFINITE)))
FAR = wp.constant(wp.float32(float(raycasting.FAR)))
Values = wp.types.vector(8, wp.float32)


@wp.kernel
def splat_blocks(
    lattice: Lattice, t: Motion, camera: Camera, height: int, width: int, radius: wp.float32, depth_min: wp.float32,
    depth_max: wp.float32, near: Image, far: Image,
):  # fmt: skip
    """Widen the depth ranges of the tiles that a block may cover: see ``raycasting._splat``; minima have no order."""
    i, j, k = wp.tid()
    if lattice.cells[(i * lattice.ny + j) * lattice.nz + k] < 0:
        return
    one, zero = wp.float32(1.0), wp.float32(0.0)
    x, y, z = transform(t, wp.float32(i), wp.float32(j), wp.float32(k))
    if z + radius < depth_min or z - radius > depth_max:
        return
    first_row, last_row, first_column, last_column = int(0), near.shape[0] - 1, int(0), near.shape[1] - 1
    low = z - radius
    if low > wp.float32(0.02):
        du = camera.fx * radius * wp.sqrt(x * x + z * z) / (z * low) + one
        dv = camera.fy * radius * wp.sqrt(y * y + z * z) / (z * low) + one
        by_z = one / z
        u, v = project(x, by_z, camera.fx, camera.cx), project(y, by_z, camera.fy, camera.cy)
        if u + du < zero or v + dv < zero or u - du > wp.float32(width) or v - dv > wp.float32(height):
            return
        first_column, last_column = wp.int32(max(u - du, zero)) / TILE, min(wp.int32(u + du) / TILE, near.shape[1] - 1)
        first_row, last_row = wp.int32(max(v - dv, zero)) / TILE, min(wp.int32(v + dv) / TILE, near.shape[0] - 1)
    for row in range(first_row, last_row + 1):
        for column in range(first_column, last_column + 1):
            wp.atomic_min(near, row, column, low)
            wp.atomic_max(far, row, column, z + radius)


@wp.func
def distance_at(lattice: Lattice, x: wp.float32, y: wp.float32, z: wp.float32, least: int):
    """Signed distance in stored steps at a lattice point inside the window; NaN where it is not known."""
    lx, ly, lz = wp.floor(x), wp.floor(y), wp.floor(z)
    c = corners_at(lattice, wp.int32(lx), wp.int32(ly), wp.int32(lz))
    known = bool(True)
    for k in range(8):
        if ((c[k] >> 8) & 0xFF) < least:
            known = False
    value, _gx, _gy, _gz = trilinear(
        sdf_steps(c[0]), sdf_steps(c[1]), sdf_steps(c[2]), sdf_steps(c[3]),
        sdf_steps(c[4]), sdf_steps(c[5]), sdf_steps(c[6]), sdf_steps(c[7]), x - lx, y - ly, z - lz,
    )  # fmt: skip
    return wp.where(known, value, wp.nan)


@wp.func
def refine(
    lattice: Lattice, o: wp.vec3, d: wp.vec3, outside: wp.float32, at_outside: wp.float32, inside: wp.float32,
    at_inside: wp.float32, unit: wp.float32, least: int,
):  # fmt: skip
    """Zero between two depths by false position (Illinois variant): see ``raycasting._refine``."""
    a, at_a, b, at_b = float(outside), float(at_outside), float(inside), float(at_inside)
    side = int(0)
    done = bool(False)
    t = float(a + (b - a) * at_a / (at_a - at_b))
    for _turn in range(4):
        if not done:
            value = distance_at(lattice, o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2], least) * unit
            if wp.isnan(value) or abs(value) < wp.float32(0.01):
                done = True
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
def clipped(o: wp.float32, d: wp.float32, last: wp.float32, nudge: wp.float32, t: wp.float32, end: wp.float32):
    """Range of a ray inside the window along one axis; empty where it misses it."""
    start, stop = float(t), float(end)
    if d != wp.float32(0.0):
        a, b = -o / d, (last - o) / d
        start = max(start, min(a, b) + nudge)
        stop = min(stop, max(a, b) - nudge)
    elif o < wp.float32(0.0) or o >= last:
        stop = start - wp.float32(1.0)
    return start, stop


@wp.func
def range_inside(
    lattice: Lattice, o: wp.vec3, d: wp.vec3, nudge: wp.float32, first: wp.float32, last: wp.float32
):  # fmt: skip
    """Range of a lattice ray inside the window."""
    start, stop = clipped(o[0], d[0], wp.float32(8 * lattice.nx - 1), nudge, first, last)
    start, stop = clipped(o[1], d[1], wp.float32(8 * lattice.ny - 1), nudge, start, stop)
    start, stop = clipped(o[2], d[2], wp.float32(8 * lattice.nz - 1), nudge, start, stop)
    return start, stop


@wp.func
def normal_at(c: Corners, fx: wp.float32, fy: wp.float32, fz: wp.float32):
    """Normal at a point of a cell, given the packed voxels at its corners; 0 where the distances have no slope."""
    gx, gy, gz = corner_gradient(
        sdf_steps(c[0]), sdf_steps(c[1]), sdf_steps(c[2]), sdf_steps(c[3]),
        sdf_steps(c[4]), sdf_steps(c[5]), sdf_steps(c[6]), sdf_steps(c[7]), fx, fy, fz,
    )  # fmt: skip
    length = wp.sqrt(gx * gx + gy * gy + gz * gz)
    normal = wp.vec3(wp.float32(0.0), wp.float32(0.0), wp.float32(0.0))
    if length > wp.float32(0.0):
        normal = wp.vec3(gx / length, gy / length, gz / length)
    return normal


@wp.func
def mixed_channel_at(c: Corners, channel: int, fx: wp.float32, fy: wp.float32, fz: wp.float32):
    """Channel of the colour, 0 to 255, at a point of a cell, given the packed colours at its corners."""
    s = Values()
    for k in range(8):
        s[k] = wp.float32((c[k] >> (20 - 10 * channel)) & 1023)
    value, _kx, _ky, _kz = trilinear(s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7], fx, fy, fz)
    return wp.uint8(wp.int32(min(value * wp.float32(0.25) + wp.float32(0.5), wp.float32(255.0))))


@wp.func
def trace_ray(
    lattice: Lattice, o: wp.vec3, d: wp.vec3, first: wp.float32, last: wp.float32, unit: wp.float32, least: int
):
    """First crossing from outside to inside along a lattice ray; -1 = none: see ``raycasting._trace_ray``."""
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
            value = sdf_steps(word) * unit
            if ((word >> 8) & 0xFF) < least:
                before = -one
                t += per_voxel
            elif value > FAR:
                t_before = t
                before = value
                t += (value - one) * per_voxel
            else:
                value = distance_at(lattice, x, y, z, least) * unit
                if wp.isnan(value):
                    before = -one
                    t += per_voxel
                elif value > zero:
                    t_before = t
                    before = value
                    t += step_length(value) * per_voxel
                elif before > zero:
                    found = refine(lattice, o, d, t_before, before, t, value, unit, least)
                    t = stop  # ends the loop
                else:
                    t += step_length(value) * per_voxel
    return found


@wp.kernel
def trace(
    lattice: Lattice, colors: wp.array2d(dtype=wp.int32), camera: Camera, to_lattice: Motion, near: Image, far: Image,
    depth_min: wp.float32, depth_max: wp.float32, unit: wp.float32, least: int,
    depth: Image, color: wp.array3d(dtype=wp.uint8), normals: wp.array2d(dtype=wp.vec3),
):  # fmt: skip
    """Depth, colour and normal of one pixel of a view of the map: see ``raycasting.trace_rows``."""
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
    t = trace_ray(lattice, o, d, start, end, unit, least)
    if t <= zero or t > depth_max:
        return
    depth[v, u] = t
    p = o + t * d
    lx, ly, lz = wp.floor(p[0]), wp.floor(p[1]), wp.floor(p[2])
    fx, fy, fz = p[0] - lx, p[1] - ly, p[2] - lz
    ix, iy, iz = wp.int32(lx), wp.int32(ly), wp.int32(lz)
    c = corners_at(lattice, ix, iy, iz)
    normals[v, u] = normal_at(c, fx, fy, fz)
    paint = lattice
    paint.geometry = colors
    c = corners_at(paint, ix, iy, iz)
    for channel in range(3):
        color[v, u, channel] = mixed_channel_at(c, channel, fx, fy, fz)
