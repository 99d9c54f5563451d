"""Loops over voxels: fusion and carving (thesis section 4.5, algorithm 1)."""

import numpy as np

from dudmap.kernels.threads import kernel
from dudmap.kernels.words import bits, upper_half


@kernel
def pack_pixels(row_start, row_stop, depth, rgb, weights, bands, pixels):
    """What the fusion loads of each pixel, in two words, so that it loads little.

    Args:
        row_start, row_stop: Rows of the band.
        depth: (H, W) float32, metres, 0 = none.
        rgb: (H, W, 3) uint8.
        weights: (H, W) uint8, weight of each reading.
        bands: (5,) float32: truncation, truncation_noise, sigma_base, sigma_scale, largest storable distance; the unit
            of depth last.
        pixels: (H * W + 1, 2) int32 out. First: reading << 16 | depth in front of which the pixel surely sees nothing,
            both in units, 0 = none; the latter is the nearest reading of the 3x3 neighbourhood less its band. Second:
            r << 24 | g << 16 | b << 8 | weight. The last row stays as it is.
    """
    h, w = depth.shape
    far = np.float32(1e9)
    zero, half = np.float32(0), np.float32(0.5)
    front, noise, base, scale, limit = bands[0], bands[1], bands[2], bands[3], bands[4]
    by_unit = np.float32(1) / bands[5]
    column = np.full(w + 2, far, np.float32)
    for v in range(row_start, row_stop):
        above, middle, below = depth[max(v - 1, 0)], depth[v], depth[min(v + 1, h - 1)]
        for u in range(w):
            a, b, c = above[u], middle[u], below[u]
            a, b, c = a if a > 0 else far, b if b > 0 else far, c if c > 0 else far
            column[np.uintp(u + 1)] = min(min(a, b), c)
        row = pixels[v * w : v * w + w]
        source, gains = rgb[v].reshape(-1), weights[v]
        for u in range(w):
            k = np.uintp(u)
            near = min(min(column[k], column[np.uintp(u + 1)]), column[np.uintp(u + 2)])
            empty = near - min(max(front, noise * (base + scale * near * near)), limit)
            empty = max(empty, zero) if middle[k] > zero else zero
            row[k, 0] = (np.int32(middle[k] * by_unit + half) << np.int32(16)) | np.int32(empty * by_unit)
        for u in range(w):
            r, g, b = source[np.uintp(3 * u)], source[np.uintp(3 * u + 1)], source[np.uintp(3 * u + 2)]
            row[u, 1] = (np.int32(r) << 24) | (np.int32(g) << 16) | (np.int32(b) << 8) | np.int32(gains[u])


