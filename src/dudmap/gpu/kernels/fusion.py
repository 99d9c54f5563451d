"""Loops over the blocks that a depth image touches, updates or sees to be empty (thesis section 4.5, algorithm 1).

The arithmetic before the shared formulas is that of ``kernels/visibility.py`` and ``kernels/integration.py``. Lists of
blocks are compacted by a running sum over flags, not by an atomic counter, so that their order is always the same.
"""

import warp as wp

from dudmap.gpu.kernels.formulas import (
    Motion,
    band_behind,
    band_front,
    free_depth,
    fuse_color,
    fuse_voxel,
    is_occupied,
    pack_pixel_color,
    pack_reading,
    project,
    ray,
    reading_weight,
    sigma,
    transform,
)
from dudmap.gpu.kernels.images import Image
from dudmap.gpu.kernels.structs import Camera, FusionParameters, Lattice, SensorNoise, TruncationBand
from dudmap.kernels import visibility

wp.set_module_options({"enable_backward": False})

TILE = wp.constant(visibility.TILE)
SETTLED = wp.constant(visibility.SETTLED)
REACH = wp.constant(wp.float32(float(visibility.REACH)))
FAR = wp.constant(wp.float32(1.0e9))
Bytes = wp.array2d(dtype=wp.uint8)
Indices = wp.array(dtype=wp.int32)


@wp.kernel
def tile_ranges(depth: Image, nearest: Image, farthest: Image, valid: Image):
    """Nearest and farthest reading and share of pixels with one, per tile of the depth image."""
    ty, tx = wp.tid()
    near = float(wp.inf)
    far = float(0.0)
    count = float(0.0)
    total = float(0.0)
    for v in range(ty * TILE, min(ty * TILE + TILE, depth.shape[0])):
        for u in range(tx * TILE, min(tx * TILE + TILE, depth.shape[1])):
            z = depth[v, u]
            total += wp.float32(1.0)
            if z > wp.float32(0.0):
                count += wp.float32(1.0)
                near = min(near, z)
                far = max(far, z)
    nearest[ty, tx] = near
    farthest[ty, tx] = far
    valid[ty, tx] = count / total


@wp.kernel
def reading_weights(depth: Image, camera: Camera, noise: SensorNoise, best: wp.float32, out: Bytes):
    """Weight of each reading: see ``integration.observation_weights``."""
    v, u = wp.tid()
    h, w = depth.shape[0], depth.shape[1]
    z = depth[v, u]
    weight = float(0.0)
    if u == 0 or u == w - 1:
        weight = wp.where(z > wp.float32(0.0), wp.float32(1.0), wp.float32(0.0))
    else:
        above = max(v - 1, 0)
        below = min(v + 1, h - 1)
        by_rows = camera.fy / wp.float32(max(below - above, 1))
        x = (wp.float32(u) - camera.cx) * (wp.float32(1.0) / camera.fx)
        y = ray(v, camera.cy, camera.fy)
        weight = reading_weight(
            z, depth[v, u - 1], depth[v, u + 1], depth[above, u], depth[below, u], x, y, camera.fx, by_rows, best, noise
        )
    out[v, u] = wp.uint8(wp.int32(weight))


