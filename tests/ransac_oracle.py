"""The rigid motion of correspondences with NumPy: hypotheses, scores and Gauss-Newton for all motions at once."""

import numpy as np

from dudmap.core.backends.cpu.consensus import REFINED, REGULAR, ROUNDS
from dudmap.core.dynamics.dominant_motion import reproject
from dudmap.core.geometry import se3


def flow_jacobian(points, camera):
    """Derivative (n, 2, 6) of the pixels of points (n, 3) by a twist (v, omega) applied to the points, at zero."""
    z = np.maximum(points[:, 2], 1e-6)
    x, y, one, zero = points[:, 0] / z, points[:, 1] / z, np.ones_like(z), np.zeros_like(z)
    du = camera.fx * np.stack([one / z, zero, -x / z, -x * y, 1 + x * x, -y], axis=1)
    dv = camera.fy * np.stack([zero, one / z, -y / z, -1 - y * y, x * y, x], axis=1)
    return np.stack([du, dv], axis=1)


def scores(motions, points, targets, expected, params, camera):
    """MSAC scores (g, k) of motions (g, 4, 4), times a prior."""
    out = np.empty((len(motions), len(params.gain)))
    for T, row in zip(motions, out, strict=True):
        pixels = reproject(T, points, camera)
        d = np.linalg.norm(pixels - expected, axis=1).mean() / params.prior_px
        for k, (inlier_px, gain) in enumerate(zip(params.inlier_px, params.gain, strict=True)):
            square = np.minimum(np.sum((pixels - targets) ** 2, axis=1) / inlier_px**2, 1)
            row[k] = gain * np.sum(points[:, 2] ** 2 * (1 - square)) * (0.5 + 0.5 / (1 + d**2))
    return out


def refined(T, points, targets, inlier_px, camera):
    """Least-squares motion of the inliers of a motion (4, 4)."""
    for scale in ROUNDS:
        moved = points @ T[:3, :3].T + T[:3, 3]
        residual = targets - reproject(T, points, camera)
        near = np.linalg.norm(residual, axis=1) < scale * inlier_px
        if np.count_nonzero(near) >= 6:
            J, r = flow_jacobian(moved, camera)[near].reshape(-1, 6), residual[near].reshape(-1)
            H = J.T @ J
            T = se3.exp(np.linalg.solve(H + REGULAR * np.trace(H) * np.eye(6), J.T @ r)) @ T
    return T


def best_motion(draws, points, targets, params, T_expected, camera):
    flow, J = targets - reproject(np.eye(4), points, camera), flow_jacobian(points, camera)
    A = J[draws].reshape(-1, 6, 6) + REGULAR * np.eye(6)
    motions = se3.exp_all(np.linalg.solve(A, flow[draws].reshape(-1, 6, 1))[..., 0])
    images = points, targets, reproject(T_expected, points, camera), params, camera
    best = np.argpartition(scores(motions, *images), -REFINED, axis=0)[-REFINED:]
    found = [
        refined(T, points, targets, inlier_px, camera)
        for highest, inlier_px in zip(best.T, params.inlier_px, strict=True)
        for T in (T_expected, *motions[highest])
    ]
    return found[scores(found, *images).max(axis=1).argmax()]
