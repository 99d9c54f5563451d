"""Slow NumPy implementations of the equations of the thesis, written independently of the kernels."""

import numpy as np

from dudmap.core.geometry.camera import Camera


def fuse(
    frames, T_camera_world_of, camera: Camera, points, truncation, behind, max_weight,
    sigma=lambda z: 0.0, weights_of=None, max_readings=np.inf,
):  # fmt: skip
    """Running average of projective distances at world points (N, 3) (thesis eq. 4.18-4.23), without carving.

    Args:
        frames, T_camera_world_of: Frames and their poses.
        camera: Camera of the frames.
        points: (N, 3) world points, metres.
        truncation, behind, max_weight: Truncation distance in front of and behind a surface, metres; largest weight.
        sigma: Smallest truncation distance at depth z, metres.
        weights_of: Weight (H, W) of the readings of each frame; 1 if None.
        max_readings: Largest weight to which a reading can raise a point, in multiples of its own weight.

    Returns:
        Distance (N,), NaN where never observed; weight (N,); colour (N, 3) float.
    """
    distance, weight, color = np.zeros(len(points)), np.zeros(len(points)), np.zeros((len(points), 3))
    weights_of = [np.ones(camera.shape)] * len(frames) if weights_of is None else weights_of
    for frame, T, gains in zip(frames, T_camera_world_of, weights_of, strict=True):
        p = points @ T[:3, :3].T + T[:3, 3]
        for n, (x, y, z) in enumerate(p):
            if z <= 0.05:
                continue
            u = int(np.floor(x / z * camera.fx + camera.cx + 0.5))
            v = int(np.floor(y / z * camera.fy + camera.cy + 0.5))
            if not (0 <= u < camera.width and 0 <= v < camera.height) or frame.depth[v, u] <= 0:
                continue
            d = frame.depth[v, u]
            s, band = d - z, max(truncation, sigma(d))
            if s < -max(behind, sigma(d)):
                continue
            share = gains[v, u] / (weight[n] + gains[v, u])
            if s >= band:  # observed as free space; the colour is unchanged
                near = frame.depth[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2]
                nearest = near[near > 0].min()
                if nearest - z <= max(truncation, sigma(nearest)):
                    continue
                s = band
            else:
                color[n] += (frame.color[v, u] - color[n]) * share
            distance[n] += (s - distance[n]) * share
            most = max(weight[n], min(max_weight, max_readings * gains[v, u]))
            weight[n] = min(weight[n] + gains[v, u], most)
    return np.where(weight > 0, distance, np.nan), weight, color


def trilinear(grid, point):
    """Trilinear interpolation of ``grid(i, j, k)`` at a point (3,) in grid units; NaN if a corner is NaN."""
    base = np.floor(point).astype(int)
    a = point - base
    total = 0.0
    for corner in np.ndindex(2, 2, 2):
        share = np.prod([a[axis] if corner[axis] else 1 - a[axis] for axis in range(3)])
        total += share * grid(*(base + corner))
    return total


def half_normal_mixture_em(samples, iterations=300):
    """Mixture of two half-normal densities by EM on the samples (thesis eq. 4.52-4.56)."""
    prior, sigma = np.array([0.8, 0.2]), np.array([1.0, 6.0])
    for _ in range(iterations):
        density = prior * np.sqrt(2 / np.pi) / sigma * np.exp(-(samples[:, None] ** 2) / (2 * sigma**2))
        share = density / density.sum(axis=1, keepdims=True)
        prior = share.mean(axis=0)
        sigma = np.sqrt((share * samples[:, None] ** 2).sum(axis=0) / share.sum(axis=0))
    return prior, sigma
