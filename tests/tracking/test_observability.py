"""Directions of motion that a view does not determine, on scenes where they are known."""

import numpy as np
import pytest

from dudmap.config import Config
from dudmap.core.formulas.damping import damped_step
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import Pyramid
from dudmap.core.frames.preprocess import Preprocessor
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.slam import Slam
from dudmap.core.tracking.checks import MAX_DRIFT
from dudmap.core.tracking.motion_model import MotionModel
from dudmap.core.tracking.observability import INTENSITY_SIGMA, GradientNoise, gradient_noise, unobserved_motion
from dudmap.core.tracking.tracker import COLOR_HUBER, Tracker

CAMERA = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)
V, U = np.mgrid[: CAMERA.height, : CAMERA.width]
X, Y = (U - CAMERA.cx) / CAMERA.fx, (V - CAMERA.cy) / CAMERA.fy
FILTER_PX = 4.0
CONFIG = Config().override(["volume.voxel_size=0.03"])  # wider than a pixel on the farthest surfaces that count


def wall(offset):
    """Depth of a wall 1.5 m ahead, seen from ``offset`` (3,) metres."""
    return np.full(CAMERA.shape, 1.5 - offset[2])


def tunnel(offset):
    """Depth of an endless tunnel, 1.2 m wide and 1 m high."""
    with np.errstate(divide="ignore"):
        across = np.where(X > 0, 0.6 - offset[0], 0.6 + offset[0]) / np.abs(X)
        down = np.where(Y > 0, 0.5 - offset[1], 0.5 + offset[1]) / np.abs(Y)
    depth = np.minimum(across, down)
    return np.where(depth < CONFIG.preprocess.depth_max, depth, 0)


def corner(offset):
    """Depth of three walls that meet."""
    return 1 / np.maximum.reduce([np.full(CAMERA.shape, 1 / (2 - offset[2])), X / 0.5, Y / 0.4])


def grey(points):
    return np.full(points.shape[:2], 120.0)


def waves(points):
    """Texture of a wall, fixed to the world."""
    x, y = points[..., 0], points[..., 1]
    return 120 + 40 * np.sin(20 * x) + 40 * np.sin(17 * y + 1) + 20 * np.sin(9 * x + 14 * y)


def frame(scene, texture, rng, offset=(0.0, 0.0, 0.0)):
    """Noisy image of a scene from a place (3,), after the filter."""
    exact = scene(np.array(offset))
    depth = np.where(exact > 0, exact + rng.normal(size=exact.shape) * CONFIG.sensor.sigma(exact), 0)
    points = np.stack([X * exact, Y * exact, exact], axis=-1) + np.array(offset)
    color = texture(points)[..., None] + rng.normal(0, 2, (*CAMERA.shape, 3))
    shot = Frame(0.0, depth.astype(np.float32), np.clip(np.rint(color), 0, 255).astype(np.uint8))
    return Preprocessor(CAMERA, CONFIG.preprocess)(shot)


def registered(scene, texture, offset, seed=0):
    """Registration of a view from ``offset`` to a map of three views from the origin."""
    rng = np.random.default_rng(seed)
    volume = TsdfVolume(CAMERA, CONFIG.volume, CONFIG.sensor, CONFIG.preprocess.depth_max)
    for _ in range(3):
        volume.integrate(frame(scene, texture, rng).as_recorded, np.eye(4))
    levels = Pyramid.of(frame(scene, texture, rng, offset), CAMERA, CONFIG).tracked
    return Tracker(CONFIG.tracker, CONFIG.sensor).align(volume, levels, np.eye(4))


def spans(found, expected):
    """Whether two sets of directions (k, 6) span the same space, to within 10 degrees."""
    a, b = np.linalg.qr(found.T)[0], np.linalg.qr(np.array(expected, float).T)[0]
    return a.shape == b.shape and np.linalg.svd(a.T @ b)[1].min() > np.cos(np.radians(10))


@pytest.mark.parametrize("seed", [0, 1])
def test_a_wall_without_texture_leaves_two_translations_and_one_rotation(seed):
    result = registered(wall, grey, (0.02, -0.01, 0.015), seed)
    assert result.accepted
    assert spans(result.unobservable, np.eye(6)[[0, 1, 5]])
    found = se3.log(result.T_world_camera)
    assert abs(found[2] - 0.015) < 0.002
    assert np.abs(found[[0, 1]]).max() < 0.001
    assert abs(found[5]) < 0.001


@pytest.mark.parametrize("seed", [0, 1])
def test_a_tunnel_without_texture_leaves_the_way_ahead(seed):
    result = registered(tunnel, grey, (0.01, 0.02, 0.03), seed)
    assert result.accepted
    assert spans(result.unobservable, np.eye(6)[[2]])
    found = se3.log(result.T_world_camera)
    assert np.abs(found[:2] - (0.01, 0.02)).max() < 0.003
    assert abs(found[2]) < 0.002


