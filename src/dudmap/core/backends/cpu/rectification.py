"""Rectification of rolling-shutter images: loop over the pixels of the global-shutter image."""

import numpy as np

from dudmap.core.backends.cpu.color_registration import blend_colors, blended, color_places, fill_gaps, load_around
from dudmap.core.backends.cpu.teams import NO_BAND, done, finish, first_band, take, wait_for_all
from dudmap.core.backends.cpu.vectors import wide_vectors
from dudmap.core.backends.threads import kernel, scalar

SAME_SURFACE = np.float32(0.03)
"""Largest depth difference on one surface, share of the depth."""


@scalar
def rectify_rows(start, stop, depth, intrinsics, projection, fallback, size, words, out, colors, sources):
    """Rows ``start`` to ``stop``; see ``rectify``."""
    zero, half, height = np.float32(0), np.float32(0.5), np.float32(size[1])
    w, next_row, stride = depth.shape[1], np.uintp(size[2]), np.int32(size[2])
    source_row, across, down = np.empty(w, np.float32), np.empty(w, np.float32), np.empty(w, np.float32)
    first, gain, around = np.empty(w, np.int32), np.empty(w, np.float32), np.empty((4, w), np.int32)
    depths, recorded = around.view(np.float32), depth.reshape(-1).view(np.int32)
    by_stride = 1 / np.float64(size[2])
    speed_x, speed_y, speed_z = projection.speed[2, 0], projection.speed[2, 1], projection.speed[2, 3]
    readout, by_height = np.float32(projection.readout), np.float32(1) / height
    center, by_fx, y = intrinsics[2], np.float32(1) / intrinsics[0], zero
    for v in range(start, stop):
        fill_gaps(depth[v], fallback, source_row)
        color_places(v, source_row, intrinsics, projection, size, first, across, down, gain)
        load_around(recorded, first, next_row, around)
        y = (np.float32(v) - intrinsics[3]) / intrinsics[1]
        for u in range(w):
            a, b, c, d = depths[0, u], depths[1, u], depths[2, u], depths[3, u]
            right, below = across[u] >= half, down[u] >= half
            nearest = (d if right else c) if below else (b if right else a)
            near, far = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
            smooth = (near > zero) & (far - near < SAME_SURFACE * near)
            z = blended(a, b, c, d, across[u], down[u]) if smooth else nearest
            row = np.float32(np.floor((np.float64(first[u]) + 0.5) * by_stride))
            tau = readout * ((row + down[u] + half) * by_height - half)
            x = (np.float32(u) - center) * by_fx
            out[v, u] = z + tau * ((speed_x * x + speed_y * y) * z + speed_z) if z > zero else zero
            sources[v, u] = first[u] + (np.int32(1) if right else np.int32(0)) + (stride if below else np.int32(0))
        if colors.size > 0:
            load_around(words, first, next_row, around)
            blend_colors(around, across, down, gain, first, colors[v].reshape(-1))


@kernel
def rectify(leads, team, rows, depth, intrinsics, projection, fallback, size, words, out, colors, sources):
    """Depth and colours at the time of the middle row, for a team of threads.

    A rectified pixel shows the recorded pixel to which its point moves; the point has the depth recorded at its own
    position.

    Args:
        rows: Rows of a band.
        projection: ColorProjection of the depth camera into itself, identity ``place``.
        fallback: Float32, depth of empty rows, metres.
        size: H, H, W.
        words: (H * W,) int32 colours; size 0 if unused.
        out: (H, W) float32 out, metres, interpolated on a surface.
        colors: (H, W, 3) uint8 out, interpolated; size 0 if unused.
        sources: (H, W) int32 out, nearest recorded pixel.
    """
    wide_vectors()
    num_bands = -(-depth.shape[0] // rows)
    band, _ = first_band(leads, team, 0, num_bands)
    while band != NO_BAND:
        start, stop = band * rows, min(band * rows + rows, depth.shape[0])
        rectify_rows(start, stop, depth, intrinsics, projection, fallback, size, words, out, colors, sources)
        done(team)
        band, _ = take(team, num_bands)
    if leads:
        wait_for_all(team, num_bands)
        finish(team)


@kernel
def recorded_mask(mask, sources, out):
    """Mask (H, W) bool of a rectified image in the recorded geometry, into ``out``, by negative displacements, within a
    pixel."""
    h, w = np.int32(mask.shape[0]), np.int32(mask.shape[1])
    flat, by_width, places = mask.reshape(-1), 1 / np.float64(w), np.empty(w, np.int32)
    for v in range(np.int32(0), h):
        for u in range(np.int32(0), w):
            n = sources[v, u]
            row = np.int32(np.floor((np.float64(n) + 0.5) * by_width))  # a division would not be vectorised
            column = n - row * w
            target_v = min(max(np.int32(2 * v) - row, np.int32(0)), h - np.int32(1))
            target_u = min(max(np.int32(2 * u) - column, np.int32(0)), w - np.int32(1))
            places[u] = target_v * w + target_u
        for u in range(w):
            out[v, u] = flat[np.uintp(places[u])]
