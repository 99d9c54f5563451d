"""The delay between depth and colour, learnt from a camera that swings in front of a corner of three walls."""

import numpy as np
import pytest

from dudmap.config import TrackerConfig
from dudmap.frames.observation import Level
from dudmap.geometry import se3
from dudmap.mapping.volume import TsdfVolume
from dudmap.tracking.time_offset import MAX_OFFSET, DepthTimeOffset
from dudmap.tracking.tracker import Tracker
from textured_corner import CAMERA, SENSOR, corner, corner_map, level_of, ones

FPS = 30.0


@pytest.fixture(scope="module")
def volume() -> TsdfVolume:
    return corner_map()


def swing(time: float) -> np.ndarray:
    """Twist of the camera at a time: a hand that shakes at half a metre per second and 15 degrees per second."""
    return np.array([0.04, -0.03, 0.02, 0.02, -0.02, 0.01]) * np.sin(12 * time)


def learnt(volume: TsdfVolume, delay: float, spoil=None, frames: int = 20) -> tuple[DepthTimeOffset, list[np.ndarray]]:
    """What is learnt from frames whose depth is of ``delay`` seconds later, and how far off the poses are, twists."""
    tracker, found, errors = Tracker(TrackerConfig(), SENSOR), DepthTimeOffset(), []
    before = se3.exp(swing(0))
    for number in range(1, frames):
        time = number / FPS
        T, level = se3.exp(swing(time)), level_of(corner(swing(time + delay)))
        if spoil is not None:
            level = Level(CAMERA, spoil(level.depth.copy(), number), level.intensity)
        velocity = se3.log(se3.inverse(before) @ T) * FPS
        volume.look_at(T)
        found.learn(tracker, volume, level, T, velocity, ones(level))
        T_depth = found.depth_pose(level, T, velocity)
        errors.append(se3.log(se3.inverse(se3.exp(swing(time + delay))) @ T_depth))
        before = T
    return found, errors


@pytest.mark.parametrize("delay", [-0.02, 0.015])
def test_a_delay_is_learnt(volume, delay):
    found, errors = learnt(volume, delay)
    assert found.seconds == pytest.approx(delay, abs=0.004)
    together = [np.linalg.norm((swing(n / FPS) - swing(n / FPS + delay))[:3]) for n in range(10, 20)]
    alone = [np.linalg.norm(error[:3]) for error in errors[9:]]
    assert np.mean(together) > 0.005
    assert np.mean(alone) < 0.5 * np.mean(together)


def test_images_of_the_same_time_have_no_delay(volume):
    found, _ = learnt(volume, 0.0)
    assert abs(found.seconds) < 0.002


def test_what_moves_on_its_own_is_no_delay(volume):
    """A third of the view creeps away from the camera, 2 mm per frame: a free pose would follow it."""

    def creeping(depth: np.ndarray, number: int) -> np.ndarray:
        depth[:, :27] += np.float32(0.002 * number)
        return depth

    found, _ = learnt(volume, 0.0, creeping)
    assert abs(found.seconds) < 0.006


def test_a_camera_at_rest_and_a_wrong_pose_teach_nothing(volume):
    tracker, found, level = Tracker(TrackerConfig(), SENSOR), DepthTimeOffset(), level_of(corner())
    volume.look_at(np.eye(4))
    nothing = Level(CAMERA, np.zeros_like(level.depth), level.intensity)
    for seen, velocity in ((level, np.zeros(6)), (level, np.full(6, 50.0)), (nothing, np.ones(6))):
        found.learn(tracker, volume, seen, np.eye(4), velocity, ones(level))
        assert found.seconds == 0
    found.seconds = 0.02
    for seen, velocity in ((level, np.zeros(6)), (level, np.full(6, 50.0)), (nothing, np.ones(6))):
        assert np.array_equal(found.depth_pose(seen, np.eye(4), velocity), np.eye(4))


def test_a_delay_has_a_limit(volume):
    found, _ = learnt(volume, 0.2, frames=8)
    assert abs(found.seconds) <= MAX_OFFSET
