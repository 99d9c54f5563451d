"""Loops over blocks that a depth image touches, changes, or observes as empty (thesis section 4.5)."""

import numpy as np

from dudmap.core.backends.cpu.vectors import wide_vectors
from dudmap.core.backends.threads import scalar
from dudmap.core.formulas.pixel import band_behind, band_front, elements, project, ray, sigma, transform

TILE = 8
SETTLED = 8
"""Fused frames after which a far block alternates."""
REACH = np.float32(0.8661)
"""Radius around a block over its edge: half of the diagonal."""


@scalar
def mark_blocks(
    row_start, row_stop, stride, depth, intrinsics, T, shape, window, free_count, free_after, frame_number, stamps,
    band, block_size, found,
):  # fmt: skip
    """Window cells without voxels that an image's truncation bands touch.

    A known free block gets voxels only in the fixed part of the band, which does not flicker with noise. Addresses of a
    row come before reads.

    Args:
        row_start, row_stop, stride: Rows, and pixel step.
        T: (3, 4) float32, camera to window blocks, origin at the first.
        shape, window, free_count: See ``VoxelGrid``.
        free_after: Observations of free space.
        frame_number: Number of this frame.
        stamps: (cells,) int32, last frame that found each cell; changed.
        band: TruncationBand.
        found: (n,) int32 out.

    Returns:
        Number of found cells, at most ``len(found)``.
    """
    wide_vectors()
    count, w = 0, -(-depth.shape[1] // stride)
    z, x, near = np.empty(w, np.float32), np.empty(w, np.float32), np.empty(w, np.float32)
    spread, steps = np.empty(w, np.float32), np.empty(w, np.float32)
    cells, beyond = np.empty(w, np.int32), np.empty(w, np.bool_)
    size_x, size_y, size_z = np.int32(shape[0]), np.int32(shape[1]), np.int32(shape[2])
    none, one = np.int32(0), np.float32(1)
    t = elements(T)
    for v in range(row_start, row_stop, stride):
        y, row, most = ray(v, intrinsics[3], intrinsics[1]), depth[v], np.float32(-1)
        for n in range(w):
            z[n], x[n] = row[np.uintp(n * stride)], ray(n * stride, intrinsics[2], intrinsics[0])
            front, behind = band_front(z[n], band), band_behind(z[n], band)
            near[n], spread[n] = z[n] - front, front + behind
            length = np.sqrt(x[n] * x[n] + y * y + one)
            parts = one + np.ceil(spread[n] * length / (np.float32(0.6) * block_size))
            steps[n] = parts if z[n] > np.float32(0) else -one
            most = max(most, steps[n])
        for step in range(np.int64(most) + 1):
            part = np.float32(step)
            for n in range(w):
                d = near[n] + spread[n] * part / steps[n]
                gx, gy, gz = transform(t, x[n] * d, y * d, d)
                bx, by, bz = np.int32(np.floor(gx)), np.int32(np.floor(gy)), np.int32(np.floor(gz))
                inside = (bx >= none) & (by >= none) & (bz >= none) & (bx < size_x) & (by < size_y) & (bz < size_z)
                cells[n] = np.int32((bx * size_y + by) * size_z + bz if inside & (part <= steps[n]) else np.int32(-1))
                beyond[n] = (d < z[n] - band.front) | (d > z[n] + band.behind)
            for n in range(w):
                if cells[n] < 0:
                    continue
                cell = np.uintp(cells[n])
                slot = window[cell]
                if slot >= 0 or (slot <= -2 and beyond[n] and free_count[np.uintp(-2 - slot)] >= free_after):
                    continue
                if stamps[cell] != frame_number and count < len(found):
                    stamps[cell] = frame_number
                    found[count] = cell
                    count += 1
    return count


@scalar
def tile_ranges(row_start, row_stop, depth, nearest, farthest, valid):
    """Depth range and share with depth, per tile.

    Args:
        nearest, farthest, valid: Out, see ``DepthTiles``.
    """
    h, w = depth.shape
    zero, one, none = np.float32(0), np.float32(1), np.float32(np.inf)
    near, far, count = np.empty(w, np.float32), np.empty(w, np.float32), np.empty(w, np.float32)
    for ty in range(row_start, row_stop):
        first, last = ty * TILE, min(ty * TILE + TILE, h)
        near[:], far[:], count[:] = none, zero, zero
        for v in range(first, last):
            row = depth[v]
            for u in range(w):
                z = row[u]
                near[u] = min(near[u], z if z > zero else none)
                far[u] = max(far[u], z)
                count[u] += one if z > zero else zero
        for tx in range(nearest.shape[1]):
            left, right = tx * TILE, min(tx * TILE + TILE, w)
            lowest, highest, readings = none, zero, zero
            for u in range(left, right):
                lowest, highest = min(lowest, near[u]), max(highest, far[u])
                readings += count[u]
            nearest[ty, tx], farthest[ty, tx] = lowest, highest
            valid[ty, tx] = readings / np.float32((right - left) * (last - first))


@scalar
def visible_slots(
    start, stop, slots, coords, fused, turn, T, intrinsics, size, block_size, farthest, band, depth_min, depth_max,
    out, repeats,
):  # fmt: skip
    """Slots of blocks that a depth image can change in this frame.

    A block alternates if noise exceeds the band after SETTLED frames: every second frame, double weight, half of them
    in even frames.

    Args:
        slots: (n,) int32 candidates.
        coords: (num_slots, 3) int32, relative to the origin of T.
        fused: (num_slots,) uint8 fused frames.
        turn: Frame; negative = all are updated.
        T: (3, 4) float32, world to camera.
        farthest: See ``DepthTiles``.
        band: TruncationBand.
        depth_min, depth_max: Depth range, metres.
        out: (n,) int32 out, written from ``start``.
        repeats: (n,) float32 out, frames that this one stands for.

    Returns:
        Number of slots written.
    """
    count = start
    radius = REACH * block_size
    t = elements(T)
    for n in range(start, stop):
        slot = slots[n]
        x = (np.float32(coords[slot, 0]) + np.float32(0.5)) * block_size
        y = (np.float32(coords[slot, 1]) + np.float32(0.5)) * block_size
        z = (np.float32(coords[slot, 2]) + np.float32(0.5)) * block_size
        cx, cy, cz = transform(t, x, y, z)
        if cz < depth_min - radius or cz > depth_max + radius + block_size:
            continue
        alternates = (turn >= 0) & (fused[slot] >= SETTLED) & (band.sigmas * sigma(cz, band.noise) > band.front)
        if alternates and (coords[slot, 0] + coords[slot, 1] + coords[slot, 2] + turn) & 1:
            continue
        near_z = max(cz - radius, np.float32(0.05))
        if cz > radius + np.float32(0.05):
            reach, by_z = radius / near_z, np.float32(1) / cz
            u = project(cx, by_z, intrinsics[0], intrinsics[2])
            v = project(cy, by_z, intrinsics[1], intrinsics[3])
            ru = reach * intrinsics[0] * (np.float32(1) + abs(cx) / cz)
            rv = reach * intrinsics[1] * (np.float32(1) + abs(cy) / cz)
            if u + ru < 0 or v + rv < 0 or u - ru > size[1] - 1 or v - rv > size[0] - 1:
                continue
            tx0, tx1 = max(np.int64(u - ru) // TILE, 0), min(np.int64(u + ru) // TILE, farthest.shape[1] - 1)
            ty0, ty1 = max(np.int64(v - rv) // TILE, 0), min(np.int64(v + rv) // TILE, farthest.shape[0] - 1)
            # the tile at the centre decides for most blocks
            far = farthest[min(max(np.int64(v) // TILE, ty0), ty1), min(max(np.int64(u) // TILE, tx0), tx1)]
            if cz - radius > far + band_behind(far, band):
                for ty in range(ty0, ty1 + 1):
                    for tx in range(tx0, tx1 + 1):
                        far = max(far, farthest[ty, tx])
                if cz - radius > far + band_behind(far, band):
                    continue
        out[count] = slot
        repeats[count] = np.float32(2) if alternates else np.float32(1)
        count += 1
    return count - start


@scalar
def observe_free(
    x_start, x_stop, x_step, window, shape, origin, T, intrinsics, size, block_size, nearest, valid, band, depth_max,
    counts, repeats, free_after, found,
):  # fmt: skip
    """Add observations of emptiness to window cells without voxels before all surfaces; list those without entry.

    Args:
        x_start, x_stop, x_step: Window planes.
        window, shape, origin: See ``VoxelGrid``.
        T: (3, 4) float32, world to camera.
        nearest, valid: See ``DepthTiles``.
        band: TruncationBand.
        depth_max: Largest depth, metres.
        counts: (entries,) uint8, changed.
        repeats: Observations to add.
        free_after: Observations after which a cell is skipped.
        found: (n,) int32 out, cells without entry.

    Returns:
        Number of found cells, at most ``len(found)``.
    """
    count = 0
    radius = REACH * block_size
    half = np.float32(0.5)
    t = elements(T)
    left, right = -intrinsics[2] / intrinsics[0], (np.float32(size[1]) - 1 - intrinsics[2]) / intrinsics[0]
    top, bottom = -intrinsics[3] / intrinsics[1], (np.float32(size[0]) - 1 - intrinsics[3]) / intrinsics[1]
    for bx in range(x_start, x_stop, x_step):
        x = (np.float32(bx + origin[0]) + half) * block_size
        for by in range(shape[1]):
            y = (np.float32(by + origin[1]) + half) * block_size
            z0 = (np.float32(origin[2]) + half) * block_size
            # the column c + k d, k = 0 .. shape[2] - 1, in camera axes; clip k by the six planes of the frustum
            cx, cy, cz = transform(t, x, y, z0)
            dx, dy, dz = t[2] * block_size, t[6] * block_size, t[10] * block_size
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
                known = window[cell]
                if known >= 0:
                    continue
                if known <= -2 and counts[np.uintp(-2 - known)] >= free_after:
                    continue
                kf = np.float32(k)
                z = cz + kf * dz
                px, py = cx + kf * dx, cy + kf * dy
                by_z = np.float32(1) / z
                u = project(px, by_z, intrinsics[0], intrinsics[2])
                v = project(py, by_z, intrinsics[1], intrinsics[3])
                tx0, ty0 = np.int64(u) // TILE, np.int64(v) // TILE
                if 0 <= tx0 < nearest.shape[1] and 0 <= ty0 < nearest.shape[0] and z + radius >= nearest[ty0, tx0]:
                    continue  # most of space is occluded; the centre shows this at less cost
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
                if z + radius < near - band_front(near, band):
                    if known <= -2:
                        entry = np.uintp(-2 - known)
                        counts[entry] = min(np.int64(counts[entry]) + repeats, 255)
                    elif count < len(found):
                        found[count] = cell
                        count += 1
    return count