@wp.kernel
def mark_cells(
    depth: Image, camera: Camera, t: Motion, stride: int, lattice: Lattice, free_count: wp.array(dtype=wp.uint8),
    free_after: int, band: TruncationBand, block_size: wp.float32, marks: Indices,
):  # fmt: skip
    """Mark the window cells of blocks without voxels that the truncation bands touch: see ``visibility.mark_blocks``.

    All threads write the same value, so that no order matters.
    """
    row, column = wp.tid()
    u = column * stride
    v = row * stride
    z = depth[v, u]
    if z <= wp.float32(0.0):
        return
    near = z - band_front(z, band)
    far = z + band_behind(z, band)
    x0 = ray(u, camera.cx, camera.fx)
    y0 = ray(v, camera.cy, camera.fy)
    length = wp.sqrt(x0 * x0 + y0 * y0 + wp.float32(1.0))
    steps = 1 + wp.int32(wp.ceil((far - near) * length / (wp.float32(0.6) * block_size)))
    for step in range(steps + 1):
        d = near + (far - near) * wp.float32(step) / wp.float32(steps)
        gx, gy, gz = transform(t, x0 * d, y0 * d, d)
        bx, by, bz = wp.int32(wp.floor(gx)), wp.int32(wp.floor(gy)), wp.int32(wp.floor(gz))
        if bx >= 0 and bx < lattice.nx and by >= 0 and by < lattice.ny and bz >= 0 and bz < lattice.nz:
            cell = (bx * lattice.ny + by) * lattice.nz + bz
            slot = lattice.cells[cell]
            known_free = bool(False)
            if slot <= -2 and (d < z - band.front or d > z + band.behind):
                known_free = wp.int32(free_count[-2 - slot]) >= free_after
            if slot < 0 and not known_free:
                marks[cell] = 1


@wp.kernel
def compact(marks: Indices, ends: Indices, out: Indices):
    """Numbers of the marked elements, ascending; ``ends`` holds the running sum of ``marks``, which are cleared."""
    n = wp.tid()
    if marks[n] != 0:
        out[ends[n] - 1] = n
        marks[n] = 0


@wp.kernel
def pack_pixels(
    depth: Image, rgb: wp.array3d(dtype=wp.uint8), weights: Bytes, p: FusionParameters,
    pixels: wp.array2d(dtype=wp.int32),
):  # fmt: skip
    """Two words per pixel: see ``integration.pack_pixels``."""
    v, u = wp.tid()
    h, w = depth.shape[0], depth.shape[1]
    near = float(FAR)
    for y in range(max(v - 1, 0), min(v + 2, h)):
        for x in range(max(u - 1, 0), min(u + 2, w)):
            q = depth[y, x]
            if q > wp.float32(0.0):
                near = min(near, q)
    z = depth[v, u]
    n = v * w + u
    pixels[n, 0] = pack_reading(z, free_depth(z, near, p.band), wp.float32(1.0) / p.depth_unit)
    pixels[n, 1] = pack_pixel_color(rgb[v, u, 0], rgb[v, u, 1], rgb[v, u, 2], weights[v, u])


@wp.kernel
def visible_slots(
    slots: Indices, coords: wp.array2d(dtype=wp.int32), shift: wp.vec3i, fused: wp.array(dtype=wp.uint8), turn: int,
    t: Motion, camera: Camera, height: int, width: int, block_size: wp.float32, farthest: Image, p: FusionParameters,
    marks: Indices, repeats: wp.array(dtype=wp.float32),
):  # fmt: skip
    """Mark the candidates that the image can change and that are updated now: see ``visibility.visible_slots``.

    Coordinates less ``shift`` are those from which ``t`` leads to the camera.
    """
    n = wp.tid()
    slot = slots[n]
    marks[n] = 0
    half = wp.float32(0.5)
    one = wp.float32(1.0)
    radius = REACH * block_size
    i, j, k = coords[slot, 0] - shift[0], coords[slot, 1] - shift[1], coords[slot, 2] - shift[2]
    x = (wp.float32(i) + half) * block_size
    y = (wp.float32(j) + half) * block_size
    z = (wp.float32(k) + half) * block_size
    cx, cy, cz = transform(t, x, y, z)
    if cz < p.depth_min - radius or cz > p.depth_max + radius + block_size:
        return
    near_z = max(cz - radius, wp.float32(0.05))
    if cz > radius + wp.float32(0.05):
        reach, by_z = radius / near_z, one / cz
        u = project(cx, by_z, camera.fx, camera.cx)
        v = project(cy, by_z, camera.fy, camera.cy)
        ru = reach * camera.fx * (one + abs(cx) / cz)
        rv = reach * camera.fy * (one + abs(cy) / cz)
        if u + ru < 0.0 or v + rv < 0.0 or u - ru > wp.float32(width - 1) or v - rv > wp.float32(height - 1):
            return
        tx0, tx1 = max(wp.int32(wp.floor(u - ru)) / TILE, 0), min(wp.int32(u + ru) / TILE, farthest.shape[1] - 1)
        ty0, ty1 = max(wp.int32(wp.floor(v - rv)) / TILE, 0), min(wp.int32(v + rv) / TILE, farthest.shape[0] - 1)
        far = float(0.0)
        for ty in range(ty0, ty1 + 1):
            for tx in range(tx0, tx1 + 1):
                far = max(far, farthest[ty, tx])
        if cz - radius > far + band_behind(far, p.band):
            return
    alternates = (
        turn >= 0 and wp.int32(fused[slot]) >= SETTLED and p.band.sigmas * sigma(cz, p.band.noise) > p.band.front
    )
    if alternates and ((i + j + k + turn) & 1) != 0:
        return
    marks[n] = 1
    repeats[n] = wp.where(alternates, wp.float32(2.0), one)


