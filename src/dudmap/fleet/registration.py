"""Relative poses of runs: similar runs first, then runs that overlap.

Places are recognised by VLAD (Jegou et al. 2010): differences of features to their nearest visual words (k-means),
summed and normalised per word (Arandjelovic and Zisserman 2013). Sums are whitened (Jegou and Chum 2012), because many
places share doors and wallpaper.
"""

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.linalg import eigh
from scipy.sparse import csr_array

from dudmap.core.geometry import se3
from dudmap.core.geometry.se3 import agree
from dudmap.core.map import morton
from dudmap.core.places.place_recognition import Keyframe
from dudmap.core.places.saved_map import MAP_FILE
from dudmap.fleet.map_merging import NOT_RECOGNISED, Hypothesis, MapPair, decided, relative_poses
from dudmap.fleet.map_samples import transformed
from dudmap.fleet.run_graph import Join, RunGraph, drift_covariance, solve
from dudmap.fleet.workers import MapHeader, Workers, keyframes_of, surface_of

log = logging.getLogger(__name__)

WORDS = 16
"""Visual words: descriptors of 2048 numbers."""
TRAINING = 50_000
"""Features that train the words."""
COMPONENTS, WHITENING = 256, 0.25
"""Kept principal components, and whitening exponent of their variances."""
LEAST_VARIANCE = 1e-6
"""Added to variances, which copies of a run lack."""
NEIGHBOURS, LEAST_VOTE = 20, 1e-4
"""Runs that a keyframe votes for, and its vote for the last."""
PARTNERS = 8
"""Runs that each is compared with."""

ALL_PAIRS = PARTNERS
"""Runs up to which all pairs are compared."""
Guesses = dict[tuple[int, int], NDArray[np.float64]]
ROUNDS = 4
"""Most rounds of comparisons."""
MIN_PREDICTED = 0.3
"""Smallest predicted overlap to compare, share of the smaller map."""
CELL = 0.3
"""Edge of the cells in which overlap is counted, metres."""
SAME_DISTANCE, SAME_ANGLE_DEG = 0.25, 5.0
"""A rejection is not valid for poses that differ by more (m, deg)."""


