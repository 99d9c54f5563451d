"""Loop over the pixels of an image whose rows were taken one after the other: what a global shutter would have seen."""

import numpy as np

from dudmap.core.backends.cpu.color_registration import blended, blended_byte, color_places, fill_gaps
from dudmap.core.backends.cpu.teams import NO_BAND, done, finish, first_band, take, wait_for_all
from dudmap.core.backends.cpu.vectors import wide_vectors
from dudmap.core.backends.threads import kernel, scalar

SAME_SURFACE = np.float32(0.03)
"""Depths that differ by less than this share belong to one surface and are interpolated."""


@scalar
def rectify_rows(start, stop, depth, intrinsics, projection, fallback, size, words, out, colors, sources):
    """Rows ``start`` to ``stop``; see ``rectify``."""
    zero, half, height = np.float32(0), np.float32(0.5), np.float32(size[1])
    w, next_row, stride = depth.shape[1], np.uintp(size[2]), np.int32(size[2])
    source_row, across, down = np.empty(w, np.float32), np.empty(w, np.float32), np.empty(w, np.float32)
    first, gain = np.empty(w, np.int32), np.empty(w, np.float32)
    recorded = depth.reshape(-1)
    speed_x, speed_y, speed_z = projection.speed[2, 0], projection.speed[2, 1], projection.speed[2, 3]
    for v in range(start, stop):
        fill_gaps(depth[v], fallback, source_row)
        color_places(v, source_row, intrinsics, projection, size, first, across, down, gain)
        for u in range(w):
            n, row = np.uintp(first[u]), first[u] // stride
            a, b = recorded[n], recorded[n + np.uintp(1)]
            n += next_row
            c, d = recorded[n], recorded[n + np.uintp(1)]
            right, below = across[u] >= half, down[u] >= half
            nearest = (d if right else c) if below else (b if right else a)
            near, far = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
            smooth = (near > zero) & (far - near < SAME_SURFACE * near)
            z = blended(a, b, c, d, across[u], down[u]) if smooth else nearest
            tau = np.float32(projection.readout) * ((np.float32(row) + down[u] + half) / height - half)
            x = (np.float32(u) - intrinsics[2]) / intrinsics[0] * z
            y = (np.float32(v) - intrinsics[3]) / intrinsics[1] * z
            out[v, u] = z + tau * (speed_x * x + speed_y * y + speed_z) if z > zero else zero
            sources[v, u] = first[u] + np.int32(right) + np.int32(below) * stride
        if colors.size == 0:
            continue
        target = colors[v].reshape(-1)
        for u in range(w):
            n, k = np.uintp(first[u]), np.uintp(3 * u)
            a, b = words[n], words[n + np.uintp(1)]
            c, d = words[n + next_row], words[n + next_row + np.uintp(1)]
            target[k] = np.uint8(blended_byte(a, b, c, d, 0, across[u], down[u], gain[u]))
            target[k + np.uintp(1)] = np.uint8(blended_byte(a, b, c, d, 8, across[u], down[u], gain[u]))
            target[k + np.uintp(2)] = np.uint8(blended_byte(a, b, c, d, 16, across[u], down[u], gain[u]))


@kernel
def rectify(leads, team, rows, depth, intrinsics, projection, fallback, size, words, out, colors, sources):
    """Depth, and colours, of each pixel at the time of the middle row, for a team of threads (``teams.py``).

    A pixel of the rectified image shows the recorded pixel to which the camera's motion takes its point until the row
    is read out. The point has the depth that was recorded at the pixel itself, not at the recorded one, which matters
    where the camera moves along a depth edge.

    Args:
        leads, team: As for ``run_team``.
        rows: Rows of a band.
        depth: (H, W) float32, metres, 0 = none.
        intrinsics: (4,) float32.
        projection: ColorProjection of the depth camera into itself, ``place`` the identity.
        fallback: Float32, depth of rows without a reading, metres.
        size: H, H, W.
        words: (H * W,) int32 of the colours recorded in the same pixels; of size 0 where they are not wanted.
        out: (H, W) float32 out, metres; interpolated on a surface, else of the nearest pixel.
        colors: (H, W, 3) uint8 out, interpolated; of size 0 where they are not wanted.
        sources: (H, W) int32 out, number of the nearest recorded pixel.
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
    """Mask (H, W) bool of a rectified image in the recorded one, into ``out``.

    A recorded pixel lies as far from its place in the rectified image as the pixel recorded there, in the other
    direction: the displacement changes by less than a pixel over its own length.
    """
    h, w = mask.shape
    for v in range(h):
        for u in range(w):
            n = sources[v, u]
            row, column = n // w, n % w
            target_v = min(max(2 * v - row, 0), h - 1)
            target_u = min(max(2 * u - column, 0), w - 1)
            out[v, u] = mask[target_v, target_u]
