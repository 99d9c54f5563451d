"""Loops that read the map: normal equations, samples at points, ray casting.

Sums are those of ``kernels/registration.py``: each thread adds up a fixed set of pixels, and the partial sums are added
in their order, so that two runs on one device give the same numbers bit for bit. Atomic additions would not.
"""

import warp as wp

from dudmap.gpu.kernels.formulas import (
    Motion,
    corner_gradient,
    corner_weight,
    intensity_of,
    normal_terms,
    project,
    ray,
    rotate,
    sdf_steps,
    step_length,
    to_block_boundary,
    transform,
    trilinear,
    weigh,
)
from dudmap.gpu.kernels.images import Image
from dudmap.gpu.kernels.structs import Camera, Lattice, RegistrationParameters
from dudmap.kernels import parameters as states
from dudmap.kernels import raycasting, registration

wp.set_module_options({"enable_backward": False})

NUM_SUMS = wp.constant(registration.NUM_SUMS)
UNKNOWN, SURFACE, FREE = (wp.constant(wp.uint8(state)) for state in (states.UNKNOWN, states.SURFACE, states.FREE))
TILE = wp.constant(raycasting.TILE)
INFINITE = wp.constant(wp.float32(float(raycasting.INFINITE)))
FAR = wp.constant(wp.float32(float(raycasting.FAR)))
LANES = wp.constant(128)
"""Pixels that go into one partial sum are this many apart, so that neighbouring threads read neighbouring pixels."""
Sums = wp.types.vector(registration.NUM_SUMS, wp.float32)
Corners = wp.types.vector(8, wp.int32)
Values = wp.types.vector(8, wp.float32)


@wp.func
def word_at(lattice: Lattice, x: int, y: int, z: int):
    """Packed voxel at a lattice point inside the window, 0 without voxels."""
    slot = lattice.cells[((x >> 3) * lattice.ny + (y >> 3)) * lattice.nz + (z >> 3)]
    word = wp.int32(0)
    if slot >= 0:
        word = lattice.geometry[slot, ((x & 7) * 8 + (y & 7)) * 8 + (z & 7)]
    return word


@wp.func
def corners_at(lattice: Lattice, x: int, y: int, z: int):
    """The eight packed voxels around a lattice point, corner 4 dx + 2 dy + dz."""
    return Corners(
        word_at(lattice, x, y, z), word_at(lattice, x, y, z + 1),
        word_at(lattice, x, y + 1, z), word_at(lattice, x, y + 1, z + 1),
        word_at(lattice, x + 1, y, z), word_at(lattice, x + 1, y, z + 1),
        word_at(lattice, x + 1, y + 1, z), word_at(lattice, x + 1, y + 1, z + 1),
    )  # fmt: skip


