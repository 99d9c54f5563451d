"""Rigid motion of most of the visible surface from correspondences, against least squares and formulas."""

from types import SimpleNamespace

import numpy as np
import pytest

from dudmap.core.backends.cpu import consensus
from dudmap.core.dynamics import dominant_motion as dominant
from dudmap.core.dynamics.dominant_motion import dominant_motion, reproject, rigid_motion
from dudmap.core.frames.observation import Level
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from ransac_oracle import best_motion, flow_jacobian, refined, scores

CAMERA = Camera(262.5, 262.5, 159.5, 119.5, 320, 240)


def test_the_flow_jacobian_is_the_derivative_of_the_projection():
    rng = np.random.default_rng(3)
    points = rng.uniform([-1, -1, 0.5], [1, 1, 5], (20, 3))
    J = flow_jacobian(points, CAMERA)
    for axis in range(6):
        step = 1e-6 * np.eye(6)[axis]
        numeric = (reproject(se3.exp(step), points, CAMERA) - reproject(se3.exp(-step), points, CAMERA)) / 2e-6
        np.testing.assert_allclose(J[:, :, axis], numeric, rtol=1e-5, atol=1e-4)


def noisy(rng, count):
    """Points, and their targets after a small motion, some of them wrong."""
    points = rng.uniform([-1, -1, 0.5], [1, 1, 5], (count, 3))
    targets = reproject(se3.exp(0.02 * rng.normal(size=6)), points, CAMERA) + rng.normal(0, 0.2, (count, 2))
    targets[: count // 4] += rng.uniform(-20, 20, (count // 4, 2))
    return points, targets


@pytest.mark.parametrize("seed", range(5))
def test_the_best_motion_is_that_of_all_hypotheses_and_their_refinement(seed):
    rng = np.random.default_rng(seed)
    points, targets = noisy(rng, 300)
    T_expected, draws = se3.exp(0.02 * rng.normal(size=6)), rng.integers(0, 300, (200, 3))
    draws[7] = draws[8] = 5  # degenerate
    params = consensus.ConsensusParams((1.5, 0.8), (3.0, 4.0), 5.0)
    expected = best_motion(draws, points, targets, params, T_expected, CAMERA)
    found = consensus.best_motion(draws, correspondences(points, targets, T_expected), params, T_expected)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_the_search_is_the_same_with_any_number_of_threads(give_threads):
    rng = np.random.default_rng(9)
    points, targets = noisy(rng, 500)
    found = []
    for threads in (1, 2):
        give_threads(threads)
        found.append(rigid_motion(points, targets, CAMERA, np.eye(4)))
    assert np.array_equal(*found)


def test_motions_are_refined_and_scored_as_by_the_formulas():
    rng = np.random.default_rng(6)
    points, targets = noisy(rng, 150)
    T_expected, motions = se3.exp(0.02 * rng.normal(size=6)), se3.exp_all(0.01 * rng.normal(size=(20, 6)))
    params, found = consensus.ConsensusParams((1.5, 0.8), (3.0, 4.0), 5.0), correspondences(points, targets, T_expected)
    out = np.full((20, 2), np.nan)
    consensus.score(5, 20, motions, found, params, out)
    expected = scores(motions, points, targets, reproject(T_expected, points, CAMERA), params, CAMERA)
    np.testing.assert_allclose(out[5:], expected[5:], rtol=1e-9)
    assert np.isnan(out[:5]).all()
    T = motions[0].copy()
    consensus.refine(T, found, 3.0)
    np.testing.assert_allclose(T, refined(motions[0], points, targets, 3.0, CAMERA), atol=1e-9)
    unchanged = motions[1].copy()
    consensus.refine(unchanged, found, 0.0)  # without inliers
    assert np.array_equal(unchanged, motions[1])


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
    monkeypatch.setattr(dominant, "track_forward_backward", lambda *_: (targets, np.zeros(300), np.ones(300, bool)))
    monkeypatch.setattr(dominant, "consistent_with_static", lambda *parts: np.zeros(len(parts[2]), bool))
    points = CAMERA.points(*pixels.T, level.depth[pixels[:, 1], pixels[:, 0]].astype(np.float64))
    view = SimpleNamespace(fine=level, coarse=level, grey=None, corners=pixels, corner_points=points, labelled=level)
    motion = dominant_motion(view, view, (None, None))
    np.testing.assert_allclose(motion.T_after_before, np.eye(4), atol=1e-6)
    assert motion.share == pytest.approx(16 / 18)


def test_the_pixels_of_a_fitted_motion_are_as_uncertain_as_repeated_fits_show():
    """Corners on the far side of a room tell little of where the floor before the camera ought to be."""
    rng = np.random.default_rng(5)
    far, near = (
        rng.uniform([-1, -1.5, 4.5], [1, -0.5, 5.5], (25, 3)),
        rng.uniform([-0.5, 0.3, 0.9], [0.5, 0.6, 1.3], (9, 3)),
    )
    points, inlier = np.concatenate([far, near]), np.arange(34) < 25
    targets, pixels = reproject(SLOW, far, CAMERA), []
    for _ in range(300):
        T = refined(SLOW, far, targets + rng.normal(0, 0.2, targets.shape), 5.0, CAMERA)
        pixels.append(reproject(T, points, CAMERA))
    covariance = dominant._covariance(SLOW, far, np.full(25, 0.2 * np.sqrt(2 * np.log(2))), CAMERA)
    found = dominant._deviations(SLOW, points, covariance, CAMERA)
    np.testing.assert_allclose(found, np.sqrt(np.var(pixels, axis=0).mean(axis=1)), rtol=0.2)
    assert found[~inlier].min() > 10 * found[inlier].max()


@pytest.mark.parametrize(("columns", "moves"), [((120, 200), False), ((5, 315), True)])
def test_corners_in_a_corner_of_the_image_do_not_tell_what_moves_elsewhere(monkeypatch, columns, moves):
    """The floor before the camera is 10 pixels off the motion that the far side of the room was seen to make."""
    u, v = np.indices(CAMERA.shape)[::-1]
    level = Level(CAMERA, np.where(v < 70, 4 + u / 160, 1.2).astype(np.float32), np.zeros(CAMERA.shape, np.float32))
    rng = np.random.default_rng(4)
    far, floor = rng.integers([columns[0], 5], [columns[1], 65], (50, 2)), rng.integers([5, 80], [310, 230], (60, 2))
    pixels, is_floor = np.concatenate([far, floor]), np.arange(110) >= 50
    targets = pixels + rng.normal(0, 0.2, pixels.shape) + np.where(is_floor[:, None], [0.0, 10.0], 0.0)
    tracked = targets, np.zeros(len(pixels)), np.ones(len(pixels), bool)
    monkeypatch.setattr(dominant, "track_forward_backward", lambda *_: tracked)
    monkeypatch.setattr(dominant, "consistent_with_static", lambda *parts: np.zeros(len(parts[2]), bool))
    points = CAMERA.points(*pixels.T, level.depth[pixels[:, 1], pixels[:, 0]].astype(np.float64))
    view = SimpleNamespace(fine=level, coarse=level, grey=None, corners=pixels, corner_points=points, labelled=level)
    motion = dominant_motion(view, view, (None, None))
    on_floor = motion.before.pixels[:, 1] >= 70
    moving, static = motion.before.moving, motion.before.static
    assert (np.count_nonzero(moving & on_floor) > 40) if moves else (np.count_nonzero(moving & on_floor) < 8)
    assert np.count_nonzero(static & on_floor) < 10
    assert np.count_nonzero(static & ~on_floor) == 50


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
