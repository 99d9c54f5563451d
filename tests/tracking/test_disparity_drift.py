"""The drift of a warming sensor, learnt from a camera at rest in front of a corner of three walls."""

import numpy as np
import pytest

from dudmap.config import TrackerConfig
from dudmap.frames.depth_correction import DepthCorrection
from dudmap.frames.observation import Level, Observation
from dudmap.frames.pyramid import halved
from dudmap.geometry import se3
from dudmap.kernels.cpu import CpuBackend
from dudmap.mapping.volume import TsdfVolume
from dudmap.tracking.disparity_drift import DisparityDrift
from dudmap.tracking.tracker import Tracker
from textured_corner import CAMERA, SENSOR, corner, corner_map, level_of, ones

CONFIG = TrackerConfig(color_weight=1.0)
"""Intensities that hold the pose: this small corner alone tells a turn from a stretch only badly."""
X = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx


@pytest.fixture(scope="module")
def volume() -> TsdfVolume:
    return corner_map()


def measured(depth: np.ndarray, offset: float, stretch: float) -> np.ndarray:
    """What a sensor reads whose inverse depth is too small by ``offset + stretch x``; 0 stays 0."""
    inverse = 1 / np.maximum(depth.astype(np.float64), 0.1)
    return np.where(depth > 0, 1 / (inverse - offset - stretch * X), 0).astype(np.float32)


def watched(volume, drift, twist=None, noise=0.0, frames=90):
    """The filter and the last pose after frames of a camera displaced by a twist, whose sensor drifts within the first
    half of them to ``drift``."""
    tracker, found, rng = Tracker(CONFIG, SENSOR), DisparityDrift(), np.random.default_rng(3)
    twist = np.zeros(6) if twist is None else twist
    exact, T = level_of(corner(twist)), se3.exp(twist)
    weights = [ones(exact)]
    for number in range(frames):
        share = min(2 * number / frames, 1.0)
        depth = measured(exact.depth, *(share * np.asarray(drift)))
        depth += (noise * depth**2 * rng.standard_normal(depth.shape)).astype(np.float32)
        level = Level(CAMERA, found.correction.depth(depth, CAMERA), exact.intensity)
        T = tracker.align(volume, [level], T, weights, first_level=2).T_world_camera
        found.update(tracker, volume, level, T, weights[0], number / 30)
    return found, T


@pytest.mark.parametrize("drift", [(0.0, 0.012), (-0.01, 0.012)])
def test_a_drift_is_learnt_and_the_pose_stays(volume, drift):
    found, T = watched(volume, drift, noise=0.002)
    assert found.correction.coefficients[0, 0] == pytest.approx(drift[0], abs=0.002)
    assert found.correction.coefficients[1, 0] == pytest.approx(drift[1], abs=0.003)
    tracker, exact = Tracker(CONFIG, SENSOR), level_of(corner())
    level = Level(CAMERA, measured(exact.depth, *drift), exact.intensity)
    without = tracker.align(volume, [level], np.eye(4), [ones(level)], first_level=2).T_world_camera
    assert np.linalg.norm(se3.log(T)) < 0.5 * np.linalg.norm(se3.log(without))


def test_a_steady_sensor_is_not_corrected(volume):
    found, _ = watched(volume, (0.0, 0.0), noise=0.003)
    assert not found.correction
    assert np.all(np.abs(found.state) < 3 * found.sigma)


def test_a_camera_elsewhere_teaches_nothing(volume):
    found, _ = watched(volume, (0.0, 0.012), twist=np.array([0.05, 0.0, 0.0, 0.0, 0.02, 0.0]))
    assert not found.correction
    assert np.array_equal(found.state, np.zeros(2))


def test_a_new_map_takes_the_sensor_as_it_is(volume):
    found, _ = watched(volume, (0.0, 0.012), frames=60)
    assert found.correction
    other, level = corner_map(), level_of(corner())
    other.look_at(np.eye(4))
    found.update(Tracker(CONFIG, SENSOR), other, level, np.eye(4), ones(level), 60 / 30)
    assert found.state == pytest.approx(found.correction.coefficients[:2, 0].tolist(), abs=0.01)
    assert np.all(found.sigma < 1e-3)


def test_the_correction_undoes_the_error_at_every_level():
    frame = corner()
    frame.depth[:5] = 0
    wrong = measured(frame.depth, -0.01, 0.02)
    gray = np.asarray(frame.color[..., 0] / 255, np.float32)
    seen = Observation(0.0, CAMERA, wrong, gray, frame.color, CpuBackend())
    halved(seen, 1)
    corrected = DepthCorrection.linear(-0.01, 0.02).observation(seen)
    np.testing.assert_allclose(corrected.depth, frame.depth, rtol=1e-6)
    true = Observation(0.0, CAMERA, frame.depth, gray, frame.color, CpuBackend())
    depth, expected = halved(corrected, 1)[0], halved(true, 1)[0]
    assert np.array_equal(depth == 0, expected == 0)
    assert np.abs(depth - expected).max() < 5e-4  # the mean of a block is not quite linear in 1 / z
    assert not DepthCorrection()
    assert DepthCorrection.linear(0.0, 1e-4)
