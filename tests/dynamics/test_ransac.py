"""Rigid motion of most of the visible surface from correspondences, against least squares and formulas."""

from types import SimpleNamespace

import numpy as np
import pytest

from dudmap.core.backends.cpu import consensus
from dudmap.core.dynamics import dominant_motion as dominant
from dudmap.core.dynamics.dominant_motion import dominant_motion
from dudmap.core.dynamics.ransac import NOISE_PX, flow_jacobian, reproject, rigid_motion
from dudmap.core.frames.observation import Level
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera

CAMERA = Camera(262.5, 262.5, 159.5, 119.5, 320, 240)


def test_the_flow_jacobian_is_the_derivative_of_the_projection():
    rng = np.random.default_rng(3)
    points = rng.uniform([-1, -1, 0.5], [1, 1, 5], (20, 3))
    J = flow_jacobian(points, CAMERA)
    for axis in range(6):
        step = 1e-6 * np.eye(6)[axis]
        numeric = (reproject(se3.exp(step), points, CAMERA) - reproject(se3.exp(-step), points, CAMERA)) / 2e-6
        np.testing.assert_allclose(J[:, :, axis], numeric, rtol=1e-5, atol=1e-4)


def test_the_refining_step_is_that_of_least_squares():
    rng = np.random.default_rng(5)
    points = rng.uniform([-1, -1, 0.5], [1, 1, 5], (200, 3))
    T = se3.exp(np.array([0.02, -0.01, 0.03, 0.01, 0.02, -0.01]))
    targets = reproject(T, points, CAMERA) + rng.normal(0, 1, (200, 2))
    guess = se3.exp(np.array([0.018, -0.01, 0.028, 0.011, 0.019, -0.01]))
    residual = targets - reproject(guess, points, CAMERA)
    near = np.linalg.norm(residual, axis=1) < 2 * NOISE_PX
    assert 20 < np.count_nonzero(near) < 180
    J = flow_jacobian(points @ guess[:3, :3].T + guess[:3, 3], CAMERA)[near].reshape(-1, 6)
    found = correspondences(points, targets, np.eye(4))
    H, gradient, inliers = consensus.linearized(np.stack([guess] * 8), found, np.full(8, 2 * NOISE_PX))
    assert set(inliers) == {np.count_nonzero(near)}
    expected = np.linalg.lstsq(J, residual[near].reshape(-1), rcond=None)[0]
    for g in (0, 7):
        np.testing.assert_allclose(np.linalg.solve(H[g], gradient[g]), expected, rtol=1e-5, atol=1e-9)
    assert not any(values.any() for values in consensus.linearized(guess[None], found, np.zeros(1)))


def test_the_scores_of_motions_are_those_of_the_formula():
    rng = np.random.default_rng(6)
    points, expected = rng.uniform([-1, -1, 0.5], [1, 1, 5], (150, 3)), se3.exp(0.02 * rng.normal(size=6))
    motions = se3.exp_all(0.01 * rng.normal(size=(70, 6)))
    targets = reproject(motions[0], points, CAMERA) + rng.normal(0, 1, (150, 2))
    params = consensus.ConsensusParams((1.5, 0.8), (3.0, 4.0), 5.0)
    scores = consensus.msac_scores(motions, correspondences(points, targets, expected), params)
    for T, found in zip(motions, scores, strict=True):
        pixels = reproject(T, points, CAMERA)
        d = np.linalg.norm(pixels - reproject(expected, points, CAMERA), axis=1).mean() / 5.0
        for score, inlier_px, gain in zip(found, (1.5, 0.8), (3.0, 4.0), strict=True):
            square = np.minimum(np.sum((pixels - targets) ** 2, axis=1) / inlier_px**2, 1)
            assert score == pytest.approx(gain * np.sum(points[:, 2] ** 2 * (1 - square)) * (0.5 + 0.5 / (1 + d**2)))


def correspondences(points, targets, T_expected):
    by_axis = (np.ascontiguousarray(values.T) for values in (points, targets, reproject(T_expected, points, CAMERA)))
    return consensus.Correspondences(*by_axis, points[:, 2] ** 2, CAMERA.intrinsics)


SLOW = se3.exp(np.array([0.002, -0.001, 0.003, 0.001, 0.002, -0.001]))
FAST = se3.exp(np.array([0.1, 0, 0, 0, 0, 0]))


