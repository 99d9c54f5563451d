"""Fusion of a depth image: blocks that it touches, for which the map allocates voxels, and averaging.

Threads share ``BANDS`` bands per step (``teams.py``).
"""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.integration import integrate_blocks, observation_weights, pack_pixels, used_readings
from dudmap.core.backends.cpu.teams import NO_BAND, done, finish, first_band, take, wait_for_all
from dudmap.core.backends.cpu.vectors import wide_vectors
from dudmap.core.backends.cpu.visibility import TILE, mark_blocks, observe_free, tile_ranges, visible_slots
from dudmap.core.backends.parameters import BLOCK, SensorNoise, single
from dudmap.core.backends.threads import kernel, scalar

BANDS = 16
"""Bands of a step."""
MAX_FOUND = 1 << 16
"""Cells that one band may find."""
FRONTAL_WEIGHT = np.float32(4)
"""Weight at normal incidence and reference depth, by angle and noise."""
LEAST_DEPTH = 0.05
"""Smallest largest depth in ``pixel_step``, metres."""


def reading_weights(
    depth: NDArray[np.float32], intrinsics: NDArray[np.float32], noise: SensorNoise
) -> NDArray[np.uint8]:
    """Weight (H, W): cos(theta) / sigma(z) (eq. 4.20), ``FRONTAL_WEIGHT`` at normal incidence and reference depth."""
    weights = np.ones(depth.shape, dtype=np.uint8)
    observation_weights(0, len(depth), depth, intrinsics, single(noise), FRONTAL_WEIGHT, weights)
    return weights


@scalar
def part(size, band):
    """First of ``size`` elements of a band."""
    return size * band // BANDS


