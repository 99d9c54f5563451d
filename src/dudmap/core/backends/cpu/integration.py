"""Loops over pixels and voxels: fusion and carving (thesis section 4.5, algorithm 1)."""

import numpy as np

from dudmap.core.backends.cpu.memory import load_pair, prefetch_quarter
from dudmap.core.backends.cpu.vectors import wide_vectors
from dudmap.core.backends.threads import scalar
from dudmap.core.formulas.pixel import band_behind, free_depth, project, ray, reading_weight
from dudmap.core.formulas.voxel import fuse_color, fuse_voxel, is_occupied, pack_pixel_color, pack_reading


@scalar
def used_readings(row_start, row_stop, depth, used, farthest, out):
    """Copy depths (H, W) up to ``farthest`` metres at ``used`` pixels (H, W) bool, else 0; returns the largest in these
    rows."""
    largest = np.float32(0)
    for v in range(row_start, row_stop):
        source, chosen, target = depth[v], used[v], out[v]
        for u in range(depth.shape[1]):
            z = source[u]
            kept = z if (z > np.float32(0)) & (z <= farthest) & chosen[u] else np.float32(0)
            target[u] = kept
            largest = max(largest, kept)
    return largest


@scalar
def pack_pixels(row_start, row_stop, depth, rgb, weights, parameters, pixels):
    """Pack each pixel's input into two words (``core/formulas/voxel.py``).

    Free depth is the nearest of 3x3 minus the truncation band there.

    Args:
        rgb: (H, W, 3) uint8.
        weights: (H, W) uint8.
        parameters: FusionParameters.
        pixels: (H * W + 1, 2) int32 out, except the last row.
    """
    wide_vectors()
    h, w = depth.shape
    far, band = np.float32(1e9), parameters.band
    by_unit = np.float32(1) / parameters.depth_unit
    column = np.full(w + 2, far, np.float32)
    first, second = np.empty(w, np.int32), np.empty(w, np.int32)
    for v in range(row_start, row_stop):
        above, middle, below = depth[max(v - 1, 0)], depth[v], depth[min(v + 1, h - 1)]
        for u in range(w):
            a, b, c = above[u], middle[u], below[u]
            a, b, c = a if a > 0 else far, b if b > 0 else far, c if c > 0 else far
            column[np.uintp(u + 1)] = min(min(a, b), c)
        source, gains = rgb[v].reshape(-1), weights[v]
        for u in range(w):
            k = np.uintp(u)
            near = min(min(column[k], column[np.uintp(u + 1)]), column[np.uintp(u + 2)])
            first[k] = pack_reading(middle[k], free_depth(middle[k], near, band), by_unit)
        for u in range(w):
            r, g, b = source[np.uintp(3 * u)], source[np.uintp(3 * u + 1)], source[np.uintp(3 * u + 2)]
            second[u] = pack_pixel_color(r, g, b, gains[u])
        row = pixels[v * w : v * w + w].reshape(-1)
        for u in range(w):
            row[np.uintp(2 * u)], row[np.uintp(2 * u + 1)] = first[u], second[u]


