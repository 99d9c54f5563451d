"""Smallest sets of edges whose removal separates nodes that contradict each other."""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_flow

Pair = tuple[int, int]


def best_cut(edges: Sequence[Pair], apart: Sequence[Pair]) -> set[int]:
    """Edges that separate at least as many pairs as they are; of all minimum cuts the one with most pairs per edge.

    The minimum cut between two nodes is found by a maximum flow with one unit per edge (Ford and Fulkerson 1956), the
    cut nearest to each of the two. Empty if there is none.

    Args:
        edges: Pairs of nodes, each at most once.
        apart: Pairs of nodes that should not be connected.
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
    """Number of the component of each node."""
    return connected_components(_matrix(ends, count), directed=False)[1]
