"""Pose graph optimization (Lu and Milios 1997; Grisetti et al. 2010)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3

MAX_ITERATIONS = 20
MAX_STEP = 1e-9
"""Largest step at convergence, metres and radians."""


@dataclass(frozen=True, eq=False)
class Edge:
    """Measured motion between two poses.

    Attributes:
        T_a_b: (4, 4).
        sigma_distance: Standard deviation of its translation per axis, metres.
        sigma_angle: Standard deviation of its rotation per axis, radians.
    """

    a: int
    b: int
    T_a_b: NDArray[np.float64]
    sigma_distance: float
    sigma_angle: float


def optimize(
    Ts_world: NDArray[np.float64],
    edges: Sequence[Edge],
    covariances: NDArray[np.float64] | None = None,
    huber: float = np.inf,
) -> NDArray[np.float64]:
    """Minimize the sum over all edges of ``|e|^2`` with ``e = log(T_a_b^-1 T_a^-1 T_b)``, weighted by the variances.

    ``covariances`` (E, 6, 6) of ``e`` replace the variances of the edges. ``huber``: Huber threshold, standard
    deviations.

    Gauss-Newton on SE(3) with right updates ``T exp(xi)``; the first pose is fixed. SciPy (SuperLU) solves the normal
    equations. The derivative of ``e`` by ``xi_b`` is ``I + ad(e) / 2`` (inverse right Jacobian, first order), by
    ``xi_a`` that matrix times ``-Ad(T_b^-1 T_a)``. The edges must connect all poses (N, 4, 4). The result is not finite
    if the normal equations are singular.
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
    information = np.eye(6) * np.repeat(sigmas**-2.0, 3, axis=1)[:, None]  # (E, 6, 6)
    if covariances is not None:
        information = np.linalg.inv(covariances)
    pairs = np.stack([np.stack([a, a]), np.stack([a, b]), np.stack([b, a]), np.stack([b, b])])  # (4, 2, E)
    entries = (6 * pairs[:, :, :, None, None] + np.indices((6, 6))[:, None]).transpose(1, 0, 2, 3, 4).reshape(2, -1)
    for _ in range(MAX_ITERATIONS):
        motions = se3.inverse(Ts[b]) @ Ts[a]
        errors = se3.log_all(Ts_b_a @ se3.inverse(motions))
        J_b = np.eye(6) + 0.5 * se3.small_adjoint(errors)
        J_a = -J_b @ se3.adjoint(motions)
        lengths = np.sqrt(np.einsum("ei,eij,ej->e", errors, information, errors))
        weights = information * np.minimum(1, huber / np.maximum(lengths, 1e-9))[:, None, None]
        weighted = {"a": np.swapaxes(J_a, 1, 2) @ weights, "b": np.swapaxes(J_b, 1, 2) @ weights}
        gradient = np.zeros((n, 6))
        np.add.at(gradient, a, np.einsum("eij,ej->ei", weighted["a"], errors))
        np.add.at(gradient, b, np.einsum("eij,ej->ei", weighted["b"], errors))
        products = [weighted[i] @ J for i in "ab" for J in (J_a, J_b)]
        H = coo_matrix((np.stack(products).reshape(-1), (entries[0], entries[1]))).tocsc()
        steps = np.zeros((n, 6))
        steps[1:] = -spsolve(H[6:, 6:], gradient[1:].reshape(-1)).reshape(-1, 6)
        if not np.all(np.isfinite(steps)):
            return np.full_like(Ts, np.nan)
        Ts[1:] = Ts[1:] @ se3.exp_all(steps[1:])
        Ts[1:, :3, :3] = se3.nearest_rotation(Ts[1:, :3, :3])
        if np.abs(steps).max() < MAX_STEP:
            break
    return Ts