@wp.func
def pixel_sums(
    thread: int, depth: Image, intensity: Image, weights: Image, camera: Camera, t: Motion, lattice: Lattice,
    voxel_size: wp.float32, sdf_unit: wp.float32, p: RegistrationParameters, per_thread: int,
    first: int, residuals: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Sums of the normal equations over the pixels of a thread; their residuals go to the images from ``first`` on: see
    ``registration.linearize_rows``."""
    h, w = depth.shape[0], depth.shape[1]
    one, zero = wp.float32(1.0), wp.float32(0.0)
    by_unit, by_voxel, by_255 = sdf_unit / voxel_size, one / voxel_size, wp.float32(1.0 / 255.0)
    by_fx, by_fy = one / camera.fx, one / camera.fy
    s = Sums()
    for turn in range(per_thread):
        pixel = (thread / LANES) * (LANES * per_thread) + turn * LANES + thread % LANES
        if pixel < h * w:
            v, u = pixel / w, pixel % w
            z = depth[v, u]
            x, y = (wp.float32(u) - camera.cx) * by_fx * z, (wp.float32(v) - camera.cy) * by_fy * z
            rx, ry, rz = rotate(t, x, y, z)
            gx, gy, gz = rx + t[3], ry + t[7], rz + t[11]
            lx, ly, lz = wp.floor(gx), wp.floor(gy), wp.floor(gz)
            ix, iy, iz = wp.int32(lx), wp.int32(ly), wp.int32(lz)
            c = Corners()
            if (
                z > zero and ix >= 0 and iy >= 0 and iz >= 0
                and ix < lattice.nx * 8 - 1 and iy < lattice.ny * 8 - 1 and iz < lattice.nz * 8 - 1
            ):  # fmt: skip
                c = corners_at(lattice, ix, iy, iz)
            ax, ay, az = gx - lx, gy - ly, gz - lz
            known = bool(True)
            for k in range(8):  # a corner in the air is not part of a surface
                if (c[k] & 0xFF00) == 0 or (c[k] & 0xFF) == 0:
                    known = False
            distance, dx, dy, dz = trilinear(
                sdf_steps(c[0]), sdf_steps(c[1]), sdf_steps(c[2]), sdf_steps(c[3]),
                sdf_steps(c[4]), sdf_steps(c[5]), sdf_steps(c[6]), sdf_steps(c[7]), ax, ay, az,
            )  # fmt: skip
            shade, kx, ky, kz = trilinear(
                intensity_of(c[0]), intensity_of(c[1]), intensity_of(c[2]), intensity_of(c[3]),
                intensity_of(c[4]), intensity_of(c[5]), intensity_of(c[6]), intensity_of(c[7]), ax, ay, az,
            )  # fmt: skip
            r, rc = distance * sdf_unit, shade * by_255 - intensity[v, u]
            scale = by_255 * by_voxel
            static = weights[v, u]
            valid, used, paid, forfeit, square, wg, wc = weigh(r, rc, z, static, known, p)
            residuals[first, v, u] = wp.where(known, r, wp.nan)
            residuals[first + 1, v, u] = wp.where(valid, rc, wp.nan)
            (
                a00, a01, a02, a11, a12, a22, m00, m01, m02, m10, m11, m12, m20, m21, m22,
                n00, n01, n02, n11, n12, n22, b0, b1, b2, b3, b4, b5,
            ) = normal_terms(
                wg, wc, dx * by_unit, dy * by_unit, dz * by_unit, kx * scale, ky * scale, kz * scale, r, rc,
                rx * voxel_size, ry * voxel_size, rz * voxel_size,
            )  # fmt: skip
            s += Sums(
                a00, a01, a02, m00, m01, m02, a11, a12, m10, m11, m12, a22, m20, m21, m22,
                n00, n01, n02, n11, n12, n22, b0, b1, b2, b3, b4, b5, paid + forfeit,
                wp.where(valid, one, zero), wp.where(z > zero, static, zero), used, square,
            )  # fmt: skip
    return s


@wp.kernel
def linearize(
    depth: Image, intensity: Image, weights: Image, camera: Camera, t: Motion, lattice: Lattice,
    voxel_size: wp.float32, sdf_unit: wp.float32, p: RegistrationParameters, per_thread: int,
    residuals: wp.array3d(dtype=wp.float32), partial: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """Partial sums of the normal equations, and the residuals."""
    thread = wp.tid()
    s = pixel_sums(
        thread, depth, intensity, weights, camera, t, lattice, voxel_size, sdf_unit, p, per_thread, 0, residuals
    )
    for k in range(NUM_SUMS):
        partial[k, thread] = s[k]


@wp.kernel
def add_up(partial: wp.array2d(dtype=wp.float32), groups: int, out: wp.array2d(dtype=wp.float64)):
    """One level of the sum: each thread adds every ``groups``-th partial sum of one quantity, in order, in float64."""
    k, group = wp.tid()
    total = wp.float64(0.0)
    for n in range(group, partial.shape[1], groups):
        total += wp.float64(partial[k, n])
    out[k, group] = total


@wp.kernel
def finish(parts: wp.array2d(dtype=wp.float64), out: wp.array(dtype=wp.float64)):
    """The last level of the sum."""
    k = wp.tid()
    total = wp.float64(0.0)
    for n in range(parts.shape[1]):
        total += parts[k, n]
    out[k] = total


@wp.kernel
def sample(
    depth: Image, intensity: Image, camera: Camera, t: Motion, lattice: Lattice, sdf_unit: wp.float32,
    free_count: wp.array(dtype=wp.uint8), free_after: int, distance: Image, difference: Image,
    occupancy: wp.array2d(dtype=wp.uint8),
):  # fmt: skip
    """Sample the map at the points of an image: see ``sampling.sample_rows``."""
    v, u = wp.tid()
    z = depth[v, u]
    distance[v, u] = wp.nan
    difference[v, u] = wp.nan
    occupancy[v, u] = UNKNOWN
    if z <= wp.float32(0.0):
        return
    x, y = ray(u, camera.cx, camera.fx) * z, ray(v, camera.cy, camera.fy) * z
    gx, gy, gz = transform(t, x, y, z)
    lx, ly, lz = wp.floor(gx), wp.floor(gy), wp.floor(gz)
    ix, iy, iz = wp.int32(lx), wp.int32(ly), wp.int32(lz)
    if ix < 0 or iy < 0 or iz < 0:
        return
    if ix >= lattice.nx * 8 - 1 or iy >= lattice.ny * 8 - 1 or iz >= lattice.nz * 8 - 1:
        return
    slot = lattice.cells[((ix >> 3) * lattice.ny + (iy >> 3)) * lattice.nz + (iz >> 3)]
    if slot < 0:
        if slot <= -2:
            if wp.int32(free_count[-2 - slot]) >= free_after:
                occupancy[v, u] = FREE
        return
    c = corners_at(lattice, ix, iy, iz)
    zero = wp.float64(0.0)
    sdf, total, shade, shaded = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    for k in range(8):
        if (c[k] & 0xFF00) != 0:
            part = corner_weight(k, gx - lx, gy - ly, gz - lz)
            sdf += part * wp.float64(sdf_steps(c[k]))
            total += part
            if (c[k] & 0xFF) != 0:
                shade += part * wp.float64(intensity_of(c[k]))
                shaded += part
    if total < wp.float64(0.5):
        return
    distance[v, u] = wp.float32(sdf / total * wp.float64(sdf_unit))
    if shaded > zero:
        difference[v, u] = wp.float32(shade / shaded / wp.float64(255.0) - wp.float64(intensity[v, u]))
    occupancy[v, u] = SURFACE


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
def trace_ray(
    lattice: Lattice, o: wp.vec3, d: wp.vec3, first: wp.float32, last: wp.float32, unit: wp.float32, least: int
):
    """First crossing from outside to inside along a lattice ray; -1 = none: see ``raycasting._trace_ray``."""
    zero, half, one = wp.float32(0.0), wp.float32(0.5), wp.float32(1.0)
    per_voxel = one / wp.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    nudge = wp.float32(1.0e-2) * per_voxel
    start, stop = clipped(o[0], d[0], wp.float32(8 * lattice.nx - 1), nudge, first, last)
    start, stop = clipped(o[1], d[1], wp.float32(8 * lattice.ny - 1), nudge, start, stop)
    start, stop = clipped(o[2], d[2], wp.float32(8 * lattice.nz - 1), nudge, start, stop)
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
    gx, gy, gz = corner_gradient(
        sdf_steps(c[0]), sdf_steps(c[1]), sdf_steps(c[2]), sdf_steps(c[3]),
        sdf_steps(c[4]), sdf_steps(c[5]), sdf_steps(c[6]), sdf_steps(c[7]), fx, fy, fz,
    )  # fmt: skip
    length = wp.sqrt(gx * gx + gy * gy + gz * gz)
    if length > zero:
        normals[v, u] = wp.vec3(gx / length, gy / length, gz / length)
    paint = lattice
    paint.geometry = colors
    c = corners_at(paint, ix, iy, iz)
    for channel in range(3):
        s = Values()
        for k in range(8):
            s[k] = wp.float32((c[k] >> (20 - 10 * channel)) & 1023)
        value, _kx, _ky, _kz = trilinear(s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7], fx, fy, fz)
        color[v, u, channel] = wp.uint8(wp.int32(min(value * wp.float32(0.25) + wp.float32(0.5), wp.float32(255.0))))
