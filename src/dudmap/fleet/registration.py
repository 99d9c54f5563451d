"""Relative poses of runs: candidate pairs by place recognition, then features, surfaces and checks of every pair."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.core.places.saved_map import MAP_FILE
from dudmap.fleet.inputs import MapHeader
from dudmap.fleet.map_merging import NOT_RECOGNISED, MapPair, decided
from dudmap.fleet.open_maps import keyframes_of, surface_of
from dudmap.fleet.place_index import PARTNERS, TRAINING, described, learnt_words, similarity
from dudmap.fleet.relative_pose import Hypothesis, relative_poses
from dudmap.fleet.run_graph import Join, drift_covariance
from dudmap.fleet.workers import Workers

ALL_PAIRS = PARTNERS
"""Number of runs up to which all pairs are compared: the index would leave out next to none."""


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
    guesses: Mapping[tuple[int, int], NDArray[np.float64]] | None = None,
) -> list[RegisteredPair]:
    """Relative pose of each pair of runs, or why they are not to be joined.

    Args:
        runs: All run folders.
        pairs: Pairs (a, b) of them.
        workers: Who compares them.
        guesses: Relative poses ``T_a_b`` (4, 4) of some pairs, which are tried before those of the features.
    """
    groups: dict[int, list[int]] = {}
    for a, b in pairs:
        groups.setdefault(a, []).append(b)
    known = guesses or {}
    jobs = [(runs[a], [(runs[b], known.get((a, b))) for b in others]) for a, others in groups.items()]
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
    found = relative_poses(keyframes_of(a), keyframes_of(b), header.camera, sensor=header.sensor)
    if not found:
        return MapPair(None, NOT_RECOGNISED)
    return decided(surface_of(a), surface_of(b), found, many=True)
