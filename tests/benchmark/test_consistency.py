"""The judge of trajectories that needs no truth, in worlds whose truth is known."""

from typing import Any

import numpy as np
import pytest

from dudmap.core.geometry import se3
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError
from dudmap.lab import synthetic
from dudmap.lab.benchmark.consistency import Images, Motion, measure_consistency, pair_misfits

GAPS = 2, 5, 15
CAMERA = Camera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120)


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


def test_the_true_poses_win_over_perturbed_ones_in_depth_and_intensity(monkeypatch):
    """Larger images, whose pixels tell the drift, and each third of them."""
    monkeypatch.setattr("dudmap.lab.benchmark.consistency.PAIRS", 20)
    room: Any = synthetic.sequence("room", frames=60, noise="kinect", seed=5, camera=CAMERA.resized(320, 240))
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


def test_a_rolling_shutter_of_the_depth_is_judged_at_the_times_of_its_rows():
    readout, speed, wall = 0.03, 1.0, 2.0
    tau = readout * ((np.arange(CAMERA.height) + 0.5) / CAMERA.height - 0.5)
    rolling = np.tile((wall - speed * tau)[:, None], (1, CAMERA.width)).astype(np.float32)
    grey = np.full(CAMERA.shape, 0.5, np.float32)
    first, second = Images(CAMERA, rolling, grey), Images(CAMERA, np.full(CAMERA.shape, wall, np.float32), grey)
    forwards, rest = np.array([0, 0, speed, 0, 0, 0.0]), np.zeros(6)
    known, unknown = Calibration(CAMERA, depth_readout=readout), Calibration(CAMERA)
    wanted = 1000 * np.abs(speed * tau).mean() / wall**2
    there = pair_misfits(first, second, [Motion(np.eye(4), (forwards, rest), each) for each in (known, unknown)])
    back = pair_misfits(second, first, [Motion(np.eye(4), (rest, forwards), each) for each in (known, unknown)])
    for found in (there[0], back[0]):
        assert found[0] < 0.01
        assert found[1] == pytest.approx(wanted, rel=0.03)


def test_the_calibration_of_late_colours_with_vignetting_explains_their_intensities():
    late: Any = synthetic.sequence(
        "room", movers=[], frames=60, noise="kinect", seed=5, camera=CAMERA,
        faults={"color_delay": 0.025, "color_readout": 0.02, "vignetting": 0.3},
    )  # fmt: skip
    true = Calibration(CAMERA, delay=0.025, readout=0.02, vignetting=-np.log(0.7))
    poses = {"true": late.ground_truth, "as given": late.ground_truth}
    found = measure_consistency(late, poses, GAPS, calibrations={"true": true})
    assert found.excess(0, 1, 0) == pytest.approx((0, 0, 0), abs=1e-4)
    share, low, _ = found.excess(1, 1, 0)
    assert share > low > 0.2


def test_poses_at_the_stamps_of_late_depth_images_are_judged_when_the_images_were_taken(room):
    true = room.ground_truth
    stamps = Trajectory(true.timestamps - 1 / 30, true.Ts_world_camera)
    found = measure_consistency(
        room, {"late": stamps, "true": true}, GAPS, calibrations={"late": Calibration(CAMERA, depth_late=1 / 30)}
    )
    assert found.excess(0, 0, 1)[0] == pytest.approx(0, abs=0.01)
