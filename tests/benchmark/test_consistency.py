"""The judge of trajectories that needs no truth, in worlds whose truth is known."""

from typing import Any

import numpy as np
import pytest

from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError
from dudmap.lab import synthetic
from dudmap.lab.benchmark.consistency import measure_consistency

GAPS = 2, 5, 15
CAMERA = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)


@pytest.fixture(scope="module")
def room():
    sequence: Any = synthetic.sequence("room", frames=60, noise="kinect", seed=5, camera=CAMERA)
    return sequence


def moved(trajectory, sigma, seed):
    """The trajectory with independent errors of its positions, metres."""
    Ts = trajectory.Ts_world_camera.copy()
    Ts[:, :3, 3] += np.random.default_rng(seed).normal(0, sigma, (len(Ts), 3))
    return Trajectory(trajectory.timestamps, Ts)


def drifting(trajectory, metres):
    """The trajectory with a smooth error: the camera is believed to move too far by so much over the recording."""
    Ts = trajectory.Ts_world_camera.copy()
    Ts[:, 0, 3] += np.linspace(0, metres, len(Ts))
    return Trajectory(trajectory.timestamps, Ts)


def test_the_true_poses_win_over_perturbed_ones_in_depth_and_intensity(room):
    true = room.ground_truth
    found = measure_consistency(
        room, {"noisy": moved(true, 0.004, 0), "true": true, "drifting": drifting(true, 0.04)}, GAPS
    )
    for term in (0, 1):
        for other in (0, 2):
            share, low, high = found.excess(term, other, 1)
            assert 0 < low <= share <= high, (term, other, share, low, high)
    verdicts = found.verdicts()
    assert len(verdicts) == 4
    assert all("is worse than true" in sentence for sentence in verdicts)


def test_equally_good_ones_are_undecided(room):
    true = room.ground_truth
    elsewhere = Trajectory(true.timestamps, se3.exp(np.array([1, 2, 3, 0.1, 0.2, 0.3])) @ true.Ts_world_camera)
    poses = {"one": moved(true, 0.002, 1), "other": moved(true, 0.002, 2), "true": true, "elsewhere": elsewhere}
    found = measure_consistency(room, poses, GAPS)
    for term in (0, 1):
        _, low, high = found.excess(term, 0, 1)
        assert low < 0 < high
        assert found.excess(term, 2, 3) == pytest.approx((0, 0, 0), abs=1e-6)
    assert sum("true and elsewhere are undecided" in s or "elsewhere and true are" in s for s in found.verdicts()) == 2


def test_a_trajectory_of_another_recording_is_refused(room):
    true = room.ground_truth
    with pytest.raises(DatasetError, match="0 frames in common"):
        measure_consistency(room, {"other": Trajectory(true.timestamps + 1000, true.Ts_world_camera)})
