"""Loops that read the map: normal equations, samples.

As ``cpu/registration.py``; fixed partial sums make two runs equal, unlike atomic additions.
"""

import warp as wp

from dudmap.core.backends import parameters as states
from dudmap.core.backends.cpu import registration
from dudmap.core.backends.warp.kernels.formulas import (
    Motion,
    corner_weight,
    intensity_of,
    normal_terms,
    ray,
    rotate,
    sdf_steps,
    transform,
    trilinear,
    weigh,
    within_range,
)
from dudmap.core.backends.warp.kernels.structs import Camera, Image, Lattice, RegistrationParameters

wp.set_module_options({"enable_backward": False})

NUM_SUMS = wp.constant(registration.NUM_SUMS)
UNKNOWN, SURFACE, FREE = (wp.constant(wp.uint8(state)) for state in (states.UNKNOWN, states.SURFACE, states.FREE))
LANES = wp.constant(128)
"""Distance between pixels of a partial sum."""
Sums = wp.types.vector(registration.NUM_SUMS, wp.float32)
Corners = wp.types.vector(8, wp.int32)


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
    """Eight packed voxels around a lattice point, corner 4 dx + 2 dy + dz."""
    return Corners(
        word_at(lattice, x, y, z), word_at(lattice, x, y, z + 1),
        word_at(lattice, x, y + 1, z), word_at(lattice, x, y + 1, z + 1),
        word_at(lattice, x + 1, y, z), word_at(lattice, x + 1, y, z + 1),
        word_at(lattice, x + 1, y + 1, z), word_at(lattice, x + 1, y + 1, z + 1),
    )  # fmt: skip


@wp.kernel
def linearize(
    depth: Image, intensity: Image, weights: Image, camera: Camera, t: Motion, lattice: Lattice,
    voxel_size: wp.float32, sdf_unit: wp.float32, p: RegistrationParameters, per_thread: int,
    residuals: wp.array3d(dtype=wp.float32), partial: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """Partial sums and residuals: see ``registration.linearize_rows``."""
    thread = wp.tid()
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
            scale = by_255 * by_voxel
            r = distance * sdf_unit
            rc, kx, ky, kz = within_range(shade * by_255, kx * scale, ky * scale, kz * scale, intensity[v, u], p)
            static = weights[v, u]
            valid, used, paid, forfeit, square, wg, wc = weigh(r, rc, z, static, known, p)
            residuals[0, v, u] = wp.where(known, r, wp.nan)
            residuals[1, v, u] = wp.where(valid, rc, wp.nan)
            (
                a00, a01, a02, a11, a12, a22, m00, m01, m02, m10, m11, m12, m20, m21, m22,
                n00, n01, n02, n11, n12, n22, b0, b1, b2, b3, b4, b5,
            ) = normal_terms(
                wg, wc, dx * by_unit, dy * by_unit, dz * by_unit, kx, ky, kz, r, rc,
                rx * voxel_size, ry * voxel_size, rz * voxel_size,
            )  # fmt: skip
            s += Sums(
                a00, a01, a02, m00, m01, m02, a11, a12, m10, m11, m12, a22, m20, m21, m22,
                n00, n01, n02, n11, n12, n22, b0, b1, b2, b3, b4, b5, paid + forfeit,
                wp.where(valid, one, zero), wp.where(z > zero, static, zero), used, square,
            )  # fmt: skip
    for k in range(NUM_SUMS):
        partial[k, thread] = s[k]


@wp.kernel
def add_up(partial: wp.array2d(dtype=wp.float32), groups: int, out: wp.array2d(dtype=wp.float64)):
    """First level of the sum: every ``groups``-th partial sum, in order, float64."""
    k, group = wp.tid()
    total = wp.float64(0.0)
    for n in range(group, partial.shape[1], groups):
        total += wp.float64(partial[k, n])
    out[k, group] = total


@wp.kernel
def finish(parts: wp.array2d(dtype=wp.float64), out: wp.array(dtype=wp.float64)):
    """Last level of the sum."""
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
