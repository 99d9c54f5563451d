"""Loop over the pixels of a depth image: where each lies in the image of another camera, taken at another time."""

import numpy as np

from dudmap.kernels.pixel import elements, project, ray, transform
from dudmap.kernels.threads import kernel

NEAREST = np.float32(0.05)
"""Depth in the colour camera below which a point is projected as if it were at this depth, metres."""


@kernel
def _filled(source, fallback, target):
    """Depths of a row with gaps filled by the last reading before them, at its start by the first after them."""
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


@kernel
def color_pixels_rows(
    row_start, row_stop, depth, intrinsics, place, speed, bend, color_intrinsics, distortion, offset, readout, height,
    fallback, us, vs,
):  # fmt: skip
    """Colour pixel of each depth pixel of rows ``row_start`` to ``row_stop``.

    A point X of the depth camera lies at place X - tau speed X + tau^2 / 2 bend X in the colour camera, the
    second-order expansion of T_color_depth exp(-tau xi) X. The row gives tau, and tau the row: two steps of a fixed
    point, which contracts by readout times the image speed over the height. Pixels without a reading take the depth of
    a neighbour in their row.

    Args:
        row_start, row_stop: Rows of the band.
        depth: (h, w) float32, metres, 0 = none.
        intrinsics: (4,) float32 of the depth camera.
        place, speed, bend: (3, 4) float32.
        color_intrinsics: (4,) float32 of the colour camera.
        distortion: (5,) float32 k1, k2, p1, p2, k3 of the colour camera (thesis eq. 3.88).
        offset: Time of the middle row of the colour image minus that of the depth image, s.
        readout: Time from the first to the last row of the colour image, s.
        height: Rows of the colour image.
        fallback: Depth of rows without a reading, metres.
        us, vs: (h, w) float32 out, pixel coordinates in the colour image.
    """
    p, s, b = elements(place), elements(speed), elements(bend)
    w = depth.shape[1]
    filled = np.empty(w, np.float32)
    half, one, two = np.float32(0.5), np.float32(1), np.float32(2)
    fx, fy, cx, cy = color_intrinsics[0], color_intrinsics[1], color_intrinsics[2], color_intrinsics[3]
    k1, k2, p1, p2, k3 = distortion[0], distortion[1], distortion[2], distortion[3], distortion[4]
    by_height = one / height
    for v in range(row_start, row_stop):
        _filled(depth[v], fallback, filled)
        to_u, to_v = us[v], vs[v]
        y_ray = ray(v, intrinsics[3], intrinsics[1])
        for u in range(w):
            z = filled[u]
            x, y = ray(u, intrinsics[2], intrinsics[0]) * z, y_ray * z
            x0, y0, z0 = transform(p, x, y, z)
            x1, y1, z1 = transform(s, x, y, z)
            x2, y2, z2 = transform(b, x, y, z)
            tau, by_z = offset, one / max(z0 - offset * z1 + half * offset * offset * z2, NEAREST)
            for _ in range(2):
                row = project(y0 - tau * y1 + half * tau * tau * y2, by_z, fy, cy)
                tau = offset + readout * ((min(max(row, np.float32(0)), height) + half) * by_height - half)
                by_z = one / max(z0 - tau * z1 + half * tau * tau * z2, NEAREST)
            c = half * tau * tau
            a, d = (x0 - tau * x1 + c * x2) * by_z, (y0 - tau * y1 + c * y2) * by_z
            r2 = a * a + d * d
            radial = one + r2 * (k1 + r2 * (k2 + r2 * k3))
            to_u[u] = (a * radial + two * p1 * a * d + p2 * (r2 + two * a * a)) * fx + cx
            to_v[u] = (d * radial + p1 * (r2 + two * d * d) + two * p2 * a * d) * fy + cy