def learnt_words(features: NDArray[np.float32]) -> NDArray[np.float32]:
    """Visual words (WORDS, 128) of features (n, 128), deterministic."""
    some = features[:: max(1, len(features) // TRAINING)].astype(np.float64)
    count = min(WORDS, len(some))
    words, _ = kmeans2(some, count, iter=20, minit="++", seed=1)  # pyright: ignore[reportCallIssue] (rng from 1.15 on)
    return words.astype(np.float32)


def described(keyframes: Sequence[Keyframe], words: NDArray[np.float32]) -> NDArray[np.float32]:
    """VLAD descriptors (keyframes, words * 128), unit length."""
    out = np.zeros((len(keyframes), *words.shape), np.float32)
    for number, keyframe in enumerate(keyframes):
        features = keyframe.features.descriptors
        word = np.argmax(features @ words.T - np.square(words).sum(axis=1) / 2, axis=1)  # the nearest
        np.add.at(out[number], word, features - words[word])
    out /= np.maximum(np.linalg.norm(out, axis=2, keepdims=True), 1e-9)
    flat = out.reshape(len(keyframes), -1)
    return flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9)


def similarity(runs: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Similarity (n, n) of runs from descriptors (k, d) of each. Every keyframe votes for the ``NEIGHBOURS`` most
    similar runs, by its excess over the last."""
    everything = _whitened(np.concatenate(runs))
    sizes = np.array([len(run) for run in runs], np.int64)
    ends, held = np.cumsum(sizes), np.flatnonzero(sizes)
    starts = (ends - sizes)[held]
    votes = np.zeros((len(runs), len(runs)), np.float32)
    for a, start in zip(held, starts, strict=True):
        best = np.maximum.reduceat(everything[start : ends[a]] @ everything.T, starts, axis=1)
        best[:, held == a] = -1
        last = min(NEIGHBOURS, len(held)) - 1
        limit = -np.sort(-best, axis=1)[:, last : last + 1]
        votes[a, held] = np.where(best >= limit, best - limit + LEAST_VOTE, 0).sum(axis=0)
    np.fill_diagonal(votes, 0)
    return votes + votes.T


def most_similar(votes: NDArray[np.float32], partners: int) -> list[tuple[int, int]]:
    """Pairs (a, b), a < b, of each run with its ``partners`` in ``votes`` (n, n)."""
    best = np.argsort(-votes, axis=1, kind="stable")[:, :partners]
    pairs = {(min(a, int(b)), max(a, int(b))) for a, row in enumerate(best) for b in row if votes[a, b] > 0}
    return sorted(pairs)


def _whitened(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    count, size = descriptors.shape
    centred = (descriptors - descriptors.mean(axis=0)).astype(np.float64)
    wide = count < size  # decompose the smaller of both products; their nonzero eigenvalues are equal
    product = centred @ centred.T if wide else centred.T @ centred
    kept = max(1, min(COMPONENTS, count // 2, size))
    squares, axes = eigh(product, subset_by_index=[len(product) - kept, len(product) - 1])
    squares = np.maximum(squares, 0)
    out = axes * np.sqrt(squares) if wide else centred @ axes
    out *= (squares / count + LEAST_VARIANCE) ** -WHITENING
    return (out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9)).astype(np.float32)


Pairs = dict[tuple[int, int], MapPair]


def join_of(runs: tuple[int, int], pair: MapPair) -> Join | None:
    """Join of an accepted relative pose, or None."""
    T, alignment, agreement = pair.T_a_b, pair.alignment, pair.agreement
    if T is None or alignment is None or agreement is None:
        return None
    return Join(*runs, T, drift_covariance(T, alignment.center, agreement.overlap))


def similar_runs(runs: Sequence[Path], workers: Workers) -> NDArray[np.float32]:
    """Similarity (n, n) of runs, see ``similarity``; 1 for few.

    Raises:
        MapError: A keyframe file is damaged.
    """
    n = len(runs)
    if n <= ALL_PAIRS:
        return 1 - np.eye(n, dtype=np.float32)
    share = [(path, -(-TRAINING // n)) for path in runs]
    words = learnt_words(np.concatenate(list(workers.map(_sample, share))))
    return similarity(list(workers.map(_described, [(path, words) for path in runs])))


def register_pairs(runs: Sequence[Path], pairs: Sequence[tuple[int, int]], workers: Workers, guesses: Guesses) -> Pairs:
    """Compare pairs of runs; ``guesses`` come before features. A job has the pairs of one first run."""
    groups: dict[int, list[int]] = {}
    for a, b in pairs:
        groups.setdefault(a, []).append(b)
    jobs = [(runs[a], [(runs[b], guesses.get((a, b))) for b in others]) for a, others in groups.items()]
    found = workers.map(_compare, jobs)
    return {
        (a, b): pair
        for (a, others), results in zip(groups.items(), found, strict=True)
        for b, pair in zip(others, results, strict=True)
    }


def _sample(job: tuple[Path, int]) -> NDArray[np.float32]:
    path, count = job
    features = np.concatenate(
        [keyframe.features.descriptors for keyframe in keyframes_of(path)] or [np.zeros((0, 128))]
    )
    return features[:: max(1, len(features) // count)][:count].astype(np.float32)


def _described(job: tuple[Path, NDArray[np.float32]]) -> NDArray[np.float32]:
    return described(keyframes_of(job[0]), job[1])


def _compare(job: tuple[Path, list[tuple[Path, NDArray[np.float64] | None]]]) -> list[MapPair]:
    a, others = job
    header = MapHeader.read(a / MAP_FILE)
    return [_compare_two(a, b, guess, header) for b, guess in others]


def _compare_two(a: Path, b: Path, guess: NDArray[np.float64] | None, header: MapHeader) -> MapPair:
    if guess is not None:
        pair = decided(surface_of(a), surface_of(b), [Hypothesis(guess, 0, 0)], many=True)
        if pair.agreement is not None:
            return pair
    # one recognised keyframe is enough, because the checks are stricter here: a similar place may have more matching
    # features than the place itself
    found = relative_poses(keyframes_of(a), keyframes_of(b), header.camera, header.sensor)
    if not found:
        return MapPair(None, NOT_RECOGNISED)
    return decided(surface_of(a), surface_of(b), found, many=True)


def registered_runs(runs: Sequence[Path], workers: Workers) -> tuple[Pairs, RunGraph]:
    """Relative poses of pairs, and poses of all runs.

    Round one compares similar runs; later ones those that overlap, and smaller groups with the next similar.

    Raises:
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
        log.info("round %d: %d of %d pairs of runs are compared", number + 1, len(wanted), n * (n - 1) // 2)
        found |= register_pairs(runs, wanted, workers, guesses)
        graph = _graph(n, found, guesses)
        near = _brought_together(graph, blocks, found, guesses)
        guesses |= {(a, b): se3.inverse(graph.Ts[a]) @ graph.Ts[b] for a, b in near}
        wanted = sorted({*near, *_more_partners(graph, similar, found)})
    return found, graph


def _graph(count: int, found: Pairs, guesses: Guesses) -> RunGraph:
    joins = [join for runs, pair in found.items() if (join := join_of(runs, pair)) is not None]
    graph = solve(count, joins)
    denied = [pair for pair, guess in guesses.items() if found[pair].contradicted and _is_at(graph, pair, guess)]
    return solve(count, joins, denied) if denied else graph


def _is_at(graph: RunGraph, pair: tuple[int, int], T: NDArray[np.float64]) -> bool:
    a, b = pair
    return agree(se3.inverse(graph.Ts[a]) @ graph.Ts[b], T, SAME_DISTANCE, SAME_ANGLE_DEG)


def _brought_together(
    graph: RunGraph, blocks: Sequence[NDArray[np.float64]], found: Pairs, guesses: Guesses
) -> list[tuple[int, int]]:
    shares = np.zeros((len(blocks), len(blocks)), np.float32)
    for part in graph.components:
        shares[np.ix_(part, part)] = predicted_overlap([transformed(graph.Ts[run], blocks[run]) for run in part], CELL)
    shares[shares < MIN_PREDICTED] = 0
    known = [runs for runs, pair in found.items() if pair.T_a_b is not None]
    for a, b in [*known, *(pair for pair, guess in guesses.items() if _is_at(graph, pair, guess))]:
        shares[a, b] = shares[b, a] = 0
    return most_similar(shares, PARTNERS)


def predicted_overlap(points: Sequence[NDArray[np.float64]], cell: float) -> NDArray[np.float32]:
    """Common cells of point sets (k, 3) as shares (n, n) of the smaller set; 0 on the diagonal."""
    cells = [np.unique(morton.encode(np.floor(own / cell).astype(np.int64))) for own in points]
    sizes = np.array([len(own) for own in cells])
    _, columns = np.unique(np.concatenate(cells), return_inverse=True)
    rows = np.repeat(np.arange(len(cells)), sizes)
    reached = csr_array((np.ones(len(rows), np.float32), (rows, columns)), shape=(len(cells), columns.max() + 1))
    shares = (reached @ reached.T).toarray() / np.maximum(np.minimum(sizes[:, None], sizes), 1)
    np.fill_diagonal(shares, 0)
    return shares.astype(np.float32)


def _more_partners(graph: RunGraph, similar: NDArray[np.float32], found: Pairs) -> list[tuple[int, int]]:
    left = similar.copy()
    for a, b in found:
        left[a, b] = left[b, a] = 0
    for part in graph.components:
        left[np.ix_(part, part)] = 0
    left[graph.components[0]] = 0  # smaller groups query the largest group, not the reverse
    return most_similar(left, PARTNERS)


def _block_centers(run: Path) -> NDArray[np.float64]:
    header = MapHeader.read(run / MAP_FILE)
    return (header.coords[header.has_voxels].astype(np.float64) + 0.5) * header.volume().block_size
