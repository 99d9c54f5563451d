"""Pose graph optimization (Lu and Milios 1997; Grisetti et al. 2010)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.geometry import se3

MAX_ITERATIONS = 20
MAX_STEP = 1e-9
"""The optimization has converged when no pose moves by more than this, metres and radians."""


@dataclass(frozen=True, eq=False)
class Edge:
    """Measured motion between two poses.

    Attributes:
        a, b: Indices of the poses.
        T_a_b: (4, 4) measured motion.
        sigma_distance: Standard deviation of its translation, metres, per axis.
        sigma_angle: Standard deviation of its rotation, radians, per axis.
    """

    a: int
    b: int
    T_a_b: NDArray[np.float64]
    sigma_distance: float
    sigma_angle: float


def optimize(Ts_world: NDArray[np.float64], edges: Sequence[Edge]) -> NDArray[np.float64]:
    """Minimize the sum over all edges of ``|e|^2`` with ``e = log(T_a_b^-1 T_a^-1 T_b)``, weighted by the variances.

    Gauss-Newton on SE(3) with updates ``T exp(xi)`` on the right; the first pose is fixed. The sparse normal equations
    are solved by SciPy (SuperLU). The derivative of ``e`` by ``xi_b`` is ``I + ad(e) / 2``, the first two terms of the
    series of the inverse right Jacobian; the derivative by ``xi_a`` is that times ``-Ad(T_b^-1 T_a)``.

    Args:
        Ts_world: (N, 4, 4) initial poses.
        edges: Measured motions; they must connect all poses.

    Returns:
        (N, 4, 4) optimized poses; not finite if the normal equations are singular.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import spsolve

    Ts = np.array(Ts_world, dtype=np.float64)
    n = len(Ts)
    if n < 2 or not edges:
        return Ts
    a, b = np.array([(edge.a, edge.b) for edge in edges]).T
    Ts_b_a = se3.inverse(np.stack([edge.T_a_b for edge in edges]))
    sigmas = np.array([(edge.sigma_distance, edge.sigma_angle) for edge in edges])
    weights = np.repeat(sigmas**-2.0, 3, axis=1)  # (E, 6)
    pairs = np.stack([np.stack([a, a]), np.stack([a, b]), np.stack([b, a]), np.stack([b, b])])  # (4, 2, E)
    entries = (6 * pairs[:, :, :, None, None] + np.indices((6, 6))[:, None]).transpose(1, 0, 2, 3, 4).reshape(2, -1)
    for _ in range(MAX_ITERATIONS):
        motions = se3.inverse(Ts[b]) @ Ts[a]
        errors = _logs(Ts_b_a @ se3.inverse(motions))
        J_b = np.eye(6) + 0.5 * _small_adjoints(errors)
        J_a = -J_b @ _adjoints(motions)
        weighted = {"a": _transposed(J_a) * weights[:, None], "b": _transposed(J_b) * weights[:, None]}
        gradient = np.zeros((n, 6))
        np.add.at(gradient, a, np.einsum("eij,ej->ei", weighted["a"], errors))
        np.add.at(gradient, b, np.einsum("eij,ej->ei", weighted["b"], errors))
        products = [weighted[i] @ J for i in "ab" for J in (J_a, J_b)]
        H = coo_matrix((np.stack(products).reshape(-1), (entries[0], entries[1]))).tocsc()
        steps = np.zeros((n, 6))
        steps[1:] = -spsolve(H[6:, 6:], gradient[1:].reshape(-1)).reshape(-1, 6)
        Ts[1:] = Ts[1:] @ _exps(steps[1:])
        Ts[1:, :3, :3] = _nearest_rotations(Ts[1:, :3, :3])
        if np.abs(steps).max() < MAX_STEP:
            break
    return Ts


# The functions of ``se3`` for many motions at once.


def _transposed(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.swapaxes(matrices, -1, -2)


def _hats(omegas: NDArray[np.float64]) -> NDArray[np.float64]:
    """Skew-symmetric matrices (n, 3, 3) of vectors (n, 3)."""
    out = np.zeros((len(omegas), 3, 3))
    x, y, z = omegas.T
    out[:, 2, 1], out[:, 0, 2], out[:, 1, 0] = x, y, z
    return out - _transposed(out)


def _logs(Ts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Twists (n, 6) of motions (n, 4, 4)."""
    from scipy.spatial.transform import Rotation

    finite = np.all(np.isfinite(Ts), axis=(1, 2))
    omegas = np.full((len(Ts), 3), np.nan)
    if finite.any():
        omegas[finite] = Rotation.from_matrix(Ts[finite, :3, :3]).as_rotvec()
    squared = np.einsum("ni,ni->n", omegas, omegas)
    angles = np.sqrt(np.maximum(squared, 1e-8))
    exact = (1 - angles * np.cos(angles / 2) / (2 * np.sin(angles / 2))) / np.maximum(squared, 1e-8)
    c = np.where(squared < 1e-8, 1 / 12 + squared / 720, exact)
    W = _hats(omegas)
    V_inverse = np.eye(3) - 0.5 * W + c[:, None, None] * (W @ W)
    return np.concatenate([np.einsum("nij,nj->ni", V_inverse, Ts[:, :3, 3]), omegas], axis=1)


def _exps(twists: NDArray[np.float64]) -> NDArray[np.float64]:
    """Motions (n, 4, 4) of twists (n, 6)."""
    squared = np.einsum("ni,ni->n", twists[:, 3:], twists[:, 3:])
    safe, small = np.maximum(squared, 1e-8), squared < 1e-8
    angles = np.sqrt(safe)
    a = np.where(small, 1 - squared / 6, np.sin(angles) / angles)[:, None, None]
    b = np.where(small, 0.5 - squared / 24, (1 - np.cos(angles)) / safe)[:, None, None]
    c = np.where(small, 1 / 6 - squared / 120, (1 - a[:, 0, 0]) / safe)[:, None, None]
    W = _hats(twists[:, 3:])
    WW = W @ W
    out = np.tile(np.eye(4), (len(twists), 1, 1))
    out[:, :3, :3] += a * W + b * WW
    out[:, :3, 3] = np.einsum("nij,nj->ni", np.eye(3) + b * W + c * WW, twists[:, :3])
    return out


def _adjoints(Ts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Adjoints (n, 6, 6) of motions (n, 4, 4)."""
    out = np.zeros((len(Ts), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = Ts[:, :3, :3]
    out[:, :3, 3:] = _hats(Ts[:, :3, 3]) @ Ts[:, :3, :3]
    return out


def _small_adjoints(twists: NDArray[np.float64]) -> NDArray[np.float64]:
    """Adjoints (n, 6, 6) of twists (n, 6)."""
    out = np.zeros((len(twists), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = _hats(twists[:, 3:])
    out[:, :3, 3:] = _hats(twists[:, :3])
    return out


def _nearest_rotations(Rs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotations (n, 3, 3) closest to matrices (n, 3, 3); those that are not finite stay."""
    finite = np.all(np.isfinite(Rs), axis=(1, 2))
    out = Rs.copy()
    U, _, V_t = np.linalg.svd(Rs[finite])
    U[:, :, 2] *= np.sign(np.linalg.det(U @ V_t))[:, None]
    out[finite] = U @ V_t
    return out
