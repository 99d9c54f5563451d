"""Loops over voxels: fusion and carving (thesis section 4.5, algorithm 1)."""

import numpy as np

from dudmap.kernels.threads import kernel


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
