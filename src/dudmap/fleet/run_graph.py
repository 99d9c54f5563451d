"""Poses of many runs from relative poses: rejection by cycles, then a robust pose graph (Huber).

Relative poses around a cycle compose to the identity; else its joins without another confirming cycle are rejected.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_flow

from dudmap.core.geometry import se3
from dudmap.core.places.pose_graph import Edge, optimize

Pair = tuple[int, int]

SIGMA_DISTANCE, SIGMA_ANGLE = 0.01, np.radians(0.2)
"""Standard deviation per axis of a relative pose, at the middle of the common surface (m, rad): drift within runs."""
HALF = 0.5
"""Overlap of these values. Joins of rendered runs err by 4.4 mm above it, 4.9 mm at 35 to 50 %, 11.8 mm at 25 to 35 %,
17 mm below."""
CHI_SQUARE = 22.46
"""99.9 % quantile of chi-square, 6 degrees of freedom, of a cycle's squared error."""
HUBER = 1.345
"""Huber threshold, standard deviations: 95 % efficiency."""


def best_cut(edges: Sequence[Pair], apart: Sequence[Pair]) -> set[int]:
    """Cut of a graph of unique ``edges`` that separates at least as many pairs ``apart`` as it has edges; empty if
    none.

    Of all minimum cuts between such pairs (Ford and Fulkerson 1956, unit capacities), the one with most separated pairs
    per edge.
    """
    if not edges or not apart:
        return set()
    names, ends = np.unique(np.array([*edges, *apart]), return_inverse=True)
    ends = ends.reshape(-1, 2)
    inside, outside = ends[: len(edges)], ends[len(edges) :]
    capacity = _matrix(np.concatenate([inside, inside[:, ::-1]]), len(names))
    connected = _labels(inside, len(names))
    best, worth = set[int](), 0.0
    for a, b in outside:
        if connected[a] != connected[b]:
            continue
        left = csr_array(capacity - maximum_flow(capacity, a, b).flow)
        left.eliminate_zeros()
        for start, reached in ((a, left), (b, csr_array(left.T))):
            side = np.zeros(len(names), bool)
            side[breadth_first_order(reached, start, return_predecessors=False)] = True
            cut = side[inside[:, 0]] != side[inside[:, 1]]
            after = _labels(inside[~cut], len(names))
            separated = np.sum((connected[outside[:, 0]] == connected[outside[:, 1]])
                               & (after[outside[:, 0]] != after[outside[:, 1]]))  # fmt: skip
            if separated >= cut.sum() and separated / cut.sum() > worth:
                best, worth = set(np.flatnonzero(cut).tolist()), separated / cut.sum()
    return best


def _matrix(ends: np.ndarray, count: int) -> csr_array:
    return csr_array((np.ones(len(ends), np.int32), (ends[:, 0], ends[:, 1])), shape=(count, count))


def _labels(ends: np.ndarray, count: int) -> np.ndarray:
    return connected_components(_matrix(ends, count), directed=False)[1]


def drift_covariance(
    T_a_b: NDArray[np.float64], center: NDArray[np.float64], overlap: float = HALF
) -> NDArray[np.float64]:
    """Covariance (6, 6) of a relative pose (4, 4), see ``Join``: drift at the middle (3,) c of the common surface,
    proportional to the square of ``HALF / overlap``.

    About the origin of a it is ``v = v_c + c x omega``, and ``exp(d) T = T exp(e)`` with ``e = Ad(T)^-1 d``.
    """
    shift = np.eye(6)
    shift[:3, 3:] = se3.hat(center)
    J = se3.adjoint(se3.inverse(T_a_b)) @ shift
    return (HALF / overlap) ** 4 * J @ _usual_covariance() @ J.T


def _usual_covariance() -> NDArray[np.float64]:
    return np.diag(np.repeat([SIGMA_DISTANCE**2, SIGMA_ANGLE**2], 3))


@dataclass(frozen=True, eq=False)
class Join:
    """Relative pose ``T_a_b`` (4, 4), world of run b to a.

    Its error is ``T_a_b exp(e)`` with a twist e = (v, omega) of covariance (6, 6).
    """

    a: int
    b: int
    T_a_b: NDArray[np.float64]
    covariance: NDArray[np.float64] = field(default_factory=_usual_covariance)

    def motion(self, start: int) -> NDArray[np.float64]:
        """Pose (4, 4) of the other run in the world of ``start``."""
        return self.T_a_b if start == self.a else se3.inverse(self.T_a_b)

    def motion_covariance(self, start: int) -> NDArray[np.float64]:
        """Covariance of that motion; ``(T exp(e))^-1 = T^-1 exp(-Ad(T) e)``."""
        if start == self.a:
            return self.covariance
        J = se3.adjoint(self.T_a_b)
        return J @ self.covariance @ J.T


Cycle = list[tuple[Join, int]]


@dataclass(frozen=True, eq=False)
class RunGraph:
    """Poses of runs.

    Attributes:
        components: Joined runs, ascending; the largest first.
        Ts: (n, 4, 4) world of each run to its component's first run.
        kept, rejected: Joins.
    """

    components: list[list[int]]
    Ts: NDArray[np.float64]
    kept: list[Join]
    rejected: list[Join]


