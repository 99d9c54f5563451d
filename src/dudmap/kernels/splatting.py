"""Loops that carry points seen in earlier images over to a new one."""

import numpy as np

from dudmap.kernels.threads import kernel

SAME = np.float32(0.05)
"""Farthest that two readings of a pixel lie apart if they are of the same thing, as a share of the depth."""


@kernel
def splat(points, shades, times, since, T, intrinsics, new_points, new_shades, new_times):
    """What a camera sees of points in the world: the nearest in each pixel.

    Args:
        points: (n, 3) float32, world frame.
        shades: (n,) float32, intensities; NaN = no point.
        times: (n, 2) float64, when they were first and last seen.
        since: Points seen earlier are left out.
        T: (3, 4) float32, world to camera.
        intrinsics: (4,) float32 fx, fy, cx, cy.
        new_points: (h, w, 3) float32 out, anything where there is none.
        new_shades: (h, w) float32 out, NaN where there is none.
        new_times: (h, w, 2) float64 out, anything where there is none.
    """
    h, w = new_shades.shape
    nearest = np.full((h, w), np.float32(1e9))
    new_shades[:] = np.nan
    for n in range(len(shades)):
        if np.isnan(shades[n]) or times[n, 1] < since:
            continue
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        qz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if qz < np.float32(0.05):
            continue
        by_z = np.float32(1) / qz
        qu = (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) * by_z * intrinsics[0] + intrinsics[2]
        qv = (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) * by_z * intrinsics[1] + intrinsics[3]
        u, v = np.int64(np.floor(qu + np.float32(0.5))), np.int64(np.floor(qv + np.float32(0.5)))
        if u < 0 or v < 0 or u >= w or v >= h or qz >= nearest[v, u]:
            continue
        nearest[v, u] = qz
        new_points[v, u, 0], new_points[v, u, 1], new_points[v, u, 2] = x, y, z
        new_shades[v, u] = shades[n]
        new_times[v, u, 0], new_times[v, u, 1] = times[n, 0], times[n, 1]


@kernel
def overwrite(depth, intensity, used, time, T, intrinsics, points, shades, times):
    """Put the readings of an image in place of what was known of their pixels.

    Args:
        depth, intensity: (h, w) float32.
        used: (h, w) bool, pixels to put.
        time: When they were seen.
        T: (3, 4) float32, camera to world.
        intrinsics: (4,) float32 fx, fy, cx, cy.
        points: (h, w, 3) float32 in and out, world frame.
        shades: (h, w) float32 in and out.
        times: (h, w, 2) float64 in and out.
    """
    h, w = depth.shape
    for v in range(h):
        for u in range(w):
            z = depth[v, u]
            if not used[v, u] or z <= 0:
                continue
            x = (np.float32(u) - intrinsics[2]) / intrinsics[0] * z
            y = (np.float32(v) - intrinsics[3]) / intrinsics[1] * z
            apart = np.float32(0)
            for axis in range(3):
                here = T[axis, 0] * x + T[axis, 1] * y + T[axis, 2] * z + T[axis, 3]
                apart += (here - points[v, u, axis]) ** 2
                points[v, u, axis] = here
            if np.isnan(shades[v, u]) or apart > (SAME * z) ** 2:
                times[v, u, 0] = time
            shades[v, u], times[v, u, 1] = intensity[v, u], time