@wp.kernel
def integrate(
    slots: Indices, candidates: Indices, repeats: wp.array(dtype=wp.float32), count: wp.float32,
    coords: wp.array2d(dtype=wp.int32), shift: wp.vec3i, t: Motion, camera: Camera, height: int, width: int,
    pixels: wp.array2d(dtype=wp.int32), geometry: wp.array2d(dtype=wp.int32), colors: wp.array2d(dtype=wp.int32),
    p: FusionParameters, occupied: Indices,
):  # fmt: skip
    """Fuse the image into one voxel per thread: see ``integration.integrate_blocks``.

    ``slots`` are numbers of ``candidates``. The count of occupied voxels is an integer, whose sum has no order.
    """
    block, n = wp.tid()
    number = slots[block]
    slot = candidates[number]
    half, one = wp.float32(0.5), wp.float32(1.0)
    ox = wp.float32((coords[slot, 0] - shift[0]) * 8) * p.voxel_size
    oy = wp.float32((coords[slot, 1] - shift[1]) * 8) * p.voxel_size
    oz = wp.float32((coords[slot, 2] - shift[2]) * 8) * p.voxel_size
    x = wp.float32(n / 64) * p.voxel_size
    y = wp.float32((n / 8) % 8) * p.voxel_size
    z = wp.float32(n % 8) * p.voxel_size
    bx, by, bz = transform(t, ox, oy, oz)
    lx = t[0] * x + t[1] * y + t[2] * z
    ly = t[4] * x + t[5] * y + t[6] * z
    lz = t[8] * x + t[9] * y + t[10] * z
    depth = bz + lz
    by_z = one / max(depth, wp.float32(1.0e-3))
    u = wp.floor(project(bx + lx, by_z, camera.fx, camera.cx + half))
    v = wp.floor(project(by + ly, by_z, camera.fy, camera.cy + half))
    reading, color = int(0), int(0)
    if depth > 0.05 and u >= 0.0 and v >= 0.0 and u < wp.float32(width) and v < wp.float32(height):
        pixel = wp.int32(v) * width + wp.int32(u)
        reading = pixels[pixel, 0]
        color = pixels[pixel, 1]
    word, share = fuse_voxel(geometry[slot, n], reading, color, depth, repeats[number] * count, one / p.sdf_unit, p)
    geometry[slot, n] = word
    if share != wp.float32(0.0):
        colors[slot, n] = fuse_color(colors[slot, n], color, share)
    if is_occupied(word, p):
        wp.atomic_add(occupied, block, 1)


