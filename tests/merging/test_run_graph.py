"""Poses of many runs: recovered in spite of false joins, given up where it cannot be told which join is false."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dudmap.geometry import se3
from dudmap.mapping import morton
from dudmap.merging.run_graph import Join, consistent, solve

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
    pytest.importorskip("gtsam")
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
    pytest.importorskip("faiss")
    from dudmap.merging.place_index import candidate_pairs

    rng = np.random.default_rng(0)
    views = rng.normal(size=(40, 64)).astype(np.float32)  # run k sees the views k and k + 1 of a long corridor
    runs = [views[k : k + 2] + 0.2 * rng.normal(size=(2, 64)).astype(np.float32) for k in range(39)]
    runs = [run / np.linalg.norm(run, axis=1, keepdims=True) for run in runs]
    pairs = candidate_pairs(runs, partners=3)
    assert {(k, k + 1) for k in range(38)} <= set(pairs)
    assert len(pairs) <= 39 * 3


coordinate = st.integers(-(1 << 20), (1 << 20) - 1)


@given(st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=1), st.integers(0, 20))
def test_morton_codes_are_unique_and_cubes_are_runs_of_codes(coords, level):
    blocks = np.array(coords)
    codes = morton.encode(blocks)
    np.testing.assert_array_equal(morton.decode(codes), blocks)
    cubes = morton.encode((blocks >> level) << level) >> (3 * level)
    np.testing.assert_array_equal(codes >> (3 * level), cubes)
