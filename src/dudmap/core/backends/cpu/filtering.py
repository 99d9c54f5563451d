"""Loops over one image: depth limits, holes, bilateral filter, intensities, halving.

Rows are sliced before inner loops, because Numba's wrap-around test of indices prevents vectorisation (measured: a
factor 4).
"""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.vectors import wide_vectors
from dudmap.core.backends.parameters import FilterParameters
from dudmap.core.backends.threads import bands, kernel, run_bands, scalar, written_out

f32 = np.float32
ABSENT = np.float32(-1e9)
"""Filter depth without measurement, of vanishing range weight."""
OUTSIDE = np.float32(-2e9)
"""Filter depth of a pixel outside the image."""
LONGEST_RUN = 3
"""Longest run of missing pixels of a small hole."""
MIN_NEIGHBOURS = 8
"""Fewest measurements in the 5x5 neighbourhood of a filled pixel."""
FILTER_ROWS = 120


@kernel
def limit_depth(depth, low, high, out):
    """Keep depths (H, W) float32 within [low, high] metres; others, also NaN, become 0."""
    source, target = depth.reshape(-1), out.reshape(-1)
    for n in range(source.size):
        z = source[n]
        target[n] = z if (z >= low) & (z <= high) else np.float32(0)


@scalar
def between(z, a, b, gap):
    """Whether ``z`` lies between two depths by more than ``gap``; False with missing ones."""
    low, high = min(a, b), max(a, b)
    return (low > np.float32(0)) & (z > low + gap) & (z < high - gap)


@kernel
def drop_mixed(row_start, row_stop, depth, noise, noise_floor, slope, out):
    """Remove flying pixels: one or two pixels away, in row or column, one neighbour is nearer and the opposite farther
    by ``max(noise_floor, noise z^2) + slope z``, as on no measurable surface.

    Args:
        noise, noise_floor: Tolerance, 1/m and metres.
        slope: Step per pixel of the steepest surface, share of the depth.
        out: (H, W) float32 out.
    """
    h, w = depth.shape
    zero = np.float32(0)
    for v in range(row_start, row_stop):
        middle, row = depth[v], out[v]
        row[:] = middle
        for k in range(1, 3):
            before, here, after = middle[: w - 2 * k], middle[k : w - k], middle[2 * k :]
            target = row[k : w - k]
            steepest = np.float32(k) * slope
            for u in range(here.size):
                z = here[u]
                gap = max(noise_floor, noise * z * z) + steepest * z
                target[u] = zero if between(z, before[u], after[u], gap) else target[u]
            if v >= k and v + k < h:
                above, below = depth[v - k], depth[v + k]
                for u in range(w):
                    z = middle[u]
                    gap = max(noise_floor, noise * z * z) + steepest * z
                    row[u] = zero if between(z, above[u], below[u], gap) else row[u]


@scalar
def is_small_hole(a1, a2, a3, b1, b2, b3, slope, noise_floor):
    """Whether the run of missing pixels around one is short and ends on one surface.

    Args:
        a1, a2, a3: Depths one to LONGEST_RUN pixels before, 0 = none.
        b1, b2, b3: Depths after.
        slope, noise_floor: See ``fill_holes``.
    """
    zero, one, two, three = f32(0), f32(1), f32(2), f32(3)
    a, b = a1 if a1 > zero else a2 if a2 > zero else a3, b1 if b1 > zero else b2 if b2 > zero else b3
    before, after = (
        one if a1 > zero else two if a2 > zero else three,
        one if b1 > zero else two if b2 > zero else three,
    )
    near = min(a, b)
    short = before + after <= f32(LONGEST_RUN + 1)
    return (near > zero) & short & (abs(a - b) <= max(noise_floor, slope * near * near))


