"""Point splatting: points of earlier images in a new image."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.threads import kernel

SAME_SURFACE = np.float32(0.05)
"""Largest distance of measurements on one surface, share of the depth."""
NEAREST = np.float32(0.05)
"""Smallest depth of a projected point, metres."""


class PointImage(NamedTuple):
    """One point of the world per pixel.

    Attributes:
        points: (h, w, 3) float32, world frame, metres.
        intensities: (h, w) float32, NaN = no point.
        times: (h, w, 2) float64, seconds: first and last observation.
    """

    points: NDArray[np.float32]
    intensities: NDArray[np.float32]
    times: NDArray[np.float64]

    @classmethod
    def empty(cls, shape: tuple[int, ...]) -> "PointImage":
        """No points."""
        return cls(np.zeros((*shape, 3), np.float32), np.full(shape, np.float32(np.nan)), np.zeros((*shape, 2)))


def splat(
    image: PointImage, T_camera_world: NDArray[np.float64], intrinsics: NDArray[np.float32], since: float
) -> PointImage:
    """The nearest point per pixel of a camera.

    Args:
        image: Points in the world.
        T_camera_world: (4, 4).
        intrinsics: (4,) float32 fx, fy, cx, cy.
        since: Oldest last observation, seconds.
    """
    out = PointImage.empty(image.intensities.shape)
    points, intensities, times = image
    splat_points(
        points.reshape(-1, 3), intensities.reshape(-1), times.reshape(-1, 2), since,
        T_camera_world[:3].astype(np.float32), intrinsics, *out,
    )  # fmt: skip
    return out


def overwrite(
    image: PointImage,
    depth: NDArray[np.float32],
    intensity: NDArray[np.float32],
    used: NDArray[np.bool_],
    time: float,
    T_world_camera: NDArray[np.float64],
    intrinsics: NDArray[np.float32],
) -> None:
    """Replace the points of ``used`` pixels by an image's measurements; on the same surface the first time is kept.

    Args:
        image: Points by pixel of the same pose; changed.
        depth, intensity: (h, w) float32; depth in metres, 0 = none.
        used: (h, w) bool.
        time: Seconds.
        T_world_camera: (4, 4).
        intrinsics: (4,) float32 fx, fy, cx, cy.
    """
    overwrite_points(depth, intensity, used, time, T_world_camera[:3].astype(np.float32), intrinsics, *image)


@kernel
def splat_points(points, intensities, times, since, T, intrinsics, new_points, new_intensities, new_times):
    """Loop of ``splat`` over n points; ``T`` is (3, 4) float32, the last three arguments are output."""
    h, w = new_intensities.shape
    nearest = np.full((h, w), np.float32(1e9))
    new_intensities[:] = np.nan
    for n in range(len(intensities)):
        if np.isnan(intensities[n]) or times[n, 1] < since:
            continue
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        qz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if qz < NEAREST:
            continue
        by_z = np.float32(1) / qz
        qu = (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) * by_z * intrinsics[0] + intrinsics[2]
        qv = (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) * by_z * intrinsics[1] + intrinsics[3]
        u, v = np.int64(np.floor(qu + np.float32(0.5))), np.int64(np.floor(qv + np.float32(0.5)))
        if u < 0 or v < 0 or u >= w or v >= h or qz >= nearest[v, u]:
            continue
        nearest[v, u] = qz
        new_points[v, u, 0], new_points[v, u, 1], new_points[v, u, 2] = x, y, z
        new_intensities[v, u] = intensities[n]
        new_times[v, u, 0], new_times[v, u, 1] = times[n, 0], times[n, 1]


@kernel
def overwrite_points(depth, intensity, used, time, T, intrinsics, points, intensities, times):
    """Loop of ``overwrite``; ``T`` is (3, 4) float32, the last three arguments are changed."""
    h, w = depth.shape
    for v in range(h):
        for u in range(w):
            z = depth[v, u]
            if not used[v, u] or z <= 0:
                continue
            x = (np.float32(u) - intrinsics[2]) / intrinsics[0] * z
            y = (np.float32(v) - intrinsics[3]) / intrinsics[1] * z
            square = np.float32(0)
            for axis in range(3):
                coordinate = T[axis, 0] * x + T[axis, 1] * y + T[axis, 2] * z + T[axis, 3]
                square += (coordinate - points[v, u, axis]) ** 2
                points[v, u, axis] = coordinate
            if np.isnan(intensities[v, u]) or square > (SAME_SURFACE * z) ** 2:
                times[v, u, 0] = time
            intensities[v, u], times[v, u, 1] = intensity[v, u], time
