"""Relative poses of runs, in rounds: similar runs first, then those that the poses found so far bring together.

A pair is compared by features, surfaces and checks, from candidates by place recognition or from the poses of all.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from dudmap.core.geometry import se3
from dudmap.core.geometry.alignment import agree
from dudmap.core.map import morton
from dudmap.core.places.saved_map import MAP_FILE
from dudmap.fleet.inputs import MapHeader, keyframes_of, surface_of
from dudmap.fleet.map_merging import NOT_RECOGNISED, MapPair, decided
from dudmap.fleet.map_samples import transformed
from dudmap.fleet.place_index import PARTNERS, TRAINING, described, learnt_words, most_similar, similarity
from dudmap.fleet.relative_pose import Hypothesis, relative_poses
from dudmap.fleet.run_graph import Join, RunGraph, drift_covariance, solve
from dudmap.fleet.workers import Workers

ALL_PAIRS = PARTNERS
"""Number of runs up to which all pairs are compared: the index would leave out next to none."""

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


@dataclass(frozen=True, eq=False)
class RegisteredPair:
    """What was found about two runs; see ``MapPair``."""

    a: int
    b: int
    pair: MapPair

    @property
    def join(self) -> Join | None:
        """The accepted relative pose, if there is one."""
        T, alignment, agreement = self.pair.T_a_b, self.pair.alignment, self.pair.agreement
        if T is None or alignment is None or agreement is None:
            return None
        return Join(self.a, self.b, T, drift_covariance(T, alignment.center, agreement.overlap))


def similar_runs(runs: Sequence[Path], workers: Workers) -> NDArray[np.float32]:
    """Similarity (n, n) of the places of the runs, see ``similarity``; 1 for few runs, which are all to be compared.

    Raises:
        MissingExtraError: faiss is not installed.
        MapError: A keyframe file is damaged.
    """
    n = len(runs)
    if n <= ALL_PAIRS:
        return 1 - np.eye(n, dtype=np.float32)
    share = [(path, -(-TRAINING // n)) for path in runs]
    words = learnt_words(np.concatenate(list(workers.map(_sample, share))))
    return similarity(list(workers.map(_described, [(path, words) for path in runs])))


def register_pairs(
    runs: Sequence[Path],
    pairs: Sequence[tuple[int, int]],
    workers: Workers,
    guesses: Mapping[tuple[int, int], NDArray[np.float64]],
) -> list[RegisteredPair]:
    """Relative pose of each pair (a, b) of runs, or why they are not to be joined.

    ``guesses`` are relative poses ``T_a_b`` (4, 4) of some pairs, which are tried before those of the features.
    """
    groups: dict[int, list[int]] = {}
    for a, b in pairs:
        groups.setdefault(a, []).append(b)
    jobs = [(runs[a], [(runs[b], guesses.get((a, b))) for b in others]) for a, others in groups.items()]
    found = workers.map(_compare, jobs)
    return [
        RegisteredPair(a, b, pair)
        for (a, others), results in zip(groups.items(), found, strict=True)
        for b, pair in zip(others, results, strict=True)
    ]


def _sample(job: tuple[Path, int]) -> NDArray[np.float32]:
    """At most so many features (n, 128) of a run, evenly spread."""
    path, count = job
    features = np.concatenate(
        [keyframe.features.descriptors for keyframe in keyframes_of(path)] or [np.zeros((0, 128))]
    )
    return features[:: max(1, len(features) // count)][:count].astype(np.float32)


def _described(job: tuple[Path, NDArray[np.float32]]) -> NDArray[np.float32]:
    return described(keyframes_of(job[0]), job[1])


def _compare(job: tuple[Path, list[tuple[Path, NDArray[np.float64] | None]]]) -> list[MapPair]:
    """Decisions on a run and others."""
    a, others = job
    header = MapHeader.read(a / MAP_FILE, blocks=False)
    return [_compare_two(a, b, guess, header) for b, guess in others]


def _compare_two(a: Path, b: Path, guess: NDArray[np.float64] | None, header: MapHeader) -> MapPair:
    if guess is not None:
        pair = decided(surface_of(a), surface_of(b), [Hypothesis(guess, 0, 0)], many=True)
        if pair.agreement is not None:
            return pair
    # a single recognised keyframe is enough: the features of a look-alike may outnumber those of the place itself, and
    # the checks are stricter here
    found = relative_poses(keyframes_of(a), keyframes_of(b), header.camera, header.sensor)
    if not found:
        return MapPair(None, NOT_RECOGNISED)
    return decided(surface_of(a), surface_of(b), found, many=True)


Pairs = dict[tuple[int, int], RegisteredPair]


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