@wp.kernel
def observe_free(
    lattice: Lattice, origin: wp.vec3i, parity: int, t: Motion, camera: Camera, height: int, width: int,
    block_size: wp.float32, nearest: Image, valid: Image, band: TruncationBand, depth_max: wp.float32,
    counts: wp.array(dtype=wp.uint8), repeats: int, free_after: int, marks: Indices,
):  # fmt: skip
    """Add observations of emptiness to the cells of one column of the window: see ``visibility.observe_free``."""
    plane, j = wp.tid()
    i = 2 * plane + parity
    one, half, zero = wp.float32(1.0), wp.float32(0.5), wp.float32(0.0)
    radius = REACH * block_size
    left, right = -camera.cx / camera.fx, (wp.float32(width) - one - camera.cx) / camera.fx
    top, bottom = -camera.cy / camera.fy, (wp.float32(height) - one - camera.cy) / camera.fy
    x = (wp.float32(i + origin[0]) + half) * block_size
    y = (wp.float32(j + origin[1]) + half) * block_size
    z0 = (wp.float32(origin[2]) + half) * block_size
    cx, cy, cz = transform(t, x, y, z0)
    dx, dy, dz = t[2] * block_size, t[6] * block_size, t[10] * block_size
    low = float(0.0)
    high = wp.float32(lattice.nz - 1)
    for plane_number in range(6):
        a, b = cx - left * cz, dx - left * dz
        if plane_number == 1:
            a, b = right * cz - cx, right * dz - dx
        elif plane_number == 2:
            a, b = cy - top * cz, dy - top * dz
        elif plane_number == 3:
            a, b = bottom * cz - cy, bottom * dz - dy
        elif plane_number == 4:
            a, b = cz - radius - wp.float32(0.1), dz
        elif plane_number == 5:
            a, b = depth_max - cz, -dz
        if abs(b) < wp.float32(1.0e-9):
            if a < zero:
                high = wp.float32(-1.0)
        elif b > zero:
            low = max(low, -a / b)
        else:
            high = min(high, -a / b)
    if high < low:
        return
    for k in range(wp.int32(wp.ceil(low)), wp.int32(wp.floor(high)) + 1):
        cell = (i * lattice.ny + j) * lattice.nz + k
        known = lattice.cells[cell]
        skipped = bool(known >= 0)
        if known <= -2:
            skipped = wp.int32(counts[-2 - known]) >= free_after
        if not skipped:
            kf = wp.float32(k)
            z = cz + kf * dz
            by_z = one / z
            u = project(cx + kf * dx, by_z, camera.fx, camera.cx)
            v = project(cy + kf * dy, by_z, camera.fy, camera.cy)
            reach = radius / (z - radius)
            ru, rv = reach * camera.fx, reach * camera.fy
            # the centre may lie left of or above the image by less than a pixel, which counts as the first tile
            tx, ty = wp.int32(u), wp.int32(v)
            if tx >= 0 and ty >= 0 and tx / TILE < nearest.shape[1] and ty / TILE < nearest.shape[0]:
                skipped = z + radius >= nearest[ty / TILE, tx / TILE]
            tx0, tx1 = wp.int32(wp.floor(u - ru)), wp.int32(wp.floor(u + ru)) / TILE
            ty0, ty1 = wp.int32(wp.floor(v - rv)), wp.int32(wp.floor(v + rv)) / TILE
            if tx0 < 0 or ty0 < 0 or tx1 >= nearest.shape[1] or ty1 >= nearest.shape[0]:
                skipped = True
            if not skipped:
                near = float(wp.inf)
                share = float(0.0)
                tiles = float(0.0)
                for row in range(ty0 / TILE, ty1 + 1):
                    for column in range(tx0 / TILE, tx1 + 1):
                        near = min(near, nearest[row, column])
                        share += valid[row, column]
                        tiles += one
                if share >= wp.float32(0.6) * tiles and z + radius < near - band_front(near, band):
                    if known <= -2:
                        counts[-2 - known] = wp.uint8(min(wp.int32(counts[-2 - known]) + repeats, 255))
                    else:
                        marks[cell] = 1