def solve(count: int, joins: Sequence[Join], denied: Sequence[tuple[int, int]] = ()) -> RunGraph:
    """Poses of ``count`` runs from pairwise relative poses.

    ``denied``: pairs that disagree at these poses (``supported``).
    """
    kept = consistent(supported(joins, denied))
    parts, Ts = components(count, kept), np.tile(np.eye(4), (count, 1, 1))
    for nodes in parts:
        inside = [join for join in kept if join.a in nodes]
        for node, T in _chained(nodes[0], inside).items():
            Ts[node] = T
        if len(inside) >= len(nodes):  # without a cycle the tree is the answer
            edges = [Edge(nodes.index(j.a), nodes.index(j.b), j.T_a_b, SIGMA_DISTANCE, SIGMA_ANGLE) for j in inside]
            Ts[nodes] = optimize(Ts[nodes], edges, np.stack([join.covariance for join in inside]), HUBER)
    return RunGraph(parts, Ts, kept, [join for join in joins if join not in kept])


def components(count: int, joins: Sequence[Join]) -> list[list[int]]:
    """Connected runs, ascending; the largest first."""
    number = _labels(np.array([(join.a, join.b) for join in joins], int).reshape(-1, 2), count)
    parts = [np.flatnonzero(number == n).tolist() for n in range(number.max(initial=-1) + 1)]
    return sorted(parts, key=lambda nodes: (-len(nodes), nodes[0]))


def supported(joins: Sequence[Join], denied: Sequence[tuple[int, int]]) -> list[Join]:
    """Remove joins that at least as many pairs deny."""
    left = list(joins)
    while cut := best_cut([(join.a, join.b) for join in left], denied):
        left = [join for number, join in enumerate(left) if number not in cut]
    return left


def consistent(joins: Sequence[Join]) -> list[Join]:
    """Remove joins that a cycle contradicts and none confirms.

    - Triangles that close confirm their joins.
    - Confirmed joins confirm or reject a join between their runs.
    - In other cycles that do not close, all unconfirmed joins are rejected.
    - Joins in no cycle stay.
    """
    left = list(joins)
    confirmed = {id(join) for cycle in _triangles(left) if _closes(cycle) for join, _ in cycle}
    while True:
        doubtful = [join for join in left if id(join) not in confirmed]
        known = _neighbours([join for join in left if id(join) in confirmed])
        cycles = [cycle for join in doubtful if (cycle := _shortest(join, known))]
        if not cycles:
            everything = _neighbours(left)
            cycles = sorted((cycle for join in doubtful if (cycle := _shortest(join, everything))), key=len)[:1]
        if not cycles:
            return left
        for cycle in cycles:
            if _closes(cycle):
                confirmed |= {id(join) for join, _ in cycle}
            else:
                left = [join for join in left if id(join) in confirmed or all(join is not one for one, _ in cycle)]


def _neighbours(joins: Sequence[Join]) -> dict[int, list[tuple[Join, int]]]:
    out: dict[int, list[tuple[Join, int]]] = {}
    for join in joins:
        out.setdefault(join.a, []).append((join, join.b))
        out.setdefault(join.b, []).append((join, join.a))
    return out


def _triangles(joins: Sequence[Join]) -> list[Cycle]:
    neighbours, out = _neighbours(joins), []
    for join in joins:
        partners = {other: near for near, other in neighbours[join.b] if other != join.a}
        for near, c in neighbours[join.a]:
            if c in partners and c != join.b:
                out.append([(join, join.a), (partners[c], join.b), (near, c)])
    return out


def _shortest(join: Join, neighbours: dict[int, list[tuple[Join, int]]]) -> Cycle:
    came: dict[int, tuple[Join, int]] = {}
    queue = deque([join.b])
    while queue:
        node = queue.popleft()
        for near, other in neighbours.get(node, []):
            if near is join or other in came or other == join.b:
                continue
            came[other] = (near, node)
            if other == join.a:
                path, at = [], other
                while at != join.b:
                    path.append(came[at])
                    at = came[at][1]
                return [(join, join.a), *reversed(path)]
            queue.append(other)
    return []


def _closes(cycle: Cycle) -> bool:
    """Whether a cycle closes within its errors: with ``T = T_1 ... T_k`` an error ``exp(e_i)`` changes ``T`` by
    ``Ad(T_i+1 ... T_k)^-1 e_i``."""
    T, covariance = np.eye(4), np.zeros((6, 6))
    for join, start in reversed(cycle):
        J = se3.adjoint(se3.inverse(T))
        covariance += J @ join.motion_covariance(start) @ J.T
        T = join.motion(start) @ T
    error = se3.log(T)
    return bool(error @ np.linalg.solve(covariance, error) < CHI_SQUARE)


def _chained(start: int, joins: Sequence[Join]) -> dict[int, NDArray[np.float64]]:
    neighbours, out, queue = _neighbours(joins), {start: np.eye(4)}, deque([start])
    while queue:
        node = queue.popleft()
        for join, other in neighbours.get(node, []):
            if other not in out:
                out[other] = out[node] @ join.motion(node)
                queue.append(other)
    return out
