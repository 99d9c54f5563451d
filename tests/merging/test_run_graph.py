"""Poses of many runs: recovered in spite of false joins, given up where it cannot be told which join is false."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dudmap.core.geometry import se3
from dudmap.core.map import morton
from dudmap.fleet.run_graph import SIGMA_DISTANCE, Join, best_cut, consistent, drift_covariance, solve, supported

RUNS = 24


def joins_of(pairs, Ts, rng):
    """Relative poses with errors of 3 mm and 0.06 degrees per axis."""
    return [
        Join(a, b, se3.inverse(Ts[a]) @ Ts[b] @ se3.exp(np.r_[rng.normal(0, 0.003, 3), rng.normal(0, 0.001, 3)]))
        for a, b in pairs
    ]


@pytest.fixture
def world():
    rng = np.random.default_rng(3)
    Ts = [np.eye(4), *[se3.exp(np.r_[rng.uniform(-6, 6, 3), rng.uniform(-1, 1, 3)]) for _ in range(RUNS - 1)]]
    return Ts, rng


def test_poses_are_found_in_spite_of_false_joins(world):
    Ts, rng = world
    near = [(k, k + step) for step in (1, 2) for k in range(RUNS - step)]
    false = [Join(a, b, se3.exp(rng.uniform(-1, 1, 6) * 3)) for a, b in ((3, 17), (4, 18), (5, 9), (20, 22))]
    graph = solve(RUNS, joins_of(near, Ts, rng) + false)
    assert {id(join) for join in graph.rejected} >= {id(join) for join in false}
    assert len(graph.rejected) <= len(false) + 2
    assert graph.components == [list(range(RUNS))]
    errors = [np.linalg.norm((se3.inverse(T) @ found)[:3, 3]) for T, found in zip(Ts, graph.Ts, strict=True)]
    assert max(errors) < 0.06


def test_a_false_join_that_closes_a_ring_takes_the_unconfirmed_ones_along(world):
    Ts, rng = world
    ring = joins_of([(k, k + 1) for k in range(5)], Ts, rng)
    false = Join(0, 5, se3.exp(np.ones(6)))
    assert consistent([*ring, false]) == []
    right = joins_of([(0, 5)], Ts, rng)
    assert len(consistent([*ring, *right])) == 6
    triangles = joins_of([(k, k + 2) for k in range(4)], Ts, rng)
    assert consistent([*ring, *triangles, false]) == [*ring, *triangles]


def test_a_tree_is_kept_and_runs_without_joins_stay_alone(world):
    Ts, rng = world
    graph = solve(6, joins_of([(0, 1), (1, 2), (4, 5)], Ts, rng))
    assert graph.components == [[0, 1, 2], [4, 5], [3]]
    assert graph.rejected == []
    np.testing.assert_array_equal(graph.Ts[[0, 3, 4]], np.tile(np.eye(4), (3, 1, 1)))
    np.testing.assert_allclose(graph.Ts[2], se3.inverse(Ts[0]) @ Ts[2], atol=0.1)


def test_runs_of_one_place_are_proposed():
    from dudmap.fleet.registration import most_similar, similarity

    rng = np.random.default_rng(0)
    views = rng.normal(size=(40, 64)).astype(np.float32)  # run k sees the views k and k + 1 of a long corridor
    runs = [views[k : k + 2] + 0.2 * rng.normal(size=(2, 64)).astype(np.float32) for k in range(39)]
    runs = [run / np.linalg.norm(run, axis=1, keepdims=True) for run in runs]
    votes = similarity(runs)
    np.testing.assert_array_equal(votes, votes.T)
    pairs = most_similar(votes, 3)
    assert {(k, k + 1) for k in range(38)} <= set(pairs)
    assert len(pairs) <= 39 * 3
    assert len(most_similar(similarity([runs[0]] * 30), 3)) >= 30  # copies are compared, too


coordinate = st.integers(-(1 << 20), (1 << 20) - 1)


@given(st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=1), st.integers(0, 20))
def test_morton_codes_are_unique_and_cubes_are_runs_of_codes(coords, level):
    blocks = np.array(coords)
    codes = morton.encode(blocks)
    np.testing.assert_array_equal(morton.decode(codes), blocks)
    cubes = morton.encode((blocks >> level) << level) >> (3 * level)
    np.testing.assert_array_equal(codes >> (3 * level), cubes)


def test_joins_of_look_alike_floors_that_agree_with_each_other_are_given_up(world):
    Ts, rng = world
    lower, upper = range(12), range(12, 24)
    rings = [(k, k + step) for floor in (lower, upper) for step in (1, 2) for k in floor if k + step in floor]
    shift = se3.exp(np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]))  # puts floor on floor, the same for all false joins
    false = [Join(k, k + 12, se3.inverse(Ts[k]) @ shift @ Ts[k + 12]) for k in (3, 8)]
    joins = joins_of(rings, Ts, rng) + false
    assert consistent(false) == false
    denied = [(k, k + 12) for k in (1, 5, 9)]
    assert supported(joins, denied) == joins[:-2]
    assert supported(joins, denied[:1]) == joins  # one pair that disagrees does not outweigh two joins
    graph = solve(RUNS, joins, denied)
    assert graph.components == [list(lower), list(upper)]
    assert set(map(id, graph.rejected)) == set(map(id, false))


def test_the_cut_with_most_contradictions_is_made():
    chain = [(0, 1), (1, 2), (2, 3), (3, 4)]
    assert best_cut(chain, [(1, 3), (2, 4), (0, 4)]) == {2}  # only (2, 3) separates all three
    assert best_cut(chain, []) == set()
    assert best_cut(chain, [(7, 8)]) == set()


def test_the_error_of_a_join_is_drift_at_the_middle_of_the_common_surface(world):
    T, middle = world[0][5], np.array([4.0, -3.0, 1.0])
    R, at_b = T[:3, :3], se3.inverse(T)[:3] @ np.r_[middle, 1.0]
    J = R @ np.hstack([np.eye(3), -se3.hat(at_b)])  # motion of that point by a twist e behind T
    for overlap, sigma in ((0.5, SIGMA_DISTANCE), (0.25, 4 * SIGMA_DISTANCE)):
        moved = J @ drift_covariance(T, middle, overlap) @ J.T
        np.testing.assert_allclose(moved, sigma**2 * np.eye(3), atol=1e-12)


def test_the_error_of_a_ring_goes_where_a_relative_pose_is_uncertain():
    sure, unsure = np.diag(np.full(6, 1e-6)), np.diag([1e-2, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6])
    slip = se3.exp(np.array([0.02, 0, 0, 0, 0, 0]))
    joins = [
        Join(0, 1, np.eye(4), sure),
        Join(1, 2, slip, unsure),
        Join(2, 3, np.eye(4), sure),
        Join(0, 3, np.eye(4), sure),
    ]
    graph = solve(4, joins)
    assert graph.rejected == []
    np.testing.assert_allclose(graph.Ts, np.tile(np.eye(4), (4, 1, 1)), atol=2e-4)
