"""Loops that write the map: allocation, fusion, carving (thesis section 4.5, algorithm 1)."""

import numpy as np

from dudmap.kernels.threads import kernel

TILE = 8
"""Edge of a depth tile of the finest level, pixels."""


@kernel
def mark_blocks(row_start, row_stop, stride, depth, intrinsics, T, shape, window, stamp, stamps, bands, found):
    """Window cells of blocks without voxels that the truncation bands of a depth image touch.

    Args:
        row_start, row_stop, stride: Rows of the band, and the step between pixels.
        depth: (H, W) float32, metres, 0 = none.
        intrinsics: (4,) float32 fx, fy, cx, cy.
        T: (3, 4) float32, camera to window blocks: block units, origin at the window's first block.
        shape: (3,) int64 blocks of the window.
        window: (cells,) int32.
        stamp: Number of this frame.
        stamps: (cells,) int32, the frame a cell was last named in. Two bands may both name one cell.
        bands: (5,) float32 truncation, truncation behind, truncation_noise, sigma_base, sigma_scale; block edge last.
        found: (n,) int32 out.

    Returns:
        How many cells were found; never more than ``len(found)``.
    """
    count = 0
    edge = bands[5]
    for v in range(row_start, row_stop, stride):
        y0 = (np.float32(v) - intrinsics[3]) / intrinsics[1]
        for u in range(0, depth.shape[1], stride):
            z = depth[v, u]
            if z <= 0:
                continue
            noise = bands[2] * (bands[3] + bands[4] * z * z)
            near = z - max(bands[0], noise)
            far = z + max(bands[1], noise)
            x0 = (np.float32(u) - intrinsics[2]) / intrinsics[0]
            length = np.sqrt(x0 * x0 + y0 * y0 + np.float32(1))
            steps = 1 + np.int64(np.ceil((far - near) * length / (np.float32(0.6) * edge)))
            for step in range(steps + 1):
                d = near + (far - near) * np.float32(step) / np.float32(steps)
                x, y = x0 * d, y0 * d
                bx = np.int64(np.floor(T[0, 0] * x + T[0, 1] * y + T[0, 2] * d + T[0, 3]))
                by = np.int64(np.floor(T[1, 0] * x + T[1, 1] * y + T[1, 2] * d + T[1, 3]))
                bz = np.int64(np.floor(T[2, 0] * x + T[2, 1] * y + T[2, 2] * d + T[2, 3]))
                if 0 <= bx < shape[0] and 0 <= by < shape[1] and 0 <= bz < shape[2]:
                    cell = (bx * shape[1] + by) * shape[2] + bz
                    if window[cell] < 0 and stamps[cell] != stamp and count < len(found):
                        stamps[cell] = stamp
                        found[count] = cell
                        count += 1
    return count


@kernel
def tile_ranges(depth, nearest, farthest, valid):
    """Nearest and farthest reading and share of pixels with one, per tile of the finest level.

    Args:
        depth: (H, W) float32.
        nearest, farthest, valid: (ceil(H / TILE), ceil(W / TILE)) float32 out; no reading gives inf, 0, 0.
    """
    for ty in range(nearest.shape[0]):
        for tx in range(nearest.shape[1]):
            near, far, count, total = np.float32(np.inf), np.float32(0), 0, 0
            for v in range(ty * TILE, min(ty * TILE + TILE, depth.shape[0])):
                for u in range(tx * TILE, min(tx * TILE + TILE, depth.shape[1])):
                    z = depth[v, u]
                    total += 1
                    if z > 0:
                        count += 1
                        near = min(near, z)
                        far = max(far, z)
            nearest[ty, tx], farthest[ty, tx] = near, far
            valid[ty, tx] = np.float32(count) / np.float32(total)