@pytest.mark.parametrize(
    ("share", "expected", "found"),
    [
        (0.3, np.eye(4), FAST),  # what shows much more surface is the world, however fast
        (0.45, np.eye(4), SLOW),  # of two that show nearly as much it is what is expected
        (0.45, FAST, FAST),
        (0.7, FAST, SLOW),
    ],
)
def test_the_motion_of_most_surface_is_found_or_the_expected_one_of_two(share, expected, found):
    rng = np.random.default_rng(7)
    points = rng.uniform([-1, -1, 1], [1, 1, 5], (400, 3))
    areas = np.cumsum(points[:, 2] ** 2)
    slow = int(np.searchsorted(areas, share * areas[-1]))
    targets = np.concatenate([reproject(SLOW, points[:slow], CAMERA), reproject(FAST, points[slow:], CAMERA)])
    np.testing.assert_allclose(rigid_motion(points, targets, CAMERA, expected), found, atol=1e-6)


def test_the_share_that_follows_a_motion_is_one_of_the_surface(monkeypatch):
    """People at 1 m with most of the corners and a ninth of the surface walk past a wall at 4 m."""
    u = np.indices(CAMERA.shape)[1]
    level = Level(CAMERA, np.where(u < 200, 1, 4).astype(np.float32), np.zeros(CAMERA.shape, np.float32))
    rng = np.random.default_rng(8)
    people, wall = rng.integers([5, 5], [190, 230], (200, 2)), rng.integers([210, 5], [310, 230], (100, 2))
    pixels = np.concatenate([people, wall])
    targets = pixels + np.where(np.arange(300)[:, None] < 200, [6.0, 0.0], 0.0)
    monkeypatch.setattr(dominant, "track_forward_backward", lambda *_: (pixels, targets, np.zeros(300)))
    monkeypatch.setattr(dominant, "consistent_with_static", lambda *parts: np.zeros(len(parts[2]), bool))
    view = SimpleNamespace(fine=level, grey=None, corners=pixels, labelled=level)
    motion = dominant_motion(view, view, (None, None))
    np.testing.assert_allclose(motion.T_after_before, np.eye(4), atol=1e-6)
    assert motion.share == pytest.approx(16 / 18)


@pytest.mark.parametrize("seed", range(4))
def test_a_motion_between_those_of_the_world_and_of_slow_people_is_not_taken(seed):
    rng = np.random.default_rng(seed)
    room, people = (
        rng.uniform([-2, -1.5, 2.5], [2, 1.5, 4], (400, 3)),
        rng.uniform([-0.5, -0.5, 0.9], [0.5, 0.5, 1.1], (320, 3)),
    )
    steps = np.eye(4)
    steps[0, 3] = 0.01  # 0.3 m/s at 30 images per second: 2.6 pixels at 1 m
    points = np.concatenate([room, people])
    targets = np.concatenate([reproject(SLOW, room, CAMERA), reproject(SLOW @ steps, people, CAMERA)])
    found = rigid_motion(points, targets + rng.normal(0, 0.07, (720, 2)), CAMERA, np.eye(4))
    assert np.linalg.norm((se3.inverse(SLOW) @ found)[:3, 3]) < 0.0015  # 8 to 10 mm at a noise fixed at 0.29 pixels


def test_the_weighted_median_is_that_of_repeated_values():
    rng = np.random.default_rng(2)
    for count in (1, 2, 7, 40):
        values, weights = rng.normal(size=count), rng.integers(1, 9, count)
        repeated = np.sort(np.repeat(values, weights))
        assert dominant.weighted_median(values, weights.astype(float)) == repeated[(len(repeated) - 1) // 2]


def test_the_nearest_points_of_the_same_group_vote():
    rng = np.random.default_rng(3)
    points, group_of, moving = rng.normal(size=(60, 3)), rng.integers(1, 4, 60).astype(np.int32), rng.random(60) < 0.5
    queries, groups = rng.normal(size=(40, 3)), rng.integers(1, 4, 40).astype(np.int32)
    votes = consensus.neighbour_votes(queries, groups, points, group_of, moving, 5)
    for query, group, vote in zip(queries, groups, votes, strict=True):
        known = np.flatnonzero(group_of == group)
        nearest = known[np.argsort(np.linalg.norm(points[known] - query, axis=1))[:5]]
        assert vote == np.count_nonzero(moving[nearest])
