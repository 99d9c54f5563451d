"""Mean colour of the part of a surface that a voxel stands for."""

import numpy as np

from dudmap.core.backends.threads import kernel

LARGEST_RADIUS = 8
"""Largest radius of a window, pixels. The sum of a channel over it must not exceed 21 bits."""
SAME_SURFACE = 4.0
"""Depth differences in a window of up to this many voxels belong to one surface, up to an incidence of 76 degrees."""
GREEN, BLUE = 21, 42
"""Bits by which the sums of these channels are shifted in a word."""
CHANNEL = (1 << 21) - 1
"""Mask of the sum of a channel."""


@kernel
def sum_table(rgb, sums):
    """Sums (H + 1, W + 1) of ``rgb`` (H, W, 3) uint8 over all pixels above and left (Crow 1984), three in a word.

    A word is red + green 2^21 + blue 2^42 modulo 2^64. The sums of a window are differences of four words, which are
    exact, since they fit although the sums of the whole image do not.
    """
    h, w = rgb.shape[:2]
    sums[0] = 0
    for v in range(h):
        source, above, row = rgb[v].reshape(-1), sums[v], sums[v + 1]
        total = np.int64(0)
        row[0] = 0
        for u in range(w):
            red, green, blue = source[np.uintp(3 * u)], source[np.uintp(3 * u + 1)], source[np.uintp(3 * u + 2)]
            total += np.int64(red) + (np.int64(green) << GREEN) + (np.int64(blue) << BLUE)
            row[np.uintp(u + 1)] = above[np.uintp(u + 1)] + total


@kernel
def footprint_means(row_start, row_stop, depth, rgb, sums, by_depth, tolerance, out):
    """Mean colour of each pixel's window, about as wide as a voxel and at most two.

    Voxels sample the image. Where pixels are smaller than voxels, a voxel that takes the colour of one pixel aliases:
    an edge is displaced by up to half a voxel, the same way along all of its length. The window shrinks until its
    corners lie on the pixel's surface, so that no silhouette is smeared.

    Args:
        row_start, row_stop: Rows of the band.
        depth: (H, W) float32, metres, 0 = none.
        rgb: (H, W, 3) uint8.
        sums: (H + 1, W + 1) int64 of ``sum_table``.
        by_depth: Focal length times voxel size: size of a voxel in pixels, times its depth in metres.
        tolerance: Depth differences up to this belong to one surface, metres.
        out: (H, W, 3) uint8 out.
    """
    h, w = depth.shape
    quarter, half, one = np.float32(0.25), np.float32(0.5), np.float32(1)
    for v in range(row_start, row_stop):
        middle, source, target = depth[v], rgb[v].reshape(-1), out[v].reshape(-1)
        widest = min(LARGEST_RADIUS, min(v, h - 1 - v))
        for u in range(w):
            k = np.uintp(3 * u)
            z = middle[u]
            radius = np.int64(half * by_depth / max(z, np.float32(1e-3)) + quarter)
            radius = min(min(radius, widest), min(u, w - 1 - u)) if z > 0 else 0
            while radius > 0:
                top, bottom = depth[np.uintp(v - radius)], depth[np.uintp(v + radius)]
                left, right = np.uintp(u - radius), np.uintp(u + radius)
                a, b, c, d = top[left] - z, top[right] - z, bottom[left] - z, bottom[right] - z
                if max(max(abs(a), abs(b)), max(abs(c), abs(d))) < tolerance:
                    break
                radius -= 1
            if radius == 0:
                for c in range(3):
                    target[k + np.uintp(c)] = source[k + np.uintp(c)]
                continue
            upper, lower = sums[np.uintp(v - radius)], sums[np.uintp(v + radius + 1)]
            left, right = np.uintp(u - radius), np.uintp(u + radius + 1)
            total = lower[right] - lower[left] - upper[right] + upper[left]
            side = np.float32(2 * radius + 1)
            share = one / (side * side)
            target[k] = np.uint8(np.float32(total & CHANNEL) * share + half)
            target[k + np.uintp(1)] = np.uint8(np.float32((total >> GREEN) & CHANNEL) * share + half)
            target[k + np.uintp(2)] = np.uint8(np.float32((total >> BLUE) & CHANNEL) * share + half)