@scalar
def integrate_blocks(
    start, stop, slots, repeats, coords, T, intrinsics, size, pixels, map_geometry, map_colors, parameters, occupied
):
    """Fuse one frame into blocks ``slots[start:stop]`` (eq. 4.18-4.23).

    Args:
        slots: (n,) int32.
        repeats: (n,) float32, frames that this one stands for.
        coords: (num_slots, 3) int32 relative to the origin of T.
        T: (3, 4) float32, world to camera.
        pixels: (2 * (H * W + 1),) int32, see ``pack_pixels``.
        map_geometry, map_colors: (num_slots * 512,) int32, packed.
        parameters: FusionParameters.
        occupied: (n,) int32 out: voxels with a surface or never observed; 1 = some, in unchanged blocks.
    """
    wide_vectors()
    voxel_size = parameters.voxel_size
    by_unit = np.float32(1) / parameters.sdf_unit
    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    height, width = size[0], size[1]
    blank = np.float32(height * width)
    fx, fy = intrinsics[0], intrinsics[1]
    cx, cy = intrinsics[2] + half, intrinsics[3] + half
    # T is written out here: the compiler adds the products of a called function in another order
    local_x = np.empty(512, np.float32)
    local_y = np.empty(512, np.float32)
    local_z = np.empty(512, np.float32)
    lowest = zero
    for i in range(8):
        for j in range(8):
            for k in range(8):
                n = (i * 8 + j) * 8 + k
                x, y, z = np.float32(i) * voxel_size, np.float32(j) * voxel_size, np.float32(k) * voxel_size
                local_x[n] = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z
                local_y[n] = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z
                local_z[n] = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z
                lowest = min(lowest, local_z[n])
    # few arrays, because the compiler vectorises no loop that needs many overlap checks
    pixel = np.empty(512, np.int32)
    seen = np.empty(512, np.int64)
    words = seen.view(np.int32)  # depth and colour word of the voxel's pixel, side by side
    parts = np.empty((2, 512), np.int32)  # the same words in separate rows, for full vector width
    known = np.empty((2, 512), np.float32)  # depth of the voxel; share of the pixel's colour
    max_u, max_v = np.float32(width), np.float32(height)

    # the voxels of the next block are prefetched a quarter at a time, between the loops
    for block in range(start, stop):
        slot = slots[block]
        following = np.uintp(slots[min(block + 1, stop - 1)]) * np.uintp(512)
        prefetch_quarter(map_geometry, following)
        ox = np.float32(coords[slot, 0] * 8) * voxel_size
        oy = np.float32(coords[slot, 1] * 8) * voxel_size
        oz = np.float32(coords[slot, 2] * 8) * voxel_size
        bx = T[0, 0] * ox + T[0, 1] * oy + T[0, 2] * oz + T[0, 3]
        by = T[1, 0] * ox + T[1, 1] * oy + T[1, 2] * oz + T[1, 3]
        bz = T[2, 0] * ox + T[2, 1] * oy + T[2, 2] * oz + T[2, 3]
        for n in range(512):
            z = bz + local_z[n]
            by_z = one / max(z, np.float32(1e-3))
            u = np.floor(project(bx + local_x[n], by_z, fx, cx))
            v = np.floor(project(by + local_y[n], by_z, fy, cy))
            ok = (z > np.float32(0.05)) & (u >= zero) & (v >= zero) & (u < max_u) & (v < max_v)
            pixel[n] = np.int32(v * max_u + u if ok else blank)
            known[0, n] = z
        prefetch_quarter(map_geometry, following + np.uintp(256))
        for n in range(512):
            seen[n] = load_pair(pixels, np.uintp(2 * pixel[n]))
        largest = np.int32(0)
        for n in range(512):
            parts[0, n], parts[1, n] = words[np.uintp(2 * n)], words[np.uintp(2 * n + 1)]
        for n in range(512):
            largest = max(largest, (parts[0, n] >> 16) & 0xFFFF)
        farthest = np.float32(largest) * parameters.depth_unit
        prefetch_quarter(map_colors, following)
        first = np.int64(slot) * 512
        geometry = map_geometry[first : first + 512]
        count = repeats[block]
        num_occupied = painted = zero  # in float32: an integer sum has 64 bits, half as many per register
        behind = min(band_behind(farthest, parameters.band), parameters.band.limit)
        if (farthest == zero) | (farthest - (bz + lowest) <= -behind):
            # no voxel projects to a depth, or all lie behind the farthest band: the image changes none of them
            occupied[block] = 0
            for n in range(512):
                if is_occupied(geometry[n], parameters):
                    occupied[block] = 1
                    break
            continue
        prefetch_quarter(map_colors, following + np.uintp(256))
        for n in range(512):
            word, share = fuse_voxel(geometry[n], parts[0, n], parts[1, n], known[0, n], count, by_unit, parameters)
            geometry[n] = word
            known[1, n] = share
            painted += zero if share == zero else one
            num_occupied += one if is_occupied(word, parameters) else zero
        occupied[block] = np.int32(num_occupied)
        if painted == zero:
            continue
        colors = map_colors[first : first + 512]
        for n in range(512):
            colors[n] = fuse_color(colors[n], parts[1, n], known[1, n])


@scalar
def observation_weights(row_start, row_stop, depth, intrinsics, noise, best, out):
    """Weight of each pixel: cos(theta) / err(z) (eq. 4.20), ``best`` at normal incidence and reference depth.

    Args:
        noise: SensorNoise; err(z) is sigma(z).
        out: (H, W) uint8 out, at least 1 with depth.
    """
    wide_vectors()
    h, w = depth.shape
    zero = np.float32(0)
    fx, fy, cx, by_fx = intrinsics[0], intrinsics[1], intrinsics[2], np.float32(1) / intrinsics[0]
    for v in range(row_start, row_stop):
        y = ray(v, intrinsics[3], fy)
        above, middle, below = depth[max(v - 1, 0)], depth[v], depth[min(v + 1, h - 1)]
        by_rows = fy / np.float32(max(min(v + 1, h - 1) - max(v - 1, 0), 1))
        row = out[v]
        for u in range(1, w - 1):
            k = np.uintp(u)
            left, right = middle[np.uintp(u - 1)], middle[np.uintp(u + 1)]
            z, up, down = middle[k], above[k], below[k]
            x = (np.float32(u) - cx) * by_fx
            row[k] = np.int32(reading_weight(z, left, right, up, down, x, y, fx, by_rows, best, noise))
        row[0] = 1 if middle[0] > zero else 0
        row[w - 1] = 1 if middle[w - 1] > zero else 0
