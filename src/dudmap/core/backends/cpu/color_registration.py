"""Loop over a depth image: colour of each pixel in another camera's image of another time.

Rows are processed in stages, see ``registration.py``.
"""

import numpy as np

from dudmap.core.backends.cpu.teams import NO_BAND, done, finish, first_band, take, wait_for_all
from dudmap.core.backends.cpu.vectors import wide_vectors
from dudmap.core.backends.threads import kernel, scalar
from dudmap.core.formulas.pixel import project, ray

NEAREST = np.float32(0.05)
"""Smallest depth in the colour camera, metres, also of nearer points."""


@scalar
def fill_gaps(source, fallback, target):
    """Fill gaps in a row of depths with the last depth before them, or the first depth."""
    first = fallback
    for u in range(source.size):
        if source[u] > np.float32(0):
            first = source[u]
            break
    last = first
    for u in range(source.size):
        z = source[u]
        last = z if z > np.float32(0) else last
        target[u] = last


@scalar
def _along_row(T, y):
    """Motion (3, 4) of the points (x, y, 1) z of a row."""
    return (
        T[0, 0], T[1, 0], T[2, 0], T[0, 1] * y + T[0, 2], T[1, 1] * y + T[1, 2], T[2, 1] * y + T[2, 2],
        T[0, 3], T[1, 3], T[2, 3],
    )  # fmt: skip


@scalar
def _moved(t, x, z):
    return (t[0] * x + t[3]) * z + t[6], (t[1] * x + t[4]) * z + t[7], (t[2] * x + t[5]) * z + t[8]


@scalar
def color_places(v, depth, intrinsics, projection, size, first, across, down, gain):
    """Positions of a row of depth pixels in the colour image, clamped.

    X lies at place X - tau speed X + tau^2 / 2 bend X: T_color_depth exp(-tau xi) X to the second order. One
    fixed-point step for tau and row leaves 0.02 pixels with 20 rows between the images, 30 ms, 1 rad/s and 480 rows.

    Args:
        v: Row.
        depth: (w,) float32 of the row, metres.
        intrinsics: (4,) float32, depth camera.
        projection: ColorProjection.
        size: Heights of depth and colour image, colour width.
        first: (w,) int32 out, upper left of the four colour pixels.
        across, down: (w,) float32 out, position, 0 to 1.
        gain: (w,) float32 out, against vignetting.
    """
    zero, half, one, two = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
    y_ray = ray(v, intrinsics[3], intrinsics[1])
    p, s = _along_row(projection.place, y_ray), _along_row(projection.speed, y_ray)
    b = _along_row(projection.bend, y_ray)
    camera, lens = projection.intrinsics, projection.distortion
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    k1, k2, p1, p2, k3 = lens[0], lens[1], lens[2], lens[3], lens[4]
    offset, readout, height = np.float32(projection.offset), np.float32(projection.readout), np.float32(size[1])
    last_u, last_v, stride = np.float32(size[2] - 1), np.float32(size[1] - 1), np.int32(size[2])
    by_height, by_fx, center = one / height, one / intrinsics[0], intrinsics[2]
    third, falloff = np.float32(1 / 3), np.float32(projection.vignetting)
    middle_u, middle_v = half * last_u, half * last_v
    falloff /= middle_u * middle_u + middle_v * middle_v
    guess = offset + readout * ((np.float32(v) + half) / np.float32(size[0]) - half)
    c = half * guess * guess
    y0, y1, y2 = p[1] - guess * s[1] + c * b[1], p[4] - guess * s[4] + c * b[4], p[7] - guess * s[7] + c * b[7]
    z0, z1, z2 = p[2] - guess * s[2] + c * b[2], p[5] - guess * s[5] + c * b[5], p[8] - guess * s[8] + c * b[8]
    for u in range(depth.size):
        x, z = (np.float32(u) - center) * by_fx, depth[u]
        row = project((y0 * x + y1) * z + y2, one / max((z0 * x + z1) * z + z2, NEAREST), fy, cy)
        # one long loop would exceed the registers and leave execution units idle
        across[u], down[u] = x, offset + readout * ((min(max(row, zero), height) + half) * by_height - half)
    for u in range(depth.size):
        x, z, tau = across[u], depth[u], down[u]
        c = half * tau * tau
        x0, y0, z0 = _moved(p, x, z)
        x1, y1, z1 = _moved(s, x, z)
        x2, y2, z2 = _moved(b, x, z)
        by_z = one / max(z0 - tau * z1 + c * z2, NEAREST)
        a, d = (x0 - tau * x1 + c * x2) * by_z, (y0 - tau * y1 + c * y2) * by_z
        r2 = a * a + d * d
        radial = one + r2 * (k1 + r2 * (k2 + r2 * k3))
        to_u = (a * radial + two * p1 * a * d + p2 * (r2 + two * a * a)) * fx + cx
        to_v = (d * radial + p1 * (r2 + two * d * d) + two * p2 * a * d) * fy + cy
        to_u, to_v = min(to_u if to_u > zero else zero, last_u), min(to_v if to_v > zero else zero, last_v)
        left, top = min(np.floor(to_u), last_u - one), min(np.floor(to_v), last_v - one)
        first[u] = np.int32(np.int32(top) * stride + np.int32(left))
        across[u], down[u] = to_u - left, to_v - top
        a, d = to_u - middle_u, to_v - middle_v
        loss = falloff * (a * a + d * d)
        gain[u] = one + loss * (one + half * loss * (one + third * loss))  # exp(loss)