@pytest.mark.parametrize(("scene", "texture"), [(wall, waves), (corner, grey), (corner, waves)])
def test_texture_or_shape_determine_the_pose(scene, texture):
    result = registered(scene, texture, (0.0, 0.0, 0.01) if scene is wall else (0.0, 0.0, 0.0))
    assert result.accepted
    assert result.unobservable.shape == (0, 6)


def test_truncated_step_leaves_the_free_direction_alone():
    rng = np.random.default_rng(3)
    J = rng.normal(size=(50, 6))
    free = np.array([0.3, -0.5, 0.2, 0.1, 0.6, -0.4])
    J -= np.outer(J @ free, free) / (free @ free)
    noise = np.eye(6) * 0.01
    R = se3.exp_rotation(np.array([0.3, 0.2, -0.5]))
    H = J.T @ J + noise
    seen = GradientNoise(noise, np.zeros((6, 6)), (1.0, 0.0), 1.0).observability(H, H, R, 4.0)
    assert spans(seen.unobservable @ np.kron(np.eye(2), R).T, free[None])
    b = rng.normal(size=6)
    assert abs(damped_step(J.T @ J, b, seen.observable, 0.0) @ free) < 1e-9


def test_the_noise_is_that_of_the_configured_filter():
    for setting, width in (("filter_sigma_px=2", 2.0), ("filter=none", 0.0)):
        slam = Slam(CAMERA, CONFIG.override([f"preprocess.{setting}"]))
        assert slam.tracker.filter_px == slam.front_end.blind_tracker.filter_px == width


def test_noise_is_the_sum_over_the_readings():
    rng, config = np.random.default_rng(4), Config()
    level = Pyramid.of(frame(corner, grey, rng), CAMERA, config).tracked[0]
    shape = level.depth.shape
    residuals = rng.normal(0, [[[0.02]], [[0.1]]], (2, *shape)).astype(np.float32)
    residuals[:, rng.random(shape) < 0.1] = np.nan
    weights = rng.random(shape).astype(np.float32)
    volume = TsdfVolume(CAMERA, CONFIG.volume, config.sensor, 6.0)
    R = se3.exp_rotation(np.array([0.4, -0.3, 0.2]))
    parameters = Tracker(config.tracker, config.sensor).parameters(volume.band)
    found = gradient_noise(
        level, residuals, weights, R, 0.03, CAMERA.width, FILTER_PX, parameters, np.zeros((6, 6)), 1.0
    )
    distances, intensities, total = np.zeros((6, 6)), np.zeros((6, 6)), 0.0
    stride, t, scale = level.camera.width // 40, config.tracker, level.camera.width / CAMERA.width
    for v in range(stride // 2, shape[0], stride):
        for u in range(stride // 2, shape[1], stride):
            if np.isnan(residuals[1, v, u]):
                continue
            z, pixel = float(level.depth[v, u]), float(level.depth[v, u]) / level.camera.fx
            p = R @ [(u - level.camera.cx) * pixel, (v - level.camera.cy) * pixel, z]
            J = np.hstack([np.eye(3), -se3.hat(p)])
            ratio = min(config.sensor.sigma(1.0) / config.sensor.sigma(z), 1)
            a, c = abs(residuals[:, v, u].astype(float)) * (ratio, 1)
            w = weights[v, u] * ratio**2
            w *= t.huber / max(a, t.huber)
            around = level.depth[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2].astype(float)
            middle = min(v, 1), min(u, 1)
            step = np.hypot(np.ptp(around[:, middle[1]][[0, -1]]), np.ptp(around[middle[0]][[0, -1]])) / 2
            step = min(step, 9.5 * pixel) * scale
            width = np.hypot(FILTER_PX * scale * pixel, 0.015)
            variance = (config.sensor.sigma(z) * pixel) ** 2 / (8 * np.pi * width**4)
            variance += 2 * (2 / 3) ** 2 * step**2 / 12 / 0.03**2
            distances += stride**2 * w * variance * J.T @ J
            total += w * variance
            shade = t.color_weight * weights[v, u] * COLOR_HUBER / max(c, COLOR_HUBER)
            intensities += stride**2 * shade * 2 * (2 / 3) ** 2 * (INTENSITY_SIGMA / 0.03) ** 2 * J.T @ J
    assert total > 0
    np.testing.assert_allclose(found.distances, distances, rtol=1e-3, atol=1e-4 * distances.max())
    np.testing.assert_allclose(found.intensities, intensities, rtol=1e-3, atol=1e-4 * intensities.max())


def test_sentence_names_the_directions():
    assert unobserved_motion(np.empty((0, 6))) == ""
    assert "forwards" in unobserved_motion(np.eye(6)[[2]])


def test_a_predicted_pose_is_not_trusted_for_long():
    motion = MotionModel(CONFIG.tracker)
    motion.update(10.0, np.eye(4))
    motion.update(10.1, np.eye(4), observed=False)
    assert motion.drift(10.2) < MAX_DRIFT
    late = 10.0 + np.sqrt(2 * MAX_DRIFT) + 0.01
    assert motion.drift(late) > MAX_DRIFT
    motion.update(late, np.eye(4))
    assert motion.drift(late + 0.1) < MAX_DRIFT
