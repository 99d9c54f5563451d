"""Which of many runs may show the same place: a global descriptor of every keyframe, and the nearest ones in an index.

VLAD (Jegou et al. 2010): the differences of a keyframe's features to their nearest visual words, summed by word, each
sum normalised (Arandjelovic and Zisserman 2013) and the whole brought to unit length. The words are the centres of
k-means over features of all runs. The principal components of all descriptors are scaled towards equal variance, which
lowers the weight of what many places have in common, such as doors and wallpaper (whitening, Jegou and Chum 2012). All
are compared with all: 10,000 keyframes of 1,000 short runs in seconds.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.places.place_recognition import Keyframe
from dudmap.extras import extra

WORDS = 16
"""Visual words: a descriptor then has 2048 numbers, 8 KB."""
TRAINING = 50_000
"""Features that the words are learnt from, at most; 3000 for each word."""
COMPONENTS, WHITENING = 256, 0.25
"""Principal components that are kept, and the power of their variances by which they are divided; 0.5 would also raise
those that are noise."""
LEAST_VARIANCE = 1e-6
"""Added to each variance, so that copies of one run do not divide by zero; the variances of all components sum to 1 at
most."""
NEIGHBOURS, LEAST_VOTE = 20, 1e-4
"""Runs that a keyframe votes for, more if they are equally similar, and its vote for the last of them."""
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


def similarity(runs: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """How similar the places of each two runs are (n, n), symmetric, 0 on the diagonal, from descriptors (k, d) of
    each.

    Every keyframe votes for the runs with the most similar keyframes, as far as they exceed the last of these runs.
    """
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
    """Pairs (a, b), a < b: each run with those that have the most votes (n, n) in its row, at most so many."""
    best = np.argsort(-votes, axis=1, kind="stable")[:, :partners]
    pairs = {(min(a, int(b)), max(a, int(b))) for a, row in enumerate(best) for b in row if votes[a, b] > 0}
    return sorted(pairs)


def _whitened(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Principal components (k, at most COMPONENTS and k / 2) of descriptors (k, d), scaled, unit length."""
    count, size = descriptors.shape
    pca = _faiss().PCAMatrix(size, max(1, min(COMPONENTS, count // 2, size)), -WHITENING)
    pca.epsilon = LEAST_VARIANCE
    pca.train(np.ascontiguousarray(descriptors))
    out = pca.apply(np.ascontiguousarray(descriptors))
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9)


def _faiss() -> Any:  # noqa: ANN401
    with extra("fleet", "the merging of more than two runs"):
        import faiss
    return faiss
