"""Relative poses of all runs in rounds: similar runs first, then those that the poses found so far bring together."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from dudmap.core.geometry import se3
from dudmap.core.geometry.alignment import agree
from dudmap.core.map import morton
from dudmap.core.places.saved_map import MAP_FILE
from dudmap.fleet.inputs import MapHeader
from dudmap.fleet.map_samples import transformed
from dudmap.fleet.place_index import PARTNERS, most_similar
from dudmap.fleet.registration import RegisteredPair, register_pairs, similar_runs
from dudmap.fleet.run_graph import RunGraph, solve
from dudmap.fleet.workers import Workers

Pairs = dict[tuple[int, int], RegisteredPair]
Guesses = dict[tuple[int, int], NDArray[np.float64]]
"""Relative pose at which a pair was compared because the graph had brought it together."""
ROUNDS = 4
"""Rounds at most; the third and fourth are small."""
MIN_PREDICTED = 0.3
"""Share of the smaller map that must lie in the other at the poses of the graph for a pair to be compared."""
CELL = 0.3
"""Edge of the cells whose sharing is counted, metres: many times the error of a pose."""
SAME_DISTANCE, SAME_ANGLE_DEG = 0.25, 5.0
"""A pair that disagreed at one relative pose says nothing on another that differs by more than this (m, deg)."""


def registered_runs(
    runs: Sequence[Path], workers: Workers, note: Callable[[str], None]
) -> tuple[list[RegisteredPair], RunGraph]:
    """Relative poses of pairs of runs, and the poses of all.

    The first round compares each run with the most similar others. Each further round compares runs that overlap at the
    poses found so far, from these poses, and runs of the smaller groups with the next similar runs of other groups.

    Raises:
        MissingExtraError: faiss or GTSAM is not installed.
        MapError: A file is damaged.
    """
    n = len(runs)
    similar = similar_runs(runs, workers)
    blocks = list(workers.map(_block_centers, runs))
    found: Pairs = {}
    guesses: Guesses = {}
    wanted = most_similar(similar, PARTNERS)
    graph = solve(n, [])
    for number in range(ROUNDS):
        if not wanted:
            break
        note(f"round {number + 1}: {len(wanted)} of {n * (n - 1) // 2} pairs of runs are compared")
        for one in register_pairs(runs, wanted, workers, guesses):
            found[one.a, one.b] = one
        graph = _graph(n, found, guesses)
        near = _brought_together(graph, blocks, found, guesses)
        guesses |= {(a, b): se3.inverse(graph.Ts[a]) @ graph.Ts[b] for a, b in near}
        wanted = sorted({*near, *_more_partners(graph, similar, found)})
    return list(found.values()), graph


def _graph(count: int, found: Pairs, guesses: Guesses) -> RunGraph:
    """Poses of the runs from all joins, without those that pairs brought together by them deny."""
    joins = [join for one in found.values() if (join := one.join) is not None]
    graph = solve(count, joins)
    denied = [pair for pair, guess in guesses.items() if found[pair].pair.contradicted and _is_at(graph, pair, guess)]
    return solve(count, joins, denied) if denied else graph


def _is_at(graph: RunGraph, pair: tuple[int, int], T: NDArray[np.float64]) -> bool:
    """Whether a graph gives a pair this relative pose."""
    a, b = pair
    return agree(se3.inverse(graph.Ts[a]) @ graph.Ts[b], T, SAME_DISTANCE, SAME_ANGLE_DEG)


def _brought_together(
    graph: RunGraph, blocks: Sequence[NDArray[np.float64]], found: Pairs, guesses: Guesses
) -> list[tuple[int, int]]:
    """Pairs of joined runs that overlap and were not compared at their poses, the largest overlaps of each run."""
    shares = np.zeros((len(blocks), len(blocks)), np.float32)
    for part in graph.components:
        shares[np.ix_(part, part)] = predicted_overlap([transformed(graph.Ts[run], blocks[run]) for run in part], CELL)
    shares[shares < MIN_PREDICTED] = 0
    known = [pair for pair, one in found.items() if one.pair.T_a_b is not None]
    for a, b in [*known, *(pair for pair, guess in guesses.items() if _is_at(graph, pair, guess))]:
        shares[a, b] = shares[b, a] = 0
    return most_similar(shares, PARTNERS)


def predicted_overlap(points: Sequence[NDArray[np.float64]], cell: float) -> NDArray[np.float32]:
    """Shares (n, n) of the cells of the smaller of two sets of points (k, 3) that both reach; 0 on the diagonal."""
    cells = [np.unique(morton.encode(np.floor(own / cell).astype(np.int64))) for own in points]
    sizes = np.array([len(own) for own in cells])
    _, columns = np.unique(np.concatenate(cells), return_inverse=True)
    rows = np.repeat(np.arange(len(cells)), sizes)
    reached = csr_array((np.ones(len(rows), np.float32), (rows, columns)), shape=(len(cells), columns.max() + 1))
    shares = (reached @ reached.T).toarray() / np.maximum(np.minimum(sizes[:, None], sizes), 1)
    np.fill_diagonal(shares, 0)
    return shares.astype(np.float32)


def _more_partners(graph: RunGraph, similar: NDArray[np.float32], found: Pairs) -> list[tuple[int, int]]:
    """Pairs of runs of different groups: each run of a smaller group with the next similar ones."""
    left = similar.copy()
    for a, b in found:
        left[a, b] = left[b, a] = 0
    for part in graph.components:
        left[np.ix_(part, part)] = 0
    left[graph.components[0]] = 0  # the others ask the largest group, not the other way round
    return most_similar(left, PARTNERS)


def _block_centers(run: Path) -> NDArray[np.float64]:
    """Centres (k, 3) of the blocks with voxels of a run, metres."""
    header = MapHeader.read(run / MAP_FILE)
    return (header.coords[header.has_voxels].astype(np.float64) + 0.5) * header.volume().block_size