@kernel
def integrate(
    start, stop, slots, repeats, coords, T, intrinsics, size, pixels, map_geometry, map_colors, voxel, occupied
):
    """Fuse one frame into blocks ``slots[start:stop]`` (eq. 4.18-4.23).

    Args:
        start, stop: Range of blocks.
        slots: (n,) int32.
        repeats: (n,) float32, how many frames this one stands for.
        coords: (num_slots, 3) int16.
        T: (3, 4) float32, world to camera.
        intrinsics: (4,) float32.
        size: (2,) int64 image height and width.
        pixels: (H * W + 1,) int64, the two words of ``pack_pixels`` as one.
        map_geometry, map_colors: (num_slots * 512,) int32.
        voxel: (12,) float32: voxel_size, sdf_unit, truncation, truncation_behind, truncation_noise, sigma_base,
            sigma_scale, max_weight, carve_rate, largest storable distance, unit of depth, max_readings.
        occupied: (n,) int32 out: voxels that hold a surface or were never seen.
    """
    voxel_size, unit, front, behind = voxel[0], voxel[1], voxel[2], voxel[3]
    noise, base, scale = voxel[4], voxel[5], voxel[6]
    max_weight, carve_rate, limit, depth_unit = voxel[7], voxel[8], voxel[9], voxel[10]
    max_readings = voxel[11]
    by_unit = np.float32(1) / unit
    zero, half, one, young = np.float32(0), np.float32(0.5), np.float32(1), np.float32(8)
    height, width = size[0], size[1]
    blank = np.float32(height * width)
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
    # few arrays, since the compiler vectorises no loop that needs many checks whether two of them overlap
    pixel = np.empty(512, np.int32)
    seen = np.empty(512, np.int64)
    words = seen.view(np.int32)  # reading and colour of the voxel's pixel, side by side
    # depth of the voxel; the share in which it takes on the pixel's colour, -1: only if it has none yet
    known = np.empty((2, 512), np.float32)
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
            pixel[n] = np.int32(v * max_u + u if ok else blank)
            known[0, n] = z
        for n in range(512):
            seen[n] = pixels[np.uintp(pixel[n])]
        first = np.int64(slot) * 512
        geometry = map_geometry[first : first + 512]
        times = repeats[block]
        held = painted = zero  # counted in float32: an integer sum has 64 bits, half as many in a register
        for n in range(512):
            word, reading, c = geometry[n], words[2 * n], words[2 * n + 1]
            d = bits(reading, 16, 0xFFFF) * depth_unit
            z = known[0, n]
            s = d - z
            sigma = noise * (base + scale * d * d)
            tau = min(max(front, sigma), limit)
            observed = (d > zero) & (s > -min(max(behind, sigma), limit))
            banded = observed & (s < tau)
            empty = observed & (bits(reading, 0, 0xFFFF) * depth_unit > z)
            old_sdf = upper_half(word) * unit
            old_weight = bits(word, 8, 0xFF)
            holds = (old_weight > zero) & (old_sdf < tau * np.float32(0.9))
            gain = bits(c, 0, 0xFF) * times
            gain = gain * carve_rate if empty & holds else gain
            gain = gain if banded | empty else zero
            total = old_weight + gain
            share = gain / max(total, one)
            most = max(old_weight, min(max_weight, max_readings * bits(c, 0, 0xFF)))
            new_sdf = old_sdf + (min(s, tau) - old_sdf) * share
            # intensity and colour belong to the surface: emptiness does not repaint it
            share = share if banded else zero
            shade = np.float32(0.299) * bits(c, 24, 0xFF) + np.float32(0.587) * bits(c, 16, 0xFF)
            shade += np.float32(0.114) * bits(c, 8, 0xFF)
            old_shade = bits(word, 0, 0xFF)
            new_shade = old_shade + (shade - old_shade) * share
            new_word = (
                (np.int32(np.floor(new_sdf * by_unit + half)) << np.int32(16))
                | (np.int32(min(total, most)) << np.int32(8))
                | np.int32(new_shade + half)
            )
            new_word = np.int32(new_word) if gain > zero else word
            geometry[n] = new_word
            near = abs(s) < max(np.float32(2.5) * voxel_size, np.float32(0.4) * tau)
            first_sight = banded & (old_weight < young)
            share = share if near else (-one if first_sight else zero)
            known[1, n] = share
            painted += zero if share == zero else one
            surface = (bits(new_word, 8, 0xFF) == zero) | (upper_half(new_word) * unit < front * np.float32(0.9))
            held += one if surface else zero
        occupied[block] = np.int32(held)
        if painted == zero:
            continue
        shades = map_colors[first : first + 512]
        for n in range(512):
            old, c = shades[n], words[2 * n + 1]
            share = known[1, n]
            share = max(share, zero) if old != 0 else min(abs(share) * np.float32(1e6), one)
            r0, g0, b0 = bits(old, 20, 0x3FF), bits(old, 10, 0x3FF), bits(old, 0, 0x3FF)
            r1, g1, b1 = bits(c, 22, 0x3FC), bits(c, 14, 0x3FC), bits(c, 6, 0x3FC)
            r1, g1, b1 = r0 + (r1 - r0) * share, g0 + (g1 - g0) * share, b0 + (b1 - b0) * share
            shades[n] = (
                (np.int32(r1 + half) << np.int32(20)) | (np.int32(g1 + half) << np.int32(10)) | np.int32(b1 + half)
            )


@kernel
def clear(start, stop, slots, geometry, colors):
    """Empty the voxels of ``slots[start:stop]`` (n,) int32, rows of ``geometry`` and ``colors`` (num_slots, 512)."""
    for n in range(start, stop):
        shapes, shades = geometry[slots[n]], colors[slots[n]]
        for voxel in range(512):
            shapes[voxel] = 0
            shades[voxel] = 0


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
    zero, half, one, slanted = np.float32(0), np.float32(0.5), np.float32(1), np.float32(0.3)
    fx, fy, cx, by_fx = intrinsics[0], intrinsics[1], intrinsics[2], np.float32(1) / intrinsics[0]
    err_one = sigma_base + sigma_scale
    for v in range(row_start, row_stop):
        y = (np.float32(v) - intrinsics[3]) / fy
        above, middle, below = depth[max(v - 1, 0)], depth[v], depth[min(v + 1, h - 1)]
        by_rows = fy / np.float32(max(min(v + 1, h - 1) - max(v - 1, 0), 1))
        row = out[v]
        for u in range(1, w - 1):
            k = np.uintp(u)
            left, right = middle[np.uintp(u - 1)], middle[np.uintp(u + 1)]
            z, up, down = middle[k], above[k], below[k]
            x = (np.float32(u) - cx) * by_fx
            # gradient of the surface z(u, v) in pixels; the normal is (fx dz/du, fy dz/dv, -(z + x fx dz/du + ..)), and
            # its product with the ray (x, y, 1) is -z
            gu, gv = half * fx * (right - left), by_rows * (down - up)
            nz = z + x * gu + y * gv
            cosine = z / np.sqrt((gu * gu + gv * gv + nz * nz) * (x * x + y * y + one))
            step = max(abs(left - right), abs(up - down))
            smooth = (min(min(left, right), min(up, down)) > zero) & (step < np.float32(0.03) * z)
            cosine = cosine if smooth else slanted  # at a depth edge the angle is not known: taken as slanted
            weight = best * cosine * err_one / (sigma_base + sigma_scale * z * z)
            weight = min(max(weight + half, one), np.float32(16)) if z > zero else zero
            row[k] = np.int32(weight)
        row[0] = 1 if middle[0] > zero else 0
        row[w - 1] = 1 if middle[w - 1] > zero else 0
