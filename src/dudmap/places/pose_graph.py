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
    blocks = np.arange(6)
    for _ in range(MAX_ITERATIONS):
        rows, columns, values = [], [], []
        b = np.zeros(6 * n)
        for edge in edges:
            T_b_a = se3.inverse(Ts[edge.b]) @ Ts[edge.a]
            error = se3.log(se3.inverse(edge.T_a_b) @ se3.inverse(T_b_a))
            J_b = np.eye(6) + 0.5 * se3.small_adjoint(error)
            J_a = -J_b @ se3.adjoint(T_b_a)
            weight = np.repeat([edge.sigma_distance**-2.0, edge.sigma_angle**-2.0], 3)
            for i, J_i in ((edge.a, J_a), (edge.b, J_b)):
                b[6 * i : 6 * i + 6] += J_i.T @ (weight * error)
                for j, J_j in ((edge.a, J_a), (edge.b, J_b)):
                    rows.append(np.repeat(6 * i + blocks, 6))
                    columns.append(np.tile(6 * j + blocks, 6))
                    values.append(((J_i.T * weight) @ J_j).reshape(-1))
        H = coo_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))).tocsc()
        steps = np.zeros((n, 6))
        steps[1:] = -spsolve(H[6:, 6:], b[6:]).reshape(-1, 6)
        for i in range(1, n):
            Ts[i] = Ts[i] @ se3.exp(steps[i])
            Ts[i, :3, :3] = se3.nearest_rotation(Ts[i, :3, :3])
        if np.abs(steps).max() < MAX_STEP:
            break
    return Ts
