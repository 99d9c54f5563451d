"""A camera that rests and goes on in large steps, as on a robot's arm: no frame is lost, and no pose is wrong."""

import numpy as np
import pytest

from dudmap import Slam
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.lab import synthetic

CAMERA = Camera(262.5, 262.5, 159.5, 119.5, 320, 240)
REST, STEPS, INTERVAL = 3, 10, 0.5


def arm_path(path, seed, turn_deg, step):
    """Writes a trajectory of rests and steps of so many degrees and metres."""
    T = synthetic.sequence("room", movers=(), frames=1, camera=CAMERA, seed=seed).ground_truth.Ts_world_camera[0]
    rng, out, side = np.random.default_rng(seed), [T] * REST, 1
    for number in range(STEPS):
        if number % 3 == 2:
            side = -side  # to and fro, so that the arm stays in its place
        direction = rng.normal(size=3) * (1, 0.3, 0.5)
        xi = np.append(step * direction / np.linalg.norm(direction), np.radians(turn_deg) * np.array([0.1, 0.99, 0]))
        T = T @ se3.exp(xi * (1, 1, 1, side, side, side))
        out += [T] * REST
    Trajectory(INTERVAL * np.arange(len(out)), np.array(out)).save(path)
    return len(out)


@pytest.mark.parametrize(
    ("turn_deg", "step", "seed", "timed"),
    [(8.0, 0.08, 1, True), (12.0, 0.1, 4, False), (16.0, 0.08, 4, True), (3.0, 0.15, 1, False)],
)
def test_no_frame_is_lost_between_the_rests_of_an_arm(tmp_path, turn_deg, step, seed, timed):
    count = arm_path(tmp_path / "arm.txt", seed, turn_deg, step)
    room = synthetic.sequence(
        "room", movers=(), frames=count, fps=1 / INTERVAL, camera_path=tmp_path / "arm.txt", camera=CAMERA, seed=seed
    )
    slam, truth = Slam(CAMERA, timed=timed), room.ground_truth.Ts_world_camera
    results = [slam.process(room[number]) for number in range(count)]
    assert [(n, result.verdict.reason) for n, result in enumerate(results) if result.status == "lost"] == []
    for result, T in zip(results, truth, strict=True):
        D = se3.inverse(se3.inverse(truth[0]) @ T) @ result.T_world_camera
        assert np.linalg.norm(D[:3, 3]) < 0.03
        assert np.degrees(se3.rotation_angle(D)) < 1.5