@scalar
def blended(a, b, c, d, across, down):
    """Bilinear interpolation of four pixels, upper two first."""
    upper, lower = a + across * (b - a), c + across * (d - c)
    return upper + down * (lower - upper)


@scalar
def blended_byte(a, b, c, d, shift, across, down, gain):
    """Bilinear interpolation of one byte of four words, times a gain, rounded."""
    byte = np.int32(255)
    value = blended(
        np.float32((a >> shift) & byte), np.float32((b >> shift) & byte), np.float32((c >> shift) & byte),
        np.float32((d >> shift) & byte), across, down,
    )  # fmt: skip
    return np.int32(min(gain * value, np.float32(255)) + np.float32(0.5))


@scalar
def load_around(words, first, next_row, around):
    """Load the four pixels around each point of a row into ``around`` (4, w)."""
    for u in range(first.size):
        n = np.uintp(first[u])
        around[0, u], around[1, u] = words[n], words[n + np.uintp(1)]
        n += next_row
        around[2, u], around[3, u] = words[n], words[n + np.uintp(1)]


@scalar
def blend_colors(around, across, down, gain, mixed, target):
    """Interpolate these into a row of 3 w bytes; ``mixed`` (w,) int32 is overwritten."""
    for u in range(mixed.size):
        a, b, c, d = around[0, u], around[1, u], around[2, u], around[3, u]
        red = blended_byte(a, b, c, d, 0, across[u], down[u], gain[u])
        green = blended_byte(a, b, c, d, 8, across[u], down[u], gain[u])
        blue = blended_byte(a, b, c, d, 16, across[u], down[u], gain[u])
        mixed[u] = red | green << 8 | blue << 16
    for u in range(mixed.size):
        k, word = np.uintp(3 * u), mixed[u]
        target[k], target[k + np.uintp(1)], target[k + np.uintp(2)] = (
            np.uint8(word), np.uint8(word >> 8), np.uint8(word >> 16)
        )  # fmt: skip


@scalar
def register_rows(start, stop, depth, intrinsics, projection, fallback, size, words, shades, colors):
    """Colours, or intensities, of rows ``start`` to ``stop``; see ``register``."""
    w, next_row = depth.shape[1], np.uintp(size[2])
    filled, across = np.empty(w, np.float32), np.empty(w, np.float32)
    down, gain = np.empty(w, np.float32), np.empty(w, np.float32)
    first, around = np.empty(w, np.int32), np.empty((4, w), np.int32)
    values = around.view(np.float32)
    for v in range(start, stop):
        fill_gaps(depth[v], fallback, filled)
        color_places(v, filled, intrinsics, projection, size, first, across, down, gain)
        load_around(words, first, next_row, around)
        if shades.size > 0:
            row = shades[v]
            for u in range(w):
                shade = blended(values[0, u], values[1, u], values[2, u], values[3, u], across[u], down[u])
                row[u] = gain[u] * shade
        else:
            blend_colors(around, across, down, gain, first, colors[v].reshape(-1))


@kernel
def register(leads, team, rows, depth, intrinsics, projection, fallback, size, words, shades, colors):
    """Interpolated colour or intensity of each depth pixel, for a team of threads (``teams.py``).

    Args:
        rows: Rows of a band.
        depth: (H, W) float32, metres, 0 = the depth of a neighbour in the row.
        intrinsics, projection, size: As for ``color_places``.
        fallback: Float32, depth of empty rows, metres.
        words: (h * w,) int32, bytes red, green, blue from the lowest, or bits of a float32.
        shades: (H, W) float32 out; size 0 for colours.
        colors: (H, W, 3) uint8 out; size 0 for intensities.
    """
    wide_vectors()
    num_bands = -(-depth.shape[0] // rows)
    band, _ = first_band(leads, team, 0, num_bands)
    while band != NO_BAND:
        start, stop = band * rows, min(band * rows + rows, depth.shape[0])
        register_rows(start, stop, depth, intrinsics, projection, fallback, size, words, shades, colors)
        done(team)
        band, _ = take(team, num_bands)
    if leads:
        wait_for_all(team, num_bands)
        finish(team)
