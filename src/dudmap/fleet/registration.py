"""Relative poses of runs: candidate pairs by place recognition, then features, surfaces and checks of every pair."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.fleet.inputs import MapHeader
from dudmap.fleet.open_maps import keyframes_of, surface_of
from dudmap.fleet.workers import Workers
from dudmap.merging.agreement import MANY_COLOR_SHARE
from dudmap.merging.map_merging import NOT_RECOGNISED, MapPair, decided, suggested_poses
from dudmap.merging.place_index import PARTNERS, TRAINING, candidate_pairs, described, learnt_words
from dudmap.places.saved_map import MAP_FILE

ALL_PAIRS = PARTNERS
"""Number of runs up to which all pairs are compared: the index would leave out next to none."""


@dataclass(frozen=True, eq=False)
class RegisteredPair:
    """What was found about two runs; see ``MapPair``."""

    a: int
    b: int
    pair: MapPair


def proposed_pairs(runs: Sequence[Path], workers: Workers) -> list[tuple[int, int]]:
    """Pairs (a, b), a < b, of runs that are to be compared.

    Raises:
        ConfigError: faiss is not installed.
        MapError: A keyframe file is damaged.
    """
    n = len(runs)
    if n <= ALL_PAIRS:
        return [(a, b) for a in range(n) for b in range(a + 1, n)]
    share = [(path, -(-TRAINING // n)) for path in runs]
    words = learnt_words(np.concatenate(list(workers.map(_sample, share))))
    return candidate_pairs(list(workers.map(_described, [(path, words) for path in runs])))


def register_pairs(runs: Sequence[Path], pairs: Sequence[tuple[int, int]], workers: Workers) -> list[RegisteredPair]:
    """Relative pose of each pair of runs, or why they are not to be joined."""
    groups: dict[int, list[int]] = {}
    for a, b in pairs:
        groups.setdefault(a, []).append(b)
    jobs = [(runs[a], [runs[b] for b in others]) for a, others in groups.items()]
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


def _compare(job: tuple[Path, list[Path]]) -> list[MapPair]:
    """Decisions on a run and others."""
    a, others = job
    header = MapHeader.read(a / MAP_FILE, blocks=False)
    return [_compare_two(a, b, header) for b in others]


def _compare_two(a: Path, b: Path, header: MapHeader) -> MapPair:
    found = suggested_poses(keyframes_of(a), keyframes_of(b), header.camera, header.sensor)
    if not found:
        return MapPair(None, NOT_RECOGNISED)
    return decided(surface_of(a), surface_of(b), found, MANY_COLOR_SHARE)