@kernel
def visible_slots(slots, coords, T, intrinsics, size, edge, nearest, farthest, bands, depth_min, depth_max, out):
    """Slots of the blocks that a depth image can change.

    Args:
        slots: (n,) int32 candidates.
        coords: (num_slots, 3) int16 block coordinates by slot.
        T: (3, 4) float32, world to camera.
        intrinsics: (4,) float32.
        size: (2,) int64 image height and width.
        edge: Block edge, metres.
        nearest, farthest: Depth tiles, see ``tile_ranges``.
        bands: See ``mark_blocks``.
        depth_min, depth_max: Range of the readings, metres.
        out: (n,) int32 out.

    Returns:
        How many slots were written.
    """
    count = 0
    radius = np.float32(0.8661) * edge
    behind, noise, base, scale = bands[1], bands[2], bands[3], bands[4]
    for n in range(len(slots)):
        slot = slots[n]
        x = (np.float32(coords[slot, 0]) + np.float32(0.5)) * edge
        y = (np.float32(coords[slot, 1]) + np.float32(0.5)) * edge
        z = (np.float32(coords[slot, 2]) + np.float32(0.5)) * edge
        cz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if cz < depth_min - radius or cz > depth_max + radius + bands[5]:
            continue
        cx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        cy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        near_z = max(cz - radius, np.float32(0.05))
        if cz > radius + np.float32(0.05):
            reach = radius / near_z
            u, v = cx / cz * intrinsics[0] + intrinsics[2], cy / cz * intrinsics[1] + intrinsics[3]
            ru = reach * intrinsics[0] * (np.float32(1) + abs(cx) / cz)
            rv = reach * intrinsics[1] * (np.float32(1) + abs(cy) / cz)
            if u + ru < 0 or v + rv < 0 or u - ru > size[1] - 1 or v - rv > size[0] - 1:
                continue
            tx0, tx1 = max(np.int64(u - ru) // TILE, 0), min(np.int64(u + ru) // TILE, nearest.shape[1] - 1)
            ty0, ty1 = max(np.int64(v - rv) // TILE, 0), min(np.int64(v + rv) // TILE, nearest.shape[0] - 1)
            far = np.float32(0)
            for ty in range(ty0, ty1 + 1):
                for tx in range(tx0, tx1 + 1):
                    far = max(far, farthest[ty, tx])
            if cz - radius > far + max(behind, noise * (base + scale * far * far)):
                continue
        out[count] = slot
        count += 1
    return count


@kernel
def pack_pixels(row_start, row_stop, depth, rgb, weights, readings, colors):
    """What the fusion loads of each pixel, in two words side by side and one more, so that it loads little.

    Args:
        row_start, row_stop: Rows of the band.
        depth: (H, W) float32, metres, 0 = none.
        rgb: (H, W, 3) uint8.
        weights: (H, W) uint8, weight of each reading.
        readings: (H * W + 1, 2) float32 out: the reading, and the nearest of the readings in its 3x3 neighbourhood,
            which decides whether a voxel is surely seen empty; 0 = none. The last row stays as it is.
        colors: (H * W + 1,) int32 out: r << 24 | g << 16 | b << 8 | weight. The last element stays as it is.
    """
    h, w = depth.shape
    far = np.float32(1e9)
    column = np.full(w + 2, far, np.float32)
    for v in range(row_start, row_stop):
        above, middle, below = depth[max(v - 1, 0)], depth[v], depth[min(v + 1, h - 1)]
        for u in range(w):
            a, b, c = above[u], middle[u], below[u]
            a, b, c = a if a > 0 else far, b if b > 0 else far, c if c > 0 else far
            column[np.uintp(u + 1)] = min(min(a, b), c)
        row, shades = readings[v * w : v * w + w], colors[v * w : v * w + w]
        source, gains = rgb[v].reshape(-1), weights[v]
        for u in range(w):
            k = np.uintp(u)
            near = min(min(column[k], column[np.uintp(u + 1)]), column[np.uintp(u + 2)])
            row[k, 0] = middle[k]
            row[k, 1] = near if middle[k] > 0 else np.float32(0)
        for u in range(w):
            r, g, b = source[np.uintp(3 * u)], source[np.uintp(3 * u + 1)], source[np.uintp(3 * u + 2)]
            shades[u] = (np.int32(r) << 24) | (np.int32(g) << 16) | (np.int32(b) << 8) | np.int32(gains[u])


@kernel
def integrate(
    start,
    stop,
    slots,
    coords,
    T,
    intrinsics,
    size,
    readings,
    colors,
    map_geometry,
    map_colors,
    voxel,
    state,
):
    """Fuse one frame into blocks ``slots[start:stop]`` (eq. 4.18-4.23).

    Args:
        start, stop: Range of blocks.
        slots: (n,) int32.
        coords: (num_slots, 3) int16.
        T: (3, 4) float32, world to camera.
        intrinsics: (4,) float32.
        size: (2,) int64 image height and width.
        readings, colors: See ``pack_pixels``.
        map_geometry, map_colors: (num_slots * 512,) int32.
        voxel: (10,) float32: voxel_size, sdf_unit, truncation, truncation_behind, truncation_noise, sigma_base,
            sigma_scale, max_weight, carve_rate, largest storable distance.
        state: (n, 2) int32 out: voxels that hold a surface, voxels seen.
    """
    voxel_size, unit, front, behind = voxel[0], voxel[1], voxel[2], voxel[3]
    noise, base, scale = voxel[4], voxel[5], voxel[6]
    max_weight, carve_rate, limit = voxel[7], voxel[8], voxel[9]
    by_unit = np.float32(1) / unit
    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    height, width = size[0], size[1]
    blank = np.int32(height * width)
    fx, fy = intrinsics[0], intrinsics[1]
    cx, cy = intrinsics[2] + half, intrinsics[3] + half
    local_x = np.empty(512, np.float32)
    local_y = np.empty(512, np.float32)
    local_z = np.empty(512, np.float32)
    for i in range(8):
        for j in range(8):
            for k in range(8):
                n = (i * 8 + j) * 8 + k
                x, y, z = np.float32(i) * voxel_size, np.float32(j) * voxel_size, np.float32(k) * voxel_size
                local_x[n] = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z
                local_y[n] = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z
                local_z[n] = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z
    pixel = np.empty(512, np.int32)
    voxel_z = np.empty(512, np.float32)
    seen = np.empty(512, np.float32)
    seen_near = np.empty(512, np.float32)
    seen_color = np.empty(512, np.int32)
    max_u, max_v = np.float32(width), np.float32(height)

    for block in range(start, stop):
        slot = slots[block]
        ox = np.float32(coords[slot, 0] * 8) * voxel_size
        oy = np.float32(coords[slot, 1] * 8) * voxel_size
        oz = np.float32(coords[slot, 2] * 8) * voxel_size
        bx = T[0, 0] * ox + T[0, 1] * oy + T[0, 2] * oz + T[0, 3]
        by = T[1, 0] * ox + T[1, 1] * oy + T[1, 2] * oz + T[1, 3]
        bz = T[2, 0] * ox + T[2, 1] * oy + T[2, 2] * oz + T[2, 3]
        for n in range(512):
            z = bz + local_z[n]
            by_z = one / max(z, np.float32(1e-3))
            u = np.floor((bx + local_x[n]) * by_z * fx + cx)
            v = np.floor((by + local_y[n]) * by_z * fy + cy)
            ok = (z > np.float32(0.05)) & (u >= zero) & (v >= zero) & (u < max_u) & (v < max_v)
            pixel[n] = np.int32(v) * np.int32(width) + np.int32(u) if ok else blank
            voxel_z[n] = z
        for n in range(512):
            p = np.uintp(pixel[n])
            seen[n] = readings[p, 0]
            seen_near[n] = readings[p, 1]
            seen_color[n] = colors[p]
        first = np.int64(slot) * 512
        surface = np.int32(0)
        known = np.int32(0)
        for n in range(512):
            word = map_geometry[np.uintp(first + n)]
            old_color = map_colors[np.uintp(first + n)]
            d, dn = seen[n], seen_near[n]
            s = d - voxel_z[n]
            sigma = noise * (base + scale * d * d)
            tau = min(max(front, sigma), limit)
            tau_behind = min(max(behind, sigma), limit)
            observed = (d > zero) & (s > -tau_behind)
            banded = observed & (s < tau)
            old_sdf = np.float32(word >> 16) * unit
            old_weight = np.float32((word >> 8) & 0xFF)
            dn_sigma = noise * (base + scale * dn * dn)
            empty = observed & (dn > zero) & (dn - voxel_z[n] > min(max(front, dn_sigma), limit))
            holds = (old_weight > zero) & (old_sdf < tau * np.float32(0.9))
            c = seen_color[n]
            gain = np.float32(c & 0xFF)
            gain = gain * carve_rate if empty & holds else gain
            gain = gain if banded | empty else zero
            value = min(s, tau)
            total = old_weight + gain
            share = gain / max(total, one)
            new_sdf = old_sdf + (value - old_sdf) * share
            new_weight = min(total, max_weight)
            q = np.floor(new_sdf * by_unit + half)
            # colour belongs to the surface: emptiness does not repaint it
            paint = gain / max(total, one) if banded else zero
            r0, g0, b0 = (
                np.float32((old_color >> 20) & 0x3FF),
                np.float32((old_color >> 10) & 0x3FF),
                np.float32(old_color & 0x3FF),
            )
            r1, g1, b1 = np.float32((c >> 22) & 0x3FC), np.float32((c >> 14) & 0x3FC), np.float32((c >> 6) & 0x3FC)
            r1, g1, b1 = r0 + (r1 - r0) * paint, g0 + (g1 - g0) * paint, b0 + (b1 - b0) * paint
            new_color = (
                (np.int32(r1 + half) << np.int32(20)) | (np.int32(g1 + half) << np.int32(10)) | np.int32(b1 + half)
            )
            shade = np.int32(
                (np.float32(0.299) * r1 + np.float32(0.587) * g1 + np.float32(0.114) * b1) * np.float32(0.25) + half
            )
            shade = min(shade, np.int32(255))
            changed = gain > zero
            new_word = (np.int32(q) << np.int32(16)) | (np.int32(new_weight) << np.int32(8)) | shade
            new_word = new_word if changed else word
            map_geometry[np.uintp(first + n)] = new_word
            map_colors[np.uintp(first + n)] = new_color if changed else old_color
            final_weight = (new_word >> 8) & 0xFF
            final_sdf = np.float32(new_word >> 16) * unit
            known += np.int32(1) if final_weight > 0 else np.int32(0)
            surface += np.int32(1) if (final_weight > 0) & (final_sdf < front * np.float32(0.9)) else np.int32(0)
        state[block, 0] = surface
        state[block, 1] = known


@kernel
def observe_free(
    x_start, x_stop, x_step, window, shape, origin, T, intrinsics, size, edge, nearest, valid, bands, depth_max, found
):
    """Window cells without voxels that lie wholly in front of everything a depth image shows.

    Works on columns of the window, so that only the view frustum is visited.

    Args:
        x_start, x_stop, x_step: Window planes of this call.
        window: (cells,) int32.
        shape, origin: (3,) int64 blocks of the window and its first block.
        T: (3, 4) float32, world to camera.
        intrinsics: (4,) float32.
        size: (2,) int64 image height and width.
        edge: Block edge, metres.
        nearest, valid: Depth tiles, see ``tile_ranges``.
        bands: See ``mark_blocks``.
        depth_max: Farthest reading, metres.
        found: (n,) int32 out.

    Returns:
        How many cells were found; never more than ``len(found)``.
    """
    count = 0
    radius = np.float32(0.8661) * edge
    half = np.float32(0.5)
    front, noise, base, scale = bands[0], bands[2], bands[3], bands[4]
    left, right = -intrinsics[2] / intrinsics[0], (np.float32(size[1]) - 1 - intrinsics[2]) / intrinsics[0]
    top, bottom = -intrinsics[3] / intrinsics[1], (np.float32(size[0]) - 1 - intrinsics[3]) / intrinsics[1]
    for bx in range(x_start, x_stop, x_step):
        x = (np.float32(bx + origin[0]) + half) * edge
        for by in range(shape[1]):
            y = (np.float32(by + origin[1]) + half) * edge
            z0 = (np.float32(origin[2]) + half) * edge
            # the column c + k d, k = 0 .. shape[2] - 1, in camera axes; clip k by the five planes of the frustum
            cx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z0 + T[0, 3]
            cy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z0 + T[1, 3]
            cz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z0 + T[2, 3]
            dx, dy, dz = T[0, 2] * edge, T[1, 2] * edge, T[2, 2] * edge
            low, high = np.float32(0), np.float32(shape[2] - 1)
            for plane in range(6):
                if plane == 0:
                    a, b = cx - left * cz, dx - left * dz
                elif plane == 1:
                    a, b = right * cz - cx, right * dz - dx
                elif plane == 2:
                    a, b = cy - top * cz, dy - top * dz
                elif plane == 3:
                    a, b = bottom * cz - cy, bottom * dz - dy
                elif plane == 4:
                    a, b = cz - radius - np.float32(0.1), dz
                else:
                    a, b = depth_max - cz, -dz
                # a + k b >= 0
                if abs(b) < np.float32(1e-9):
                    if a < 0:
                        high = np.float32(-1)
                elif b > 0:
                    low = max(low, -a / b)
                else:
                    high = min(high, -a / b)
            if high < low:
                continue
            for k in range(np.int64(np.ceil(low)), np.int64(np.floor(high)) + 1):
                cell = (bx * shape[1] + by) * shape[2] + k
                if window[cell] >= 0:
                    continue
                kf = np.float32(k)
                z = cz + kf * dz
                px, py = cx + kf * dx, cy + kf * dy
                u, v = px / z * intrinsics[0] + intrinsics[2], py / z * intrinsics[1] + intrinsics[3]
                reach = radius / (z - radius)
                ru, rv = reach * intrinsics[0], reach * intrinsics[1]
                tx0, tx1 = np.int64(np.floor(u - ru)) // TILE, np.int64(np.floor(u + ru)) // TILE
                ty0, ty1 = np.int64(np.floor(v - rv)) // TILE, np.int64(np.floor(v + rv)) // TILE
                if tx0 < 0 or ty0 < 0 or tx1 >= nearest.shape[1] or ty1 >= nearest.shape[0]:
                    continue
                near, share, tiles = np.float32(np.inf), np.float32(0), 0
                for ty in range(ty0, ty1 + 1):
                    for tx in range(tx0, tx1 + 1):
                        near = min(near, nearest[ty, tx])
                        share += valid[ty, tx]
                        tiles += 1
                if share < np.float32(0.6) * np.float32(tiles):
                    continue
                if z + radius < near - max(front, noise * (base + scale * near * near)) and count < len(found):
                    found[count] = cell
                    count += 1
    return count


@kernel
def sample_map(
    row_start,
    row_stop,
    depth,
    intensity,
    intrinsics,
    T,
    window,
    shape,
    geometry,
    unit,
    free_count,
    free_after,
    distance,
    difference,
    place,
):
    """What the map says at the points of a depth image.

    Args:
        row_start, row_stop: Rows of the band.
        depth: (h, w) float32.
        intensity: (h, w) float32 in [0, 1].
        intrinsics: (4,) float32.
        T: (3, 4) float32, camera to window lattice, voxel units.
        window: (cells,) int32.
        shape: (3,) int64.
        geometry: (slots * 512,) int32.
        unit: sdf_unit, metres.
        free_count: (entries,) uint8 observations of emptiness of blocks without voxels.
        free_after: Observations that make free space.
        distance: (h, w) float32 out, metres, NaN where the map has no distance.
        difference: (h, w) float32 out, map minus image intensity, NaN likewise.
        place: (h, w) uint8 out: 0 no reading or unknown space, 1 on the map, 2 in confirmed free space.
    """
    nan = np.float32(np.nan)
    for v in range(row_start, row_stop):
        for u in range(depth.shape[1]):
            z = depth[v, u]
            distance[v, u], difference[v, u], place[v, u] = nan, nan, 0
            if z <= 0:
                continue
            x = (np.float32(u) - intrinsics[2]) / intrinsics[0] * z
            y = (np.float32(v) - intrinsics[3]) / intrinsics[1] * z
            gx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            gy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            gz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            ix, iy, iz = np.int64(np.floor(gx)), np.int64(np.floor(gy)), np.int64(np.floor(gz))
            if ix < 0 or iy < 0 or iz < 0 or ix >= shape[0] * 8 - 1 or iy >= shape[1] * 8 - 1 or iz >= shape[2] * 8 - 1:
                continue
            slot = window[((ix >> 3) * shape[1] + (iy >> 3)) * shape[2] + (iz >> 3)]
            if slot < 0:
                if slot <= -2 and free_count[-2 - slot] >= free_after:
                    place[v, u] = 2
                continue
            sdf, shade, total = np.float32(0), np.float32(0), np.float32(0)
            ax, ay, az = gx - np.float32(ix), gy - np.float32(iy), gz - np.float32(iz)
            for k in range(8):
                i, j, m = ix + (k >> 2), iy + ((k >> 1) & 1), iz + (k & 1)
                other = window[((i >> 3) * shape[1] + (j >> 3)) * shape[2] + (m >> 3)]
                if other < 0:
                    continue
                word = geometry[np.int64(other) * 512 + (((i & 7) * 8 + (j & 7)) * 8 + (m & 7))]
                if (word & 0xFF00) == 0:
                    continue
                part = (ax if k >> 2 else 1 - ax) * (ay if (k >> 1) & 1 else 1 - ay) * (az if k & 1 else 1 - az)
                sdf += part * np.float32(word >> 16)
                shade += part * np.float32(word & 0xFF)
                total += part
            if total < np.float32(0.5):
                continue
            distance[v, u] = sdf / total * unit
            difference[v, u] = shade / total / np.float32(255) - intensity[v, u]
            place[v, u] = 1


@kernel
def observation_weights(row_start, row_stop, depth, intrinsics, sigma_base, sigma_scale, best, out):
    """Weight of each reading: cos(theta) / err(z) (eq. 4.20), scaled so that a frontal one at 1 m gets ``best``.

    Args:
        row_start, row_stop: Rows of the band.
        depth: (H, W) float32, metres, 0 = none.
        intrinsics: (4,) float32.
        sigma_base, sigma_scale: err(z) = sigma_base + sigma_scale z^2, metres.
        best: Weight of a frontal reading at one metre.
        out: (H, W) uint8 out, at least 1 where there is a reading.
    """
    h, w = depth.shape
    err_one = sigma_base + sigma_scale
    for v in range(row_start, row_stop):
        y = (np.float32(v) - intrinsics[3]) / intrinsics[1]
        up, down = max(v - 1, 0), min(v + 1, h - 1)
        for u in range(w):
            z = depth[v, u]
            out[v, u] = 0
            if z <= 0:
                continue
            left, right = max(u - 1, 0), min(u + 1, w - 1)
            zl, zr, zu, zd = depth[v, left], depth[v, right], depth[up, u], depth[down, u]
            cosine = np.float32(0.3)  # at a depth edge the angle is not known: taken as slanted
            edge = np.float32(0.03) * z
            if min(min(zl, zr), min(zu, zd)) > 0 and abs(zl - zr) < edge and abs(zu - zd) < edge:
                x = (np.float32(u) - intrinsics[2]) / intrinsics[0]
                # gradient of the surface z(u, v) in pixels; the normal is (fx dz/du, fy dz/dv, -(z + x fx dz/du + ..))
                gu = intrinsics[0] * (zr - zl) / np.float32(max(right - left, 1))
                gv = intrinsics[1] * (zd - zu) / np.float32(max(down - up, 1))
                nz = -(z + x * gu + y * gv)
                normal = np.sqrt(gu * gu + gv * gv + nz * nz)
                ray = np.sqrt(x * x + y * y + np.float32(1))
                cosine = abs(x * gu + y * gv + nz) / (normal * ray)
            weight = best * cosine * err_one / (sigma_base + sigma_scale * z * z)
            out[v, u] = np.uint8(min(max(weight + np.float32(0.5), np.float32(1)), np.float32(16)))
