"""The first poses of a map are estimated once more when it has seen enough."""

from typing import Any

import numpy as np
import pytest

from dudmap import Config, Slam
from dudmap.core import young_map
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.lab import synthetic

CAMERA = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)
WINDOW = 15


@pytest.fixture(scope="module")
def room():
    sequence: Any = synthetic.sequence("room", movers=(), frames=25, noise="kinect", seed=3, camera=CAMERA)
    return sequence


def run(room, monkeypatch, window, spoil=lambda slam, index: None, *, live=False):
    """A run of 25 frames whose poses are estimated again after so many, and the poses as they were returned."""
    monkeypatch.setattr(young_map, "WINDOW", window)
    slam, returned = Slam(room.camera, Config(), live=live), []
    for index in range(25):
        spoil(slam, index)
        returned.append(slam.process(room[index]).T_world_camera)
    return slam, np.array(returned)


def errors_mm(room, Ts):
    """Distances (n,) of poses from the true ones, from the first camera."""
    Ts_true = se3.inverse(room.ground_truth.Ts_world_camera[0]) @ room.ground_truth.Ts_world_camera
    return 1000 * np.linalg.norm((se3.inverse(Ts_true[: len(Ts)]) @ Ts)[:, :3, 3], axis=1)


def test_the_poses_of_a_young_map_become_better_and_the_map_follows(room, monkeypatch):
    maps = []
    slam, returned = run(room, monkeypatch, WINDOW, lambda slam, index: maps.append(slam.atlas.volume.map_id))
    assert np.count_nonzero(np.diff(maps[2:])) == 1  # it happens once
    Ts = slam.trajectory.Ts_world_camera
    before, after = (np.sqrt(np.mean(errors_mm(room, poses)[:WINDOW] ** 2)) for poses in (returned, Ts))
    assert after < 0.7 * before
    assert Ts[0] == pytest.approx(np.eye(4), abs=1e-9)
    assert np.array_equal(Ts[WINDOW:], returned[WINDOW:])  # registered to the new map, they need no correction
    history = slam.atlas.history
    assert history is not None
    stored = {frame.timestamp: frame.T_world_camera for frame in history.frames}
    poses = dict(zip(slam.trajectory.timestamps.tolist(), Ts, strict=True))
    assert all(np.allclose(T, poses[stamp], atol=1e-9) for stamp, T in stored.items())
    assert all(np.allclose(one.T_world_camera, poses[one.timestamp]) for one in slam.atlas.keyframes.keyframes)


def test_it_never_happens_to_a_map_that_began_anew(room, monkeypatch):
    slam, returned = run(room, monkeypatch, WINDOW, lambda slam, n: slam.young_map.abandon() if n == 10 else None)
    assert np.array_equal(slam.trajectory.Ts_world_camera, returned)


def test_a_live_camera_does_not_wait_for_it(room, monkeypatch):
    slam, returned = run(room, monkeypatch, WINDOW, live=True)
    assert np.array_equal(slam.trajectory.Ts_world_camera, returned)
    assert slam.young_map.complete_window() == []  # nor are frames kept for it