@kernel
def fill_holes(row_start, row_stop, depth, slope, noise_floor, out):
    """Give pixels of small holes the mean of valid 5x5 neighbours (thesis section 4.3), without bridging depth edges.

    A run of missing pixels, in row or column, is at most LONGEST_RUN long and ends on one surface. At least
    MIN_NEIGHBOURS measurements of 5x5 lie within ``max(noise_floor, slope z^2)``.

    Args:
        slope: Largest depth range over squared depth, 1/m.
        noise_floor: Largest range near the camera, metres.
        out: (H, W) float32 out.
    """
    wide_vectors()
    h, w = depth.shape
    line = np.zeros(w + 2 * LONGEST_RUN, np.float32)
    holes = np.zeros((w + 7) // 8 * 8, np.uint8)
    eights = holes.view(np.uint64)
    zero, one = np.float32(0), np.float32(1)
    for v in range(row_start, row_stop):
        row, target = depth[v], out[v]
        for u in range(w):
            line[np.uintp(u + LONGEST_RUN)] = target[u] = row[u]
        above, above2, above3 = depth[max(v - 1, 0)], depth[max(v - 2, 0)], depth[max(v - 3, 0)]
        below, below2, below3 = depth[min(v + 1, h - 1)], depth[min(v + 2, h - 1)], depth[min(v + 3, h - 1)]
        # rows outside the image have no depth
        i1, i2, i3 = one if v > 0 else zero, one if v > 1 else zero, one if v > 2 else zero
        j1, j2, j3 = one if v + 1 < h else zero, one if v + 2 < h else zero, one if v + 3 < h else zero
        for u in range(w):
            k = np.uintp(u)
            a1, a2, a3 = line[np.uintp(u + 2)], line[np.uintp(u + 1)], line[k]
            b1, b2, b3 = line[np.uintp(u + 4)], line[np.uintp(u + 5)], line[np.uintp(u + 6)]
            in_row = is_small_hole(a1, a2, a3, b1, b2, b3, slope, noise_floor)
            a1, a2, a3 = i1 * above[k], i2 * above2[k], i3 * above3[k]
            b1, b2, b3 = j1 * below[k], j2 * below2[k], j3 * below3[k]
            in_column = is_small_hole(a1, a2, a3, b1, b2, b3, slope, noise_floor)
            holes[k] = (line[np.uintp(u + 3)] <= zero) & (in_row | in_column)
        for n in range(eights.size):
            if eights[np.uintp(n)] == 0:
                continue
            for u in range(8 * n, 8 * n + 8):
                if holes[u] == 0:
                    continue
                total, low, high, count = np.float32(0), np.float32(np.inf), np.float32(0), 0
                for y in range(max(v - 2, 0), min(v + 3, h)):
                    for x in range(max(u - 2, 0), min(u + 3, w)):
                        q = depth[y, x]
                        if q > 0:
                            total += q
                            low, high = min(low, q), max(high, q)
                            count += 1
                if count >= MIN_NEIGHBOURS and high - low <= max(noise_floor, slope * low * low):
                    out[v, u] = total / np.float32(count)


@scalar
def range_weight(difference, inverse):
    """Weight (1 - d^2 inverse)^8 of a depth difference d, 0 beyond d^2 inverse = 1: a Gaussian by arithmetic that
    vectorises; ``inverse`` = 1 / (16 sigma_c^2)."""
    w = max(np.float32(1) - difference * difference * inverse, np.float32(0))
    w = w * w
    w = w * w
    return w * w


@scalar
def _accumulate(middle, before, after, inverse, spatial, numerator, denominator):
    for u in range(middle.size):
        z, scale = middle[u], inverse[u]
        d, e = before[u] - z, after[u] - z
        inside = spatial if min(before[u], after[u]) > OUTSIDE else np.float32(0)
        s, t = range_weight(d, scale) * inside, range_weight(e, scale) * inside
        numerator[u] += s * d + t * e
        denominator[u] += s + t


@scalar
def _start(middle, alpha, inverse, numerator, denominator):
    for u in range(middle.size):
        z = middle[u]
        sigma = max(alpha * z * z, np.float32(1e-4))
        inverse[u] = np.float32(1 / 16) / (sigma * sigma)
        numerator[u] = np.float32(0)
        denominator[u] = np.float32(1)


@kernel
def bilateral(row_start, row_stop, padded, alpha, spatial, out):
    """Depth-adaptive bilateral filter (thesis eq. 4.8-4.11), separable: columns first, then rows.

    Taps whose opposite lies outside the image are omitted, because one alone would bias slanted surfaces.

    Args:
        padded: (H + 2r, W + 2r) float32, metres, ABSENT = none, OUTSIDE in the border.
        alpha: sigma_c over squared depth, 1/m.
        spatial: (r + 1,) float32 weights by pixel distance.
        out: (H, W) float32 out; 0 = no measurement.
    """
    r = spatial.size - 1
    w = padded.shape[1] - 2 * r
    column = np.empty(w + 2 * r, np.float32)
    numerator = np.empty(w + 2 * r, np.float32)
    denominator = np.empty(w + 2 * r, np.float32)
    inverse = np.empty(w + 2 * r, np.float32)
    for v in range(row_start, row_stop):
        middle = padded[v + r]
        _start(middle, alpha, inverse, numerator, denominator)
        for k in range(1, r + 1):
            before, after = padded[v + r - k], padded[v + r + k]
            _accumulate(middle, before, after, inverse, spatial[k], numerator, denominator)
        for u in range(column.size):
            column[u] = middle[u] + numerator[u] / denominator[u]
        middle = column[r : r + w]
        _start(middle, alpha, inverse, numerator, denominator)
        for k in range(1, r + 1):
            before, after = column[r - k : r - k + w], column[r + k : r + k + w]
            _accumulate(middle, before, after, inverse, spatial[k], numerator, denominator)
        row = out[v]
        for u in range(w):
            z = middle[u]
            row[u] = z + numerator[u] / denominator[u] if z > np.float32(0) else np.float32(0)


@kernel
def pad(row_start, row_stop, depth, margin, out):
    """Copy rows of ``depth`` into the middle of ``out`` (H + 2 margin, W + 2 margin), ABSENT for none."""
    w = depth.shape[1]
    for v in range(row_start, row_stop):
        source, target = depth[v], out[v + margin][margin : margin + w]
        for u in range(w):
            z = source[u]
            target[u] = z if z > np.float32(0) else ABSENT


@kernel
def intensities(row_start, row_stop, rgb, out):
    """Intensity 0.299 R + 0.587 G + 0.114 B in 0..1 of ``rgb`` (H, W, 3) uint8 into ``out`` (H, W) float32."""
    red, green, blue = np.float32(0.299 / 255), np.float32(0.587 / 255), np.float32(0.114 / 255)
    for v in range(row_start, row_stop):
        source, shade = rgb[v].reshape(-1), out[v]
        for u in range(shade.size):
            r, g, b = source[np.uintp(3 * u)], source[np.uintp(3 * u + 1)], source[np.uintp(3 * u + 2)]
            shade[u] = red * np.float32(r) + green * np.float32(g) + blue * np.float32(b)


@kernel
def halve_intensity(row_start, row_stop, image, out):
    """Mean of each 2x2 block of ``image`` (2h or 2h + 1, 2w or 2w + 1) into ``out`` (h, w)."""
    quarter = np.float32(0.25)
    for v in range(row_start, row_stop):
        upper, lower, target = image[2 * v], image[2 * v + 1], out[v]
        for u in range(target.size):
            k = np.uintp(2 * u)
            j = np.uintp(2 * u + 1)
            target[u] = quarter * ((upper[k] + upper[j]) + (lower[k] + lower[j]))


@written_out
def foreground_mean(a, b, c, d, band, least):
    """Mean of the depths within ``band max(least, z)`` behind the nearest depth z of four; 0 without depth."""
    zero, one, far = f32(0), f32(1), f32(1e9)
    a, b = a if a > zero else far, b if b > zero else far
    c, d = c if c > zero else far, d if d > zero else far
    near = min(min(a, b), min(c, d))
    limit = near + band * max(least, near)
    wa, wb = one if a <= limit else zero, one if b <= limit else zero
    wc, wd = one if c <= limit else zero, one if d <= limit else zero
    mean = (wa * a + wb * b + wc * c + wd * d) / (wa + wb + wc + wd)
    return mean if near < far else zero


@kernel
def halve_depth(row_start, row_stop, depth, band, least, out):
    """Mean of the depths of each 2x2 block within ``band max(least, z)`` behind the nearest depth z; 0 without."""
    for v in range(row_start, row_stop):
        upper, lower, target = depth[2 * v], depth[2 * v + 1], out[v]
        for u in range(target.size):
            k = np.uintp(2 * u)
            j = np.uintp(2 * u + 1)
            target[u] = foreground_mean(upper[k], upper[j], lower[k], lower[j], band, least)


def filter_depth(depth: NDArray[np.float32], parameters: FilterParameters) -> NDArray[np.float32]:
    """Depth (H, W) in metres, limited, filled and smoothed (thesis section 4.3).

    Args:
        depth: (H, W) float32, metres; NaN and others outside the limits are missing.
        parameters: Limits and filter.
    """
    p, (height, width), ranges = parameters, depth.shape, bands(depth.shape[0], FILTER_ROWS)
    alpha, hole_noise, steepest = np.float32(p.alpha), np.float32(p.hole_noise), np.float32(p.steepest)
    out = np.empty_like(depth)
    limit_depth(depth, np.float32(p.depth_min), np.float32(p.depth_max), out)
    if p.drop_mixed:
        limited, out = out, np.empty_like(depth)
        run_bands(lambda start, stop: drop_mixed(start, stop, limited, alpha, hole_noise, steepest, out), ranges)
    if p.fill_holes:
        holed, out = out, np.empty_like(depth)
        run_bands(lambda start, stop: fill_holes(start, stop, holed, alpha, hole_noise, out), ranges)
    if p.smooth:
        padded, weights = np.full((height + 2 * p.radius, width + 2 * p.radius), OUTSIDE), p.spatial_weights
        pad(0, height, out, p.radius, padded)
        run_bands(lambda start, stop: bilateral(start, stop, padded, alpha, weights, out), ranges)
    return out


def intensity(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Intensities (H, W) in [0, 1] of colours (H, W, 3)."""
    out = np.empty(rgb.shape[:2], dtype=np.float32)
    intensities(0, rgb.shape[0], rgb, out)
    return out


def halve(
    depth: NDArray[np.float32], intensity: NDArray[np.float32], band: float, least: float = 1.0
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth and intensity (H // 2, W // 2): means over 2x2 blocks, depth within ``band max(least, z)`` behind the
    nearest z."""
    small_depth, small_intensity = np.empty((2, depth.shape[0] // 2, depth.shape[1] // 2), dtype=np.float32)
    halve_depth(0, len(small_depth), depth, np.float32(band), np.float32(least), small_depth)
    halve_intensity(0, len(small_intensity), intensity, small_intensity)
    return small_depth, small_intensity
