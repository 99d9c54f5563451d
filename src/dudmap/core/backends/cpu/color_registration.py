"""Loop over the pixels of a depth image: where each lies in the image of another camera, taken at another time."""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.parameters import ColorProjection
from dudmap.core.backends.threads import kernel, scalar
from dudmap.core.formulas.pixel import elements, project, ray, transform

NEAREST = np.float32(0.05)
"""Depth in the colour camera below which a point is projected as if it were at this depth, metres."""


@scalar
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
    second-order expansion of T_color_depth exp(-tau xi) X. The row gives tau, and tau the row: a step of a fixed point
    from the row of the depth image on, which contracts by readout times the image speed over the height: with 20 rows
    between the images, 30 ms and 1 rad/s at 480 rows, 0.02 pixels are left. Pixels without a reading take the depth of
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
        us, vs: (row_stop - row_start, w) float32 out, pixel coordinates in the colour image.
    """
    p, s, b = elements(place), elements(speed), elements(bend)
    w = depth.shape[1]
    filled = np.empty(w, np.float32)
    zero, half, one, two = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
    fx, fy, cx, cy = color_intrinsics[0], color_intrinsics[1], color_intrinsics[2], color_intrinsics[3]
    k1, k2, p1, p2, k3 = distortion[0], distortion[1], distortion[2], distortion[3], distortion[4]
    by_height, by_fx = one / height, one / intrinsics[0]
    for v in range(row_start, row_stop):
        _filled(depth[v], fallback, filled)
        to_u, to_v = us[v - row_start], vs[v - row_start]
        y_ray = ray(v, intrinsics[3], intrinsics[1])
        guess = offset + readout * ((np.float32(v) + half) / np.float32(depth.shape[0]) - half)
        c_guess = half * guess * guess
        for u in range(w):
            z = filled[u]
            x, y = (np.float32(u) - intrinsics[2]) * by_fx * z, y_ray * z
            x0, y0, z0 = transform(p, x, y, z)
            x1, y1, z1 = transform(s, x, y, z)
            x2, y2, z2 = transform(b, x, y, z)
            row = project(y0 - guess * y1 + c_guess * y2, one / max(z0 - guess * z1 + c_guess * z2, NEAREST), fy, cy)
            tau = offset + readout * ((min(max(row, zero), height) + half) * by_height - half)
            c = half * tau * tau
            by_z = one / max(z0 - tau * z1 + c * z2, NEAREST)
            a, d = (x0 - tau * x1 + c * x2) * by_z, (y0 - tau * y1 + c * y2) * by_z
            r2 = a * a + d * d
            radial = one + r2 * (k1 + r2 * (k2 + r2 * k3))
            to_u[u] = (a * radial + two * p1 * a * d + p2 * (r2 + two * a * a)) * fx + cx
            to_v[u] = (d * radial + p1 * (r2 + two * d * d) + two * p2 * a * d) * fy + cy


def color_pixels(
    depth: NDArray[np.float32],
    intrinsics: NDArray[np.float32],
    projection: ColorProjection,
    fallback: float,
    start: int,
    stop: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Coordinates u, v (stop - start, W) in the colour image of each pixel of rows of a depth image.

    Args:
        depth: (H, W) float32, metres, 0 = none; such pixels take the depth of a neighbour in their row.
        intrinsics: (4,) float32 fx, fy, cx, cy of the depth image.
        projection: Of the colour camera.
        fallback: Depth of rows without a reading, metres.
        start, stop: First row, and that after the last.
    """
    us, vs = np.empty((2, stop - start, depth.shape[1]), dtype=np.float32)
    arrays, numbers = projection[:5], [np.float32(value) for value in (*projection[5:], fallback)]
    color_pixels_rows(start, stop, depth, intrinsics, *arrays, *numbers, us, vs)
    return us, vs
