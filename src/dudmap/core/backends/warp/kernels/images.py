"""Loops over one image: depth limits, hole filling, depth-adaptive filter, intensities, halving.

One thread per pixel; the loops over the window are those of ``core/backends/cpu/filtering.py``.
"""

import warp as wp

from dudmap.core.backends.cpu import filtering
from dudmap.core.backends.warp.kernels.formulas import between, foreground_mean, range_weight

wp.set_module_options({"enable_backward": False})

ABSENT = wp.constant(wp.float32(float(filtering.ABSENT)))
OUTSIDE = wp.constant(wp.float32(float(filtering.OUTSIDE)))
LONGEST_RUN = wp.constant(filtering.LONGEST_RUN)
MIN_NEIGHBOURS = wp.constant(filtering.MIN_NEIGHBOURS)
Image = wp.array2d(dtype=wp.float32)


@wp.kernel
def limit_depth(depth: Image, low: wp.float32, high: wp.float32, out: Image):
    """Readings within [low, high] metres; all others, also NaN, become 0."""
    v, u = wp.tid()
    z = depth[v, u]
    out[v, u] = wp.where(z >= low and z <= high, z, wp.float32(0.0))


@wp.kernel
def drop_mixed(depth: Image, noise: wp.float32, noise_floor: wp.float32, slope: wp.float32, out: Image):
    """Readings without those between a foreground and a background: see ``filtering.drop_mixed``."""
    v, u = wp.tid()
    h, w = depth.shape[0], depth.shape[1]
    z = depth[v, u]
    kept = z
    for k in range(1, 3):
        gap = max(noise_floor, noise * z * z) + wp.float32(k) * slope * z
        if u >= k and u + k < w:
            if between(z, depth[v, u - k], depth[v, u + k], gap):
                kept = wp.float32(0.0)
        if v >= k and v + k < h:
            if between(z, depth[v - k, u], depth[v + k, u], gap):
                kept = wp.float32(0.0)
    out[v, u] = kept


@wp.func
def to_reading(depth: Image, v: int, u: int, dv: int, du: int):
    """Pixels to the next reading in a direction; 0 = none within LONGEST_RUN."""
    found = int(0)
    for k in range(1, LONGEST_RUN + 1):
        y = v + k * dv
        x = u + k * du
        if found == 0 and y >= 0 and x >= 0 and y < depth.shape[0] and x < depth.shape[1]:
            if depth[y, x] > wp.float32(0.0):
                found = k
    return found


@wp.func
def in_small_hole(depth: Image, v: int, u: int, dv: int, du: int, slope: wp.float32, noise_floor: wp.float32):
    """Whether the run of missing pixels around one is short and its two ends lie on one surface."""
    before = to_reading(depth, v, u, -dv, -du)
    after = to_reading(depth, v, u, dv, du)
    if before == 0 or after == 0 or before + after > LONGEST_RUN + 1:
        return False
    a = depth[v - before * dv, u - before * du]
    b = depth[v + after * dv, u + after * du]
    near = min(a, b)
    return abs(a - b) <= max(noise_floor, slope * near * near)


@wp.kernel
def fill_holes(depth: Image, slope: wp.float32, noise_floor: wp.float32, out: Image):
    """Give pixels of small holes the mean of their valid 5x5 neighbours: see ``filtering.fill_holes``."""
    v, u = wp.tid()
    z = depth[v, u]
    if z <= wp.float32(0.0):
        if in_small_hole(depth, v, u, 0, 1, slope, noise_floor) or in_small_hole(depth, v, u, 1, 0, slope, noise_floor):
            total = float(0.0)
            low = float(wp.inf)
            high = float(0.0)
            count = int(0)
            for y in range(max(v - 2, 0), min(v + 3, depth.shape[0])):
                for x in range(max(u - 2, 0), min(u + 3, depth.shape[1])):
                    q = depth[y, x]
                    if q > wp.float32(0.0):
                        total += q
                        low = min(low, q)
                        high = max(high, q)
                        count += 1
            if count >= MIN_NEIGHBOURS and high - low <= max(noise_floor, slope * low * low):
                z = total / wp.float32(count)
    out[v, u] = z


@wp.func
def tap(image: Image, v: int, u: int):
    """Depth of a tap of the filter: ABSENT without a reading, OUTSIDE beyond the image."""
    if v < 0 or u < 0 or v >= image.shape[0] or u >= image.shape[1]:
        return OUTSIDE
    z = image[v, u]
    return wp.where(z > wp.float32(0.0), z, ABSENT)


@wp.kernel
def bilateral_line(depth: Image, alpha: wp.float32, spatial: wp.array(dtype=wp.float32), dv: int, du: int, out: Image):
    """One direction of the separable depth-adaptive bilateral filter: see ``filtering.bilateral``."""
    v, u = wp.tid()
    z = depth[v, u]
    if z <= wp.float32(0.0):
        out[v, u] = wp.float32(0.0)
        return
    sigma = max(alpha * z * z, wp.float32(1.0e-4))
    inverse = wp.float32(0.0625) / (sigma * sigma)
    numerator = float(0.0)
    denominator = float(1.0)
    for k in range(1, spatial.shape[0]):
        before = tap(depth, v - k * dv, u - k * du)
        after = tap(depth, v + k * dv, u + k * du)
        if min(before, after) > OUTSIDE:
            d = before - z
            e = after - z
            s = range_weight(d, inverse) * spatial[k]
            t = range_weight(e, inverse) * spatial[k]
            numerator += s * d + t * e
            denominator += s + t
    out[v, u] = z + numerator / denominator


@wp.func
def fused_sum(a: wp.float32, b: wp.float32, c: wp.float32):
    """a b + c, rounded once as by the CPU's instruction for it; products of two float32 are exact in float64."""
    return wp.float32(wp.float64(a) * wp.float64(b) + wp.float64(c))


@wp.kernel
def intensities(rgb: wp.array3d(dtype=wp.uint8), red: wp.float32, green: wp.float32, blue: wp.float32, out: Image):
    """Intensity in 0..1 of colours (H, W, 3), to the bit that of the CPU.

    Corners and optical flow cut intensities to whole grey levels, which those of grey pixels are within a rounding.
    """
    v, u = wp.tid()
    r, g, b = wp.float32(rgb[v, u, 0]), wp.float32(rgb[v, u, 1]), wp.float32(rgb[v, u, 2])
    out[v, u] = fused_sum(blue, b, fused_sum(green, g, red * r))


@wp.kernel
def halve(depth: Image, intensity: Image, tolerance: wp.float32, small_depth: Image, small_intensity: Image):
    """Depth and intensity of the next level of the pyramid."""
    v, u = wp.tid()
    y, x = 2 * v, 2 * u
    small_depth[v, u] = foreground_mean(depth[y, x], depth[y, x + 1], depth[y + 1, x], depth[y + 1, x + 1], tolerance)
    upper = intensity[y, x] + intensity[y, x + 1]
    lower = intensity[y + 1, x] + intensity[y + 1, x + 1]
    small_intensity[v, u] = wp.float32(0.25) * (upper + lower)
