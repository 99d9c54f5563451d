"""Loops over blocks: which of them a depth image touches, can change, or sees through (thesis section 4.5)."""

import numpy as np

from dudmap.kernels.threads import kernel

TILE = 8
"""Edge of a depth tile of the finest level, pixels."""
SETTLED = 8
"""Frames that are fused into a block before it waits for its turn."""


@kernel
def mark_blocks(
    row_start, row_stop, stride, depth, intrinsics, T, shape, window, free_count, free_after, stamp, stamps, bands,
    found,
):  # fmt: skip
    """Window cells of blocks without voxels that the truncation bands of a depth image touch.

    What is known to be free takes more to get voxels: there the band does not grow with the noise, in the outskirts of
    which blocks would come and go with every frame.

    Args:
        row_start, row_stop, stride: Rows of the band, and the step between pixels.
        depth: (H, W) float32, metres, 0 = none.
        intrinsics: (4,) float32 fx, fy, cx, cy.
        T: (3, 4) float32, camera to window blocks: block units, origin at the window's first block.
        shape: (3,) int64 blocks of the window.
        window: (cells,) int32.
        free_count: (entries,) uint8 observations of emptiness.
        free_after: How many make a block known free space.
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
                    held = window[cell]
                    outside = d < z - bands[0] or d > z + bands[1]
                    if held >= 0 or (held <= -2 and outside and free_count[-2 - held] >= free_after):
                        continue
                    if stamps[cell] != stamp and count < len(found):
                        stamps[cell] = stamp
                        found[count] = cell
                        count += 1
    return count


@kernel
def tile_ranges(row_start, row_stop, depth, nearest, farthest, valid):
    """Nearest and farthest reading and share of pixels with one, per tile of the finest level.

    Args:
        row_start, row_stop: Rows of tiles.
        depth: (H, W) float32.
        nearest, farthest, valid: (ceil(H / TILE), ceil(W / TILE)) float32 out; no reading gives inf, 0, 0.
    """
    for ty in range(row_start, row_stop):
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
def visible_slots(
    start, stop, slots, coords, fused, turn, T, intrinsics, size, edge, nearest, farthest, bands, depth_min, depth_max,
    out, repeats,
):  # fmt: skip
    """Slots of the blocks that a depth image can change, and whose turn it is.

    Blocks so far away that the sensor's noise alone fills the band, which have been fused into often enough to hold
    that noise's mean, take turns: half of them are fused into in one frame, the others in the next, with double weight.

    Args:
        start, stop: Range of candidates.
        slots: (n,) int32 candidates.
        coords: (num_slots, 3) int16 block coordinates by slot.
        fused: (num_slots,) uint8 frames that were fused into a slot.
        turn: Number of this frame; negative where no block waits for its turn.
        T: (3, 4) float32, world to camera.
        intrinsics: (4,) float32.
        size: (2,) int64 image height and width.
        edge: Block edge, metres.
        nearest, farthest: Depth tiles, see ``tile_ranges``.
        bands: See ``mark_blocks``.
        depth_min, depth_max: Range of the readings, metres.
        out: (n,) int32 out, written from ``start`` on.
        repeats: (n,) float32 out, how many frames this one stands for.

    Returns:
        How many slots were written.
    """
    count = start
    radius = np.float32(0.8661) * edge
    front, behind, noise, base, scale = bands[0], bands[1], bands[2], bands[3], bands[4]
    for n in range(start, stop):
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
        waits = (turn >= 0) & (fused[slot] >= SETTLED) & (noise * (base + scale * cz * cz) > front)
        if waits and (coords[slot, 0] + coords[slot, 1] + coords[slot, 2] + turn) & 1:
            continue
        out[count] = slot
        repeats[count] = np.float32(2) if waits else np.float32(1)
        count += 1
    return count - start


@kernel
def observe_free(
    x_start,
    x_stop,
    x_step,
    window,
    shape,
    origin,
    T,
    intrinsics,
    size,
    edge,
    nearest,
    valid,
    bands,
    depth_max,
    counts,
    more,
    enough,
    found,
):
    """Count more observations of emptiness for window cells without voxels that lie wholly in front of everything
    a depth image shows; those that nothing is known of yet are listed instead.

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
        counts: (entries,) uint8, observations of emptiness by entry; changed here.
        more: Observations that are counted.
        enough: Observations after which a cell is not looked at again.
        found: (n,) int32 out, cells without an entry.

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
                known = window[cell]
                if known >= 0:
                    continue
                if known <= -2 and counts[np.uintp(-2 - known)] >= enough:
                    continue
                kf = np.float32(k)
                z = cz + kf * dz
                px, py = cx + kf * dx, cy + kf * dy
                u, v = px / z * intrinsics[0] + intrinsics[2], py / z * intrinsics[1] + intrinsics[3]
                tx0, ty0 = np.int64(u) // TILE, np.int64(v) // TILE
                if 0 <= tx0 < nearest.shape[1] and 0 <= ty0 < nearest.shape[0] and z + radius >= nearest[ty0, tx0]:
                    continue  # most of space is behind something: its middle tells
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
                if z + radius < near - max(front, noise * (base + scale * near * near)):
                    if known <= -2:
                        entry = np.uintp(-2 - known)
                        counts[entry] = min(np.int64(counts[entry]) + more, 255)
                    elif count < len(found):
                        found[count] = cell
                        count += 1
    return count
