"""Errors of the first frames of a map."""

from typing import Any

import numpy as np
import pytest

from dudmap import Config
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.lab import synthetic
from registration_errors import measure_first_second

CAMERA = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)
FRAMES = 6


class Turned:
    """The recording with a truth in another world frame, the later poses turned by ``angle_deg`` about the view."""

    def __init__(self, sequence, angle_deg):
        self._sequence = sequence
        poses = np.linalg.inv(sequence.ground_truth.Ts_world_camera[3]) @ sequence.ground_truth.Ts_world_camera
        c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
        poses[1:, :3, :3] = poses[1:, :3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        self.ground_truth = Trajectory(sequence.timestamps, poses)

    def __getattr__(self, name) -> Any:
        return getattr(self._sequence, name)

    def __len__(self):
        return len(self._sequence)

    def __getitem__(self, index):
        return self._sequence[index]


@pytest.fixture(scope="module")
def room():
    return synthetic.sequence("room", movers=(), frames=FRAMES, noise="none", seed=5, camera=CAMERA)


@pytest.fixture(scope="module")
def runs(room):
    return measure_first_second(room, Config(), FRAMES)


def test_an_exact_world_is_tracked_within_a_tenth_of_a_pixel(runs):
    pixel_deg = np.degrees(1 / 262.5)
    for run in runs[:2]:
        assert run.rotation_deg[0] == pytest.approx(0, abs=1e-9)
        assert np.all(run.rotation_deg < 0.3 * pixel_deg), run
        assert np.all(run.translation_mm < 5), run


def test_an_error_is_measured_and_the_world_frame_does_not_matter(room, runs):
    moved: Any = Turned(room, 0.0)
    turned: Any = Turned(room, 1.0)
    same, other = measure_first_second(moved, Config(), 3), measure_first_second(turned, Config(), 3)
    assert same[1].rotation_deg == pytest.approx(runs[1].rotation_deg[:3], abs=1e-6)
    assert other[1].rotation_deg[1:] == pytest.approx(1.0, abs=0.1)
