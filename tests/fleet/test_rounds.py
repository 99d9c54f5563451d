"""Rounds of registration against a ring of runs whose relative poses are known, and the overlap of boxes."""

from pathlib import Path

import numpy as np

from dudmap.core.geometry import se3
from dudmap.fleet import registration
from dudmap.fleet.agreement import Agreement
from dudmap.fleet.map_merging import NOT_RECOGNISED, Hypothesis, MapPair
from dudmap.fleet.registration import predicted_overlap, registered_runs
from dudmap.fleet.sdf_alignment import SdfAlignment
from dudmap.fleet.workers import Workers

RUNS, RADIUS = 12, 5.0
TRUE = [se3.exp(np.array([0, 0, 0, 0, 0, 2 * np.pi * k / RUNS])) for k in range(RUNS)]
for T in TRUE:
    T[:3, 3] = T[:3, 0] * RADIUS
AGREED, DENIED = Agreement(20.0, 0.5, 0.0, 0.99, 1.0, 0.0), Agreement(20.0, 0.5, 0.05, 0.9, 0.95, 1.0)


def box_points(low, high):
    """Points (n, 3) in the middle of cells of 10 cm of a box."""
    axes = [np.arange(a + 0.05, b, 0.1) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def test_the_predicted_overlap_of_boxes_is_that_of_their_volumes():
    boxes = [((0, 0, 0), (4, 1, 1)), ((1, 0, 0), (5, 1, 1)), ((3.5, 0, 0), (5.5, 1, 1)), ((9, 9, 9), (10, 10, 10))]
    shares = predicted_overlap([box_points(*corners) for corners in boxes], 0.5)
    expected = [[0, 3 / 4, 1 / 4, 0], [3 / 4, 0, 3 / 4, 0], [1 / 4, 3 / 4, 0, 0], [0, 0, 0, 0]]
    np.testing.assert_allclose(shares, expected, atol=1e-6)


class Oracle:
    """Knows which runs overlap: neighbours on the ring. Features miss the pair (0, 11); ``false`` look alike."""

    def __init__(self, false=()):
        self.false, self.asked = set(false), []

    def __call__(self, runs, pairs, workers, guesses):
        self.asked.append(list(pairs))
        return {(a, b): self.decided(a, b, guesses.get((a, b))) for a, b in pairs}

    def decided(self, a, b, guess):
        T = se3.inverse(TRUE[a]) @ TRUE[b]
        alignment = SdfAlignment(T, True, 0.004, 0.1, np.zeros(3))
        if (a, b) in self.false:
            return MapPair(np.eye(4), "", Hypothesis(np.eye(4), 3, 99), alignment, AGREED)
        if b - a == 1 or (b - a == RUNS - 1 and guess is not None):
            return MapPair(T, "", Hypothesis(T, 3, 99), alignment, AGREED)
        if guess is not None:
            return MapPair(None, "the geometry disagrees", Hypothesis(guess, 0, 0), alignment, DENIED)
        return MapPair(None, NOT_RECOGNISED)


def register(patch, oracle, similar):
    patch.setattr(registration, "PARTNERS", 2)
    patch.setattr(registration, "similar_runs", lambda runs, workers: similar)
    patch.setattr(registration, "register_pairs", oracle)
    patch.setattr(registration, "_block_centers", lambda run: box_points((-1, -2, -1), (1, 2, 1)))
    with Workers(1) as crew:
        return registered_runs([Path(str(run)) for run in range(RUNS)], crew)


def similarity():
    """Neighbours are similar, but others more so at two places: of 5 and 6, and of 0 and 11."""
    similar = np.zeros((RUNS, RUNS), np.float32)
    for k in range(RUNS - 1):
        similar[k, k + 1] = 1.0
    similar[5, 6] = 0.1
    similar[3, 5] = similar[6, 8] = 0.5
    return similar + similar.T


def test_groups_ask_more_runs_and_a_ring_is_closed_by_its_geometry(monkeypatch):
    oracle = Oracle()
    pairs, graph = register(monkeypatch, oracle, similarity())
    assert (5, 6) not in oracle.asked[0]
    assert (5, 6) in oracle.asked[1]
    assert (0, 11) in oracle.asked[2]
    assert graph.components == [list(range(RUNS))]
    assert len(graph.kept) == RUNS
    for run, T in enumerate(graph.Ts):
        np.testing.assert_allclose(T, se3.inverse(TRUE[0]) @ TRUE[run], atol=1e-6)
    assert len(pairs) == sum(len(asked) for asked in oracle.asked)


def test_a_false_join_is_given_up_because_the_runs_it_brings_together_disagree(monkeypatch):
    similar = similarity()
    similar[5, 6] = similar[6, 5] = 0  # two groups, and nothing that joins them rightly
    similar[2, 9] = similar[9, 2] = 2.0
    oracle = Oracle(false=[(2, 9)])
    _, graph = register(monkeypatch, oracle, similar)
    assert (2, 9) in oracle.asked[0]
    assert [(join.a, join.b) for join in graph.rejected] == [(2, 9)]
    assert graph.components == [list(range(6)), list(range(6, 12))]
