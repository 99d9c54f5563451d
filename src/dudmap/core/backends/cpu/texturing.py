"""Triangles drawn into an image, and texture colours gathered from images."""

import numpy as np

from dudmap.core.backends.threads import kernel

NEAREST = np.float32(0.05)
"""Smallest depth of a drawn corner, metres."""
OCTAVE, OCTAVES = 256, 20
"""Steps of a logarithmic weight per factor of 2, and smallest weight, 2^-20."""


@kernel
def draw_triangles(points, faces, margin, numbers, keys):
    """Draw triangles; the smallest key wins: depth, or with a ``margin`` (pixels) the distance from the triangle.

    With a ``margin`` (pixels) pixels outside of a triangle up to this distance belong to it as well, and the key is the
    distance.

    ``points`` (V, 3) float32 are column, row and depth, ``faces`` (F, 3). ``numbers`` (h, w) int32 and ``keys`` (h, w)
    float32: output.
    """
    h, w = numbers.shape
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if min(points[a, 2], points[b, 2], points[c, 2]) < NEAREST:
            continue
        ax, ay, bx, by, cx, cy = points[a, 0], points[a, 1], points[b, 0], points[b, 1], points[c, 0], points[c, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0:
            continue
        left, right = max(0, np.ceil(min(ax, bx, cx) - margin)), min(w - 1, np.floor(max(ax, bx, cx) + margin))
        top, bottom = max(0, np.ceil(min(ay, by, cy) - margin)), min(h - 1, np.floor(max(ay, by, cy) + margin))
        if left > right or top > bottom:
            continue
        # shares of the corners, linear in the pixel, and the heights of the triangle over its sides
        one = np.float32(1)
        sa, sb, sc = one / points[a, 2], one / points[b, 2], one / points[c, 2]
        size = abs(area)
        ha, hb = size / np.hypot(cx - bx, cy - by), size / np.hypot(ax - cx, ay - cy)
        hc = size / np.hypot(bx - ax, by - ay)
        for v in range(int(top), int(bottom) + 1):
            for u in range(int(left), int(right) + 1):
                wa = ((bx - u) * (cy - v) - (by - v) * (cx - u)) / area
                wb = ((cx - u) * (ay - v) - (cy - v) * (ax - u)) / area
                wc = one - wa - wb
                outside = max(-wa * ha, -wb * hb, -wc * hc)
                if outside > max(margin, np.float32(1e-3)):
                    continue
                key = max(outside, np.float32(0)) if margin > 0 else one / (wa * sa + wb * sb + wc * sc)
                if key < keys[v, u]:
                    keys[v, u], numbers[v, u] = key, f


@kernel
def gather_colors(start, stop, numbers, H, quality, tolerance, depth, weights, image, found, colors):
    """Offer an image's colours to texels; each keeps the best.

    Args:
        start, stop: Texture rows.
        numbers: (S, S) int32 triangle, -1 = none.
        H: (F, 3, 3) float32; texel (column, row, 1) to (u z, v z, z) of the image.
        quality: (F,) int32, logarithmic weight of the image, in ``OCTAVE``; 0 = not visible.
        tolerance: (F,) float32, metres behind ``depth``.
        depth: (h, w) float32, metres, of the mesh.
        weights: (h, w) int32, logarithmic weight of pixels; 0 = unused.
        image: (h, w, 3) uint8.
        found: (S, S, K) uint16, sums of both, descending; changed.
        colors: (S, S, K, 3) uint8; changed.
    """
    (h, w), K = depth.shape, found.shape[2]
    for y in range(start, stop):
        for x in range(numbers.shape[1]):
            f = numbers[y, x]
            if f < 0 or quality[f] <= 0:
                continue
            z = H[f, 2, 0] * x + H[f, 2, 1] * y + H[f, 2, 2]
            if z < NEAREST:
                continue
            u = (H[f, 0, 0] * x + H[f, 0, 1] * y + H[f, 0, 2]) / z
            v = (H[f, 1, 0] * x + H[f, 1, 1] * y + H[f, 1, 2]) / z
            if not (u >= 0 and v >= 0 and u < w - 1 and v < h - 1):
                continue
            nu, nv = int(u + np.float32(0.5)), int(v + np.float32(0.5))
            weight = quality[f] + weights[nv, nu]
            if weights[nv, nu] <= 0 or weight <= found[y, x, K - 1] or z > depth[nv, nu] + tolerance[f]:
                continue
            k = K - 1
            while k > 0 and weight > found[y, x, k - 1]:
                found[y, x, k] = found[y, x, k - 1]
                for channel in range(3):
                    colors[y, x, k, channel] = colors[y, x, k - 1, channel]
                k -= 1
            found[y, x, k] = weight
            iu, iv = int(u), int(v)
            du, dv = u - np.float32(iu), v - np.float32(iv)
            one = np.float32(1)
            for channel in range(3):
                upper = (one - du) * image[iv, iu, channel] + du * image[iv, iu + 1, channel]
                lower = (one - du) * image[iv + 1, iu, channel] + du * image[iv + 1, iu + 1, channel]
                colors[y, x, k, channel] = np.uint8((one - dv) * upper + dv * lower + np.float32(0.5))