@kernel
def touch(
    leads, team, image, used, given, T_blocks_camera, intrinsics, shape, window, free_count, free_after, frame_number,
    stamps, p, depth, nearest, farthest, valid, weights, found, counts, largest,
):  # fmt: skip
    """Prepare an image, and find window cells without voxels that its bands touch.

    Args:
        image: (H, W) float32, metres, 0 = none.
        used: (H, W) bool, pixels to fuse.
        given: Whether ``weights`` is input, else output.
        T_blocks_camera: (3, 4) float32, camera to window blocks.
        shape, window, free_count, free_after, frame_number, stamps: See ``mark_blocks``.
        p: FusionParameters.
        depth: (H, W) float32 out, used depths.
        nearest, farthest, valid: Depth tiles out, see ``tile_ranges``.
        weights: (H, W) uint8 in or out.
        found: (BANDS, n) int32 out, cells; ``counts`` (BANDS,) int64 out.
        largest: (BANDS,) float32 out, metres.
    """
    wide_vectors()
    h, tiles = image.shape[0], nearest.shape[0]
    block_size = np.float32(BLOCK) * p.voxel_size
    step = 0
    while step < 2:
        band, number = first_band(leads, team, step, BANDS)
        if band == NO_BAND and not leads:
            break
        while band != NO_BAND:
            if number == 0:
                first, last = part(tiles, band), part(tiles, band + 1)
                largest[band] = used_readings(TILE * first, min(TILE * last, h), image, used, p.depth_max, depth)
                tile_ranges(first, last, depth, nearest, farthest, valid)
            else:
                first, last = part(h, band), part(h, band + 1)
                if not given:
                    observation_weights(first, last, depth, intrinsics, p.band.noise, FRONTAL_WEIGHT, weights)
                stride = pixel_step(largest, intrinsics[0], block_size)
                rows = -(-h // stride)
                counts[band] = mark_blocks(
                    stride * part(rows, band), min(stride * part(rows, band + 1), h), stride, depth, intrinsics,
                    T_blocks_camera, shape, window, free_count, free_after, frame_number, stamps, p.band, block_size,
                    found[band],
                )  # fmt: skip
            done(team)
            band, number = take(team, BANDS)
        if leads:
            wait_for_all(team, BANDS)
            step += 1
    if leads:
        finish(team)


@scalar
def pixel_step(largest, fx, block_size):
    """Stride of pixels that mark blocks: half a block at the largest depth, 1 to 8."""
    farthest = LEAST_DEPTH
    for band in range(BANDS):
        farthest = max(farthest, np.float64(largest[band]))
    return np.int64(min(max(0.5 * np.float64(block_size) * np.float64(fx) / farthest, 1.0), 8.0))


@kernel
def fuse(
    leads, team, candidates, fused, turn, count, averages, T, intrinsics, size, coords, depth, rgb, weights, nearest,
    farthest, valid, pixels, words, geometry, colors, parameters, parity, window, shape, origin, free_count,
    free_after, slots, repeats, visible, occupied, found, counts,
):  # fmt: skip
    """Average an image into the blocks in view, and observe free space in every second plane.

    Args:
        candidates, fused, turn: As for ``visible_slots``.
        count: Equal frames that this one stands for.
        averages: Whether to fuse, or only to find blocks in view.
        T, intrinsics, size, coords: As for ``visible_slots``.
        nearest, farthest, valid: Depth tiles, see ``tile_ranges``.
        depth, rgb, weights, pixels: See ``pack_pixels``; ``words`` is flat ``pixels``.
        geometry, colors, parameters: As for ``integrate_blocks``.
        parity: First visited plane; negative = none.
        window, shape, origin, free_count, free_after: As for ``observe_free``.
        slots, repeats: (n,) int32 and float32 out, blocks in view, frames that this one stands for.
        visible: (BANDS + 1,) int64 out, blocks in view per band, and total.
        occupied: (n,) int32 out, see ``integrate_blocks``.
        found: (BANDS, n) int32 out, empty cells without entry; ``counts`` (BANDS,) int64 out.
    """
    wide_vectors()
    block_size = np.float32(BLOCK) * parameters.voxel_size
    step = 0
    while step < 2:
        band, number = first_band(leads, team, step, BANDS)
        if band == NO_BAND and not leads:
            break
        while band != NO_BAND:
            if number == 0:
                pack_pixels(part(size[0], band), part(size[0], band + 1), depth, rgb, weights, parameters, pixels)
                visible[band] = visible_slots(
                    part(candidates.size, band), part(candidates.size, band + 1), candidates, coords, fused, turn, T,
                    intrinsics, size, block_size, farthest, parameters.band, parameters.depth_min,
                    parameters.depth_max, slots, repeats,
                )  # fmt: skip
            else:
                if averages:
                    integrate_blocks(
                        part(visible[BANDS], band), part(visible[BANDS], band + 1), slots, repeats, coords, T,
                        intrinsics, size, words, geometry, colors, parameters, occupied,
                    )  # fmt: skip
                if parity >= 0:
                    planes = shape[0] // 2
                    counts[band] = observe_free(
                        2 * part(planes, band) + parity, 2 * part(planes, band + 1) + parity, 2, window, shape, origin,
                        T, intrinsics, size, block_size, nearest, valid, parameters.band,
                        min(parameters.depth_max, farthest_tile(nearest)), free_count, count, free_after, found[band],
                    )  # fmt: skip
            done(team)
            band, number = take(team, BANDS)
        if leads:
            wait_for_all(team, BANDS)
            if step == 0:
                visible[BANDS] = joined(candidates.size, count, slots, repeats, visible)
            step += 1
    if leads:
        finish(team)


@scalar
def joined(size, count, slots, repeats, visible):
    """Join the results of all bands in order; multiply frames by ``count``; returns the total."""
    total = 0
    for band in range(BANDS):
        first = part(size, band)
        for n in range(visible[band]):
            slots[total] = slots[first + n]
            repeats[total] = repeats[first + n] * np.float32(count)
            total += 1
    return total


@scalar
def farthest_tile(nearest):
    """Largest finite depth of the tiles."""
    largest = np.float32(0)
    for z in nearest.flat:
        if np.isfinite(z):
            largest = max(largest, z)
    return largest
