"""Rigid alignment of point sets (Kabsch 1976, Umeyama 1991; RANSAC: Fischler and Bolles 1981)."""

import math

import numpy as np
from numpy.typing import NDArray

SUCCESS = 0.9999
"""Probability of a RANSAC sample of inliers."""
MIN_SIDE = 0.1
"""Shortest side of a sample, metres, for a defined rotation."""
REFINEMENTS = 3
"""Least-squares fits to reselected inliers."""


def rigid_ransac(
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    tolerance: NDArray[np.float64],
    inlier_share: float = 0.25,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Rigid motion T_a_b with the most inliers (RANSAC); deterministic.

    Draws ``log(1 - p) / log(1 - w^3)`` samples of three pairs, p = ``SUCCESS``.

    Args:
        a, b: (m, 3) the same points in two frames, metres.
        tolerance: (m,) largest distance of an inlier, metres.
        inlier_share: Smallest inlier share w, at least 0.1.

    Returns:
        T_a_b (4, 4), fitted to all inliers, and the inliers (m,) bool; the identity and none if not found.
    """
    no_motion = np.eye(4), np.zeros(len(a), dtype=bool)
    if len(a) < 3:
        return no_motion
    num_samples = math.ceil(math.log(1 - SUCCESS) / math.log(1 - max(inlier_share, 0.1) ** 3))
    triples = np.random.default_rng(1).integers(0, len(a), (num_samples, 3))
    sides = [(0, 1), (1, 2), (2, 0)]
    lengths = np.array(
        [[np.linalg.norm(p[triples[:, i]] - p[triples[:, j]], axis=1) for i, j in sides] for p in (a, b)]
    )
    slack = np.array([tolerance[triples[:, i]] + tolerance[triples[:, j]] for i, j in sides])
    congruent = np.all(np.abs(lengths[0] - lengths[1]) < slack, axis=0) & (lengths.min(axis=(0, 1)) > MIN_SIDE)
    triples = triples[congruent]
    if len(triples) == 0:
        return no_motion
    Ts = kabsch(a[triples], b[triples])
    transformed = np.einsum("hij,mj->hmi", Ts[:, :3, :3], b) + Ts[:, None, :3, 3]
    agreeing = np.linalg.norm(transformed - a, axis=-1) < tolerance
    inliers = agreeing[int(np.argmax(agreeing.sum(axis=1)))]
    T = np.eye(4)
    for _ in range(REFINEMENTS):
        if np.count_nonzero(inliers) < 3:
            return no_motion
        T = kabsch(a[inliers], b[inliers])
        inliers = np.linalg.norm(b @ T[:3, :3].T + T[:3, 3] - a, axis=1) < tolerance
    return T, inliers


def umeyama(a: NDArray[np.float64], b: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least-squares rigid alignment of points ``b`` to ``a``, both (..., n, 3) (Umeyama 1991, eq. 34-42).

    Returns:
        T_a_b (..., 4, 4), metres, and the joint extent (..., 3) of both sets, metres: square roots of the singular
        values of the cross-covariance.
        The rotation is determined if the second extent is not zero.
    """
    a_mean, b_mean = a.mean(axis=-2, keepdims=True), b.mean(axis=-2, keepdims=True)
    U, singular, V_t = np.linalg.svd(np.swapaxes(a - a_mean, -1, -2) @ (b - b_mean))
    U[..., :, 2] *= np.linalg.det(U @ V_t)[..., None]  # -1 if the best orthogonal matrix is a reflection
    T = np.zeros((*a.shape[:-2], 4, 4))
    T[..., :3, :3] = U @ V_t
    T[..., :3, 3] = (a_mean - b_mean @ np.swapaxes(T[..., :3, :3], -1, -2))[..., 0, :]
    T[..., 3, 3] = 1
    return T, np.sqrt(singular / a.shape[-2])


def kabsch(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rigid motions (..., 4, 4) with the least squared distance between ``a`` and ``T b``, both (..., n, 3)."""
    return umeyama(a, b)[0]
