"""Rigid alignment of point sets and comparison of poses."""

import numpy as np
from numpy.typing import NDArray

from dudmap.geometry import se3

TRIPLES = 3000
"""Triples of matches that are drawn; those whose sides have the same lengths in both frames become hypotheses."""
HYPOTHESES = 400
SHORTEST_SIDE = 0.1
"""Triples with a shorter side than this define no pose, metres."""


def rigid_ransac(
    a: NDArray[np.float64], b: NDArray[np.float64], tolerance: NDArray[np.float64], seed: int = 1
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Rigid motion T_a_b that most pairs of points agree with, and which do; the same input gives the same answer.

    Args:
        a, b: (m, 3) the same points in two frames, metres.
        tolerance: (m,) largest distance between ``a`` and ``T_a_b b`` of a pair that agrees.
        seed: Of the draws.

    Returns:
        T_a_b (4, 4) refined on all pairs that agree, and those pairs (m,) bool; none where nothing was found.
    """
    nothing = np.eye(4), np.zeros(len(a), dtype=bool)
    if len(a) < 3:
        return nothing
    triples = np.random.default_rng(seed).integers(0, len(a), (TRIPLES, 3))
    sides = [(0, 1), (1, 2), (2, 0)]
    lengths = np.array(
        [[np.linalg.norm(p[triples[:, i]] - p[triples[:, j]], axis=1) for i, j in sides] for p in (a, b)]
    )
    slack = np.array([tolerance[triples[:, i]] + tolerance[triples[:, j]] for i, j in sides])
    alike = np.all(np.abs(lengths[0] - lengths[1]) < slack, axis=0) & (lengths.min(axis=(0, 1)) > SHORTEST_SIDE)
    triples = triples[alike][:HYPOTHESES]
    if len(triples) == 0:
        return nothing
    Ts = kabsch(a[triples], b[triples])
    moved = np.einsum("hij,mj->hmi", Ts[:, :3, :3], b) + Ts[:, None, :3, 3]
    agreeing = np.linalg.norm(moved - a, axis=-1) < tolerance
    inliers = agreeing[int(np.argmax(agreeing.sum(axis=1)))]
    T = np.eye(4)
    for _ in range(3):
        if np.count_nonzero(inliers) < 3:
            return nothing
        T = kabsch(a[inliers], b[inliers])
        inliers = np.linalg.norm(b @ T[:3, :3].T + T[:3, 3] - a, axis=1) < tolerance
    return T, inliers


def kabsch(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rigid motions (..., 4, 4) with the least squared distance between ``a`` and ``T b``, both (..., n, 3)."""
    a_mean, b_mean = a.mean(axis=-2, keepdims=True), b.mean(axis=-2, keepdims=True)
    U, _, V_t = np.linalg.svd(np.swapaxes(a - a_mean, -1, -2) @ (b - b_mean))
    U[..., :, 2] *= np.linalg.det(U @ V_t)[..., None]  # no mirror images
    T = np.zeros((*a.shape[:-2], 4, 4))
    T[..., :3, :3] = U @ V_t
    T[..., :3, 3] = (a_mean - b_mean @ np.swapaxes(T[..., :3, :3], -1, -2))[..., 0, :]
    T[..., 3, 3] = 1
    return T


def agree(T_a: NDArray[np.float64], T_b: NDArray[np.float64], distance: float, angle_deg: float) -> bool:
    """Whether two poses are closer than a distance (m) and an angle (deg)."""
    if np.linalg.norm(T_a[:3, 3] - T_b[:3, 3]) >= distance:
        return False
    return float(np.degrees(se3.rotation_angle(T_a[:3, :3].T @ T_b[:3, :3]))) < angle_deg
