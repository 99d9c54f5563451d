"""Which of many runs may show the same place: a global descriptor of every keyframe, and the nearest ones in an index.

VLAD (Jegou et al. 2010): the differences of a keyframe's features to their nearest visual words, summed by word, each
sum normalised (Arandjelovic and Zisserman 2013) and the whole brought to unit length. The words are the centres of
k-means over features of all runs. The index is exact (faiss.IndexFlatIP): the 10,000 keyframes of 1,000 short runs are
compared in seconds.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.extras import extra
from dudmap.places.place_recognition import Keyframe

WORDS = 16
"""Visual words: a descriptor then has 2048 numbers, 8 KB."""
TRAINING = 50_000
"""Features that the words are learnt from, at most; 3000 for each word."""
NEIGHBOURS = 10
"""Keyframes of other runs that a keyframe votes for."""
PARTNERS = 8
"""Runs that each run is compared with; several, since look-alikes compete with the neighbours of a run."""


def learnt_words(features: NDArray[np.float32]) -> NDArray[np.float32]:
    """Visual words (WORDS, 128) of features (n, 128); the same for the same features.

    Raises:
        MissingExtraError: faiss is not installed.
    """
    kmeans = _faiss().Kmeans(
        features.shape[1], min(WORDS, len(features)), niter=20, seed=1, min_points_per_centroid=1,
        max_points_per_centroid=TRAINING,
    )  # fmt: skip
    kmeans.train(np.ascontiguousarray(features, np.float32))
    return kmeans.centroids


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


def candidate_pairs(runs: Sequence[NDArray[np.float32]], partners: int = PARTNERS) -> list[tuple[int, int]]:
    """Pairs (a, b), a < b, of runs that may show one place: the most similar ``partners`` of each.

    Every keyframe votes for the runs of its nearest keyframes with their similarity, as far as that exceeds the one of
    the last of them.

    Args:
        runs: Descriptors (k, d) of the keyframes of each run.
        partners: Runs that each is compared with, at least.
    """
    faiss = _faiss()
    everything = np.concatenate(runs)
    index = faiss.IndexFlatIP(everything.shape[1])
    index.add(everything)
    starts = np.cumsum([0, *(len(run) for run in runs)])
    run_of = np.repeat(np.arange(len(runs)), np.diff(starts))
    votes = np.zeros((len(runs), len(runs)))
    for a, own in enumerate(runs):
        others = faiss.IDSelectorNot(faiss.IDSelectorRange(int(starts[a]), int(starts[a + 1])))
        count = min(NEIGHBOURS + 1, len(everything) - len(own))
        similarity, found = index.search(own, count, params=faiss.SearchParameters(sel=others))
        np.add.at(votes[a], run_of[found], similarity - similarity[:, -1:])
    votes += votes.T
    best = np.argsort(-votes, axis=1, kind="stable")[:, :partners]
    pairs = {(min(a, int(b)), max(a, int(b))) for a, row in enumerate(best) for b in row if votes[a, b] > 0}
    return sorted(pairs)


def _faiss() -> Any:  # noqa: ANN401
    with extra("fleet", "the merging of more than two runs"):
        import faiss
    return faiss
