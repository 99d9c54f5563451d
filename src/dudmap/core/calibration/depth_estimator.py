"""Static distortion of the depth images of a camera, from pairs of images that show the same surface."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SensorConfig
from dudmap.core.backends.cpu.backend import CpuBackend
from dudmap.core.calibration.depth_model import TERMS, DepthModel, image_extent, terms
from dudmap.core.calibration.keyframes import halvings_to
from dudmap.core.frames.pyramid import HALVING_BAND
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera

WIDTH = 160
"""Width of the images that are compared, pixels."""
STRIDE = 3
"""Every so many pixels, across and down, are compared."""
MAX_VIEWS, MAX_PAIRS = 60, 240
"""Largest number of images, evenly over the time, and of pairs."""
MIN_OVERLAP, MIN_SHIFT = 0.4, 0.08
"""Share of an image that another one must see, and by how much, as a share of the width, it must see it elsewhere: what
both see at the same place they see with the same error."""
SLANTED = 0.3
"""Cosine of the angle of incidence below which a reading is not used."""
EDGE = 0.05
"""Depth step in the neighbourhood of a pixel, as a share of the depth, beyond which it is not used."""
SAME_SURFACE = 0.03, 4.0
"""Distances above this, metres plus standard deviations, belong to different surfaces."""
HUBER = 2.0
"""Standard deviations beyond which a distance counts linearly."""
CORRELATED_READINGS = 16.0
"""Compared readings that count as one against the prior: neighbours share the errors of a surface."""
PRIOR_SIGMA = 5e-3, 2.5e-3
"""Standard deviation of the terms, 1/m (1 % at 2 m; Teichman, Miller and Thrun 2013 measured 1 to 2 %), and of their
growth, 1/m^2."""
ITERATIONS = 5
MEDIAN_OF_NORMAL = 0.6745
"""Median of |x| of a standard normal x."""
MIN_COMPARED = 100
"""Fewest distances of a pair that is used."""


@dataclass(frozen=True, eq=False)
class DepthView:
    """Depth image of a camera at a pose.

    Attributes:
        camera: Its camera.
        points: (h, w, 3) in camera axes, metres.
        normals: (h, w, 3) towards the camera.
        usable: (h, w) bool, away from edges and not at a slant.
        T_world_camera: (4, 4).
    """

    camera: Camera
    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    usable: NDArray[np.bool_]
    T_world_camera: NDArray[np.float64]

    @classmethod
    def of(cls, depth: NDArray[np.float32], camera: Camera, T_world_camera: NDArray[np.float64]) -> "DepthView":
        """View of a depth image (H, W) in metres, 0 where there is no reading or something moves."""
        import cv2

        backend = CpuBackend()
        for _ in range(halvings_to(WIDTH, camera)):
            depth, _ = backend.halve(depth, np.zeros_like(depth), HALVING_BAND)
            camera = camera.scaled(1)
        points = np.asarray(camera.backproject(depth), np.float64)
        across, down = np.zeros_like(points), np.zeros_like(points)
        across[:, 1:-1], down[1:-1] = points[:, 2:] - points[:, :-2], points[2:] - points[:-2]
        normals = np.cross(down, across)
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        cosine = np.abs(np.sum(normals * points, axis=-1)) / np.maximum(np.linalg.norm(points, axis=-1), 1e-9)
        window = np.ones((3, 3), np.uint8)
        near, far = cv2.erode(depth, window), cv2.dilate(depth, window)
        usable = (near > 0) & (far - near < EDGE * depth) & (cosine > SLANTED)
        usable[[0, -1]] = usable[:, [0, -1]] = False
        return cls(camera, points, normals, usable, T_world_camera)


def estimate_distortion(views: Sequence[DepthView], camera: Camera, sensor: SensorConfig) -> DepthModel:
    """Distortion with which all images show the same surfaces, and the poses that belong to it, by least squares.

    A reading p of one image, moved into another one, lies at the distance

        r = n . (R g(p) + t - g(q)),   g(p) = p / (1 + z c(p)),

    from the tangent plane at the reading q that it projects to; c is the correction of the inverse depth. The sum of
    the squares over all pairs, robust (Huber) and in units of sigma(z), is minimised over c and all poses together: a
    bent map and bent poses explain the newest images as well as the right ones, but not the same wall seen once at the
    left and once at the right. The covariance is that of the sandwich estimator over images (Huber 1967).

    Args:
        camera: Of the depth images.
        views: Images with poses that are roughly right, at most ``MAX_VIEWS`` of which are used.
        sensor: Noise of the readings.
    """
    views = [views[n] for n in np.unique(np.linspace(0, len(views) - 1, MAX_VIEWS).astype(int))] if views else []
    pairs = _pairs(views)
    prior = np.repeat(np.array(PRIOR_SIGMA), len(TERMS) // 2) ** -2.0
    if not pairs:
        return DepthModel(np.zeros(len(TERMS)), np.diag(1 / prior), image_extent(camera), 0)
    count, state, scale = 6 * len(views), np.zeros(len(TERMS)), 1.0
    poses, covariance = [view.T_world_camera for view in views], np.diag(1 / prior)
    for _ in range(ITERATIONS):
        parts = [_linearize(replace(views[i], T_world_camera=poses[i]), replace(views[j], T_world_camera=poses[j]),
                            state, sensor, scale) for i, j in pairs]  # fmt: skip
        A, b = np.zeros((count + len(TERMS),) * 2), np.zeros(count + len(TERMS))
        gradients = np.zeros((len(pairs), len(b)))
        for n, ((i, j), (H, g, _)) in enumerate(zip(pairs, parts, strict=True)):
            rows = np.r_[6 * i : 6 * i + 6, 6 * j : 6 * j + 6, count : len(b)]
            A[np.ix_(rows, rows)] += H / CORRELATED_READINGS
            gradients[n, rows] = g / CORRELATED_READINGS
        ratios = np.concatenate([ratio for _, _, ratio in parts])
        scale *= float(np.median(ratios)) / MEDIAN_OF_NORMAL if len(ratios) else 1.0
        b = gradients.sum(axis=0)
        # the first pose stays; the others are eliminated
        free, shape = slice(6, count), slice(count, len(b))
        own = A[free, free] + 1e-9 * np.diag(np.diag(A[free, free]) + 1)
        across = np.linalg.solve(own, A[free, shape]).T
        H = A[shape, shape] - across @ A[free, shape] + np.diag(prior)
        scores = gradients[:, shape] - gradients[:, free] @ across.T
        step = -np.linalg.solve(H, scores.sum(axis=0) + prior * state)
        moves = -np.linalg.solve(own, b[free] + A[free, shape] @ step).reshape(-1, 6)
        poses = [poses[0], *(T @ se3.exp(move) for T, move in zip(poses[1:], moves, strict=True))]
        state = state + step
        by_view = np.zeros((len(views), len(TERMS)))
        for (i, j), score in zip(pairs, scores, strict=True):
            by_view[i] += score
            by_view[j] += score
        bread = np.linalg.inv(H)
        covariance = bread @ (by_view.T @ by_view + np.diag(prior)) @ bread
    used = len({number for pair in pairs for number in pair})
    return DepthModel(state, np.asarray((covariance + covariance.T) / 2), image_extent(camera), used)


def _pairs(views: Sequence[DepthView]) -> list[tuple[int, int]]:
    """Pairs of images that see the same surface at different places, at most MAX_PAIRS, evenly over all."""
    found = []
    for i, first in enumerate(views):
        points = first.points[::8, ::8].reshape(-1, 3)
        points = points[points[:, 2] > 0]
        for j, second in enumerate(views):
            if i == j or len(points) == 0:
                continue
            T = se3.inverse(second.T_world_camera) @ first.T_world_camera
            moved, camera = points @ T[:3, :3].T + T[:3, 3], second.camera
            z = np.maximum(moved[:, 2], 1e-3)
            u, v = camera.fx * moved[:, 0] / z + camera.cx, camera.fy * moved[:, 1] / z + camera.cy
            seen = (moved[:, 2] > 0.1) & (u > 0) & (u < camera.width - 1) & (v > 0) & (v < camera.height - 1)
            if seen.mean() < MIN_OVERLAP:
                continue
            before = points[seen] / points[seen, 2:]
            shift = np.hypot(
                u[seen] - camera.fx * before[:, 0] - camera.cx, v[seen] - camera.fy * before[:, 1] - camera.cy
            )
            if np.median(shift) > MIN_SHIFT * camera.width:
                found.append((i, j))
    chosen = np.unique(np.linspace(0, len(found) - 1, min(len(found), MAX_PAIRS)).astype(int)) if found else []
    return [found[n] for n in chosen]


def _linearize(
    first: DepthView, second: DepthView, state: NDArray[np.float64], sensor: SensorConfig, scale: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Normal equations (12 + K, 12 + K) and gradient (12 + K,): body twists of both poses, and the state; distances
    (n,) in standard deviations, which are ``scale`` times those of the configured noise."""
    unknowns = 12 + len(TERMS)
    extent, grid = image_extent(first.camera), np.zeros_like(first.usable)
    grid[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE] = True
    x, dx = _corrected(first.points[first.usable & grid], state, extent)
    T = se3.inverse(second.T_world_camera) @ first.T_world_camera
    R, camera = T[:3, :3], second.camera
    moved = x @ R.T + T[:3, 3]
    z = np.maximum(moved[:, 2], 1e-3)
    u = np.rint(camera.fx * moved[:, 0] / z + camera.cx).astype(int)
    v = np.rint(camera.fy * moved[:, 1] / z + camera.cy).astype(int)
    inside = (moved[:, 2] > 0.1) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    inside[inside] &= second.usable[v[inside], u[inside]]
    x, dx, moved, u, v = x[inside], dx[inside], moved[inside], u[inside], v[inside]
    y, dy = _corrected(second.points[v, u], state, extent)
    normal = second.normals[v, u]
    r = np.sum(normal * (moved - y), axis=1)
    sigma = scale * np.hypot(sensor.sigma(x[:, 2]), sensor.sigma(y[:, 2]))
    same = np.abs(r) < SAME_SURFACE[0] + SAME_SURFACE[1] * sigma
    if np.count_nonzero(same) < MIN_COMPARED:
        return np.zeros((unknowns, unknowns)), np.zeros(unknowns), np.zeros(0)
    turned = normal @ R
    J = np.hstack([
        turned, np.cross(x, turned), -normal, -np.cross(y, normal),
        np.sum(turned * x, axis=1)[:, None] * dx - np.sum(normal * y, axis=1)[:, None] * dy,
    ])[same]  # fmt: skip
    r, sigma = r[same], sigma[same]
    weight = np.minimum(1, HUBER * sigma / np.maximum(np.abs(r), 1e-12)) / sigma**2
    return (J * weight[:, None]).T @ J, J.T @ (weight * r), np.abs(r) / sigma


def _corrected(
    points: NDArray[np.float64], state: NDArray[np.float64], extent: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corrected points (n, 3), and the derivative (n, K) of their logarithmic length by the state."""
    z = points[:, 2]
    basis = terms(points[:, :2] / z[:, None], z, extent)
    scale = 1 / (1 + z * (basis @ state))
    return points * scale[:, None], -(z * scale)[:, None] * basis
