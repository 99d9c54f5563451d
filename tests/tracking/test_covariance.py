"""The covariance of a pose against errors in rendered worlds, and along directions that a view does not show."""

import numpy as np
import pytest

from dudmap import Camera, Config, Slam
from dudmap.config import SensorConfig, TrackerConfig, VolumeConfig
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import Level
from dudmap.core.geometry import se3
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.tracking.tracker import Tracker
from dudmap.lab import synthetic

CAMERA = Camera(262.5, 262.5, 159.5, 119.5, 320, 240)
MEDIAN = 5.35
"""Median of chi-square with 6 degrees of freedom."""


def error(T_a, T_b, T_true):
    """Error (6,) of the motion from a to b, about the centre of b in world axes, against the true motion (4, 4)."""
    T_expected = T_a @ T_true
    return np.concatenate([T_b[:3, 3] - T_expected[:3, 3], se3.log_rotation(T_b[:3, :3] @ T_expected[:3, :3].T)])


@pytest.mark.parametrize(("scene", "noise", "seed"), [("room", "kinect", 11), ("room", "realsense", 12)])
def test_errors_of_the_motion_between_frames_have_the_covariance(scene, noise, seed):
    sequence = synthetic.sequence(scene, movers=(), frames=30, camera=CAMERA, noise=noise, seed=seed)
    slam = Slam(CAMERA, Config().override(["sensor.self_calibration=false"]))
    results = [slam.process(sequence[index]) for index in range(30)]
    truth, squares = sequence.ground_truth.Ts_world_camera, []
    for n in range(6, 29):
        (a, b), T_true = results[n : n + 2], se3.inverse(truth[n]) @ truth[n + 1]
        carried = np.eye(6)
        carried[:3, 3:] = -se3.hat((b.T_world_camera - a.T_world_camera)[:3, 3])  # a rotation at a moves b
        e = error(a.T_world_camera, b.T_world_camera, T_true)
        squares.append(e @ np.linalg.solve(carried @ a.covariance @ carried.T + b.covariance, e))
    assert 0.25 < np.median(squares) / MEDIAN < 4


def test_unobserved_directions_have_the_variance_of_the_prediction():
    """A wall without texture shows its distance and two rotations."""
    camera = Camera(80, 80, 39.5, 29.5, 80, 60)
    flat = Frame(0.0, np.full(camera.shape, 1.5, np.float32), np.full((*camera.shape, 3), 120, np.uint8))
    volume = TsdfVolume(camera, VolumeConfig(voxel_size=0.02, truncation_noise=0), SensorConfig(), depth_max=4.0)
    for _ in range(3):
        volume.integrate(flat, np.eye(4))
    level = Level(camera, flat.depth + np.float32(0.002), np.full(camera.shape, 120 / 255, np.float32))
    found = Tracker(TrackerConfig(widths=(80,), iterations=(5,)), SensorConfig()).align(volume, [level], np.eye(4))
    sigma = np.sqrt(np.diag(found.covariance_with(0.05)))
    np.testing.assert_allclose(sigma[[0, 1, 5]], 0.05, rtol=1e-3)
    assert (sigma[2:5] < 0.005).all()
    assert np.abs(found.covariance_with(0.0)[[0, 1, 5]]).max() < 1e-12
