"""Background behind pixels without a reading: points carried from image to image against plain geometry."""

import numpy as np
import pytest

from dudmap.config import DynamicsConfig
from dudmap.core.dynamics.temporal_memory import BackgroundModel
from dudmap.core.frames.observation import Level
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera

CAMERA = Camera(131, 131, 79.5, 59.5, 160, 120)
V, U = np.indices(CAMERA.shape)
STILL = np.zeros(CAMERA.shape, bool)


def wall(T: np.ndarray) -> Level:
    """A smoothly shaded wall at z = 2 m, seen from a pose."""
    rays = np.stack([(U - CAMERA.cx) / CAMERA.fx, (V - CAMERA.cy) / CAMERA.fy, np.ones(U.shape)], -1) @ T[:3, :3].T
    depth = (2 - T[2, 3]) / rays[..., 2]
    x, y = (rays * depth[..., None] + T[:3, 3])[..., :2].transpose(2, 0, 1)
    shade = 0.5 + 0.2 * np.sin(3 * x) * np.cos(2 * y)
    return Level(CAMERA, depth.astype(np.float32), shade.astype(np.float32))


def pose(i: int) -> np.ndarray:
    return se3.exp(np.array([0.004, 0.002, 0.001, 0.0005, -0.001, 0.002]) * i)


def seen(frames: int) -> BackgroundModel:
    background = BackgroundModel(DynamicsConfig(settle_time=1.0))
    for i in range(frames):
        assert not background.hidden(i / 30, wall(pose(i)), pose(i)).any()
        background.update(i / 30, wall(pose(i)), pose(i), STILL)
    return background


def with_hole(i: int, shade: float | None) -> tuple[Level, np.ndarray]:
    """The wall behind a disc without readings, of one shade or transparent."""
    level = wall(pose(i))
    disc = np.hypot(U - 70 - i / 2, V - 60) < 22
    intensity = level.intensity if shade is None else np.where(disc, np.float32(shade), level.intensity)
    return Level(CAMERA, np.where(disc, np.float32(0), level.depth), intensity.astype(np.float32)), disc


@pytest.mark.parametrize("shade", [0.05, 0.95, None])
def test_a_hole_hides_the_wall_if_it_looks_unlike_it(shade):
    background = seen(15)
    for i in range(15, 35):
        level, disc = with_hole(i, shade)
        hidden = background.hidden(i / 30, level, pose(i))
        background.update(i / 30, level, pose(i), STILL)
        assert not hidden[~disc].any()
        assert hidden[disc].mean() > 0.85 if shade else not hidden.any()
    # what has not been read for the settle time is not known any more
    assert not background.hidden(3.0, level, pose(34)).any()


def test_what_was_seen_for_a_moment_or_in_another_world_is_no_background():
    level, _ = with_hole(5, 0.05)
    passing = seen(5)
    assert not passing.hidden(5 / 30, level, pose(5)).any()
    background = seen(15)
    background.reset()
    assert not background.hidden(0.5, level, pose(5)).any()


def test_the_background_follows_a_correction_of_the_world():
    correction = se3.exp(np.array([0.3, -0.1, 0.2, 0.0, 0.1, 0.05]))
    (level, disc), background, expected = with_hole(15, 0.05), seen(15), seen(15)
    background.apply_correction(correction)
    hidden = background.hidden(0.5, level, correction @ pose(15))
    assert hidden[disc].mean() > 0.85
    assert (hidden == expected.hidden(0.5, level, pose(15))).mean() > 0.999
    assert not background.hidden(0.5, level, pose(15))[disc].all()


def test_a_seam_is_not_hidden():
    """The sky above a wall: its edge wanders by a pixel or two."""
    background = seen(15)
    level = wall(pose(15))
    seam = (V >= 50) & (V < 54)
    sky = Level(CAMERA, np.where(seam, np.float32(0), level.depth), np.where(seam, np.float32(1), level.intensity))
    assert not background.hidden(0.5, sky, pose(15)).any()


def test_what_moved_is_no_background():
    background = BackgroundModel(DynamicsConfig())
    for i in range(15):
        background.hidden(i / 30, wall(pose(i)), pose(i))
        background.update(i / 30, wall(pose(i)), pose(i), ~STILL)
    assert not background.hidden(0.5, with_hole(15, 0.05)[0], pose(15)).any()


def test_images_of_any_size_are_subsampled():
    """Label images 120x67, as of cameras of 960x540 and 480x270, and finer and coarser ones."""
    for camera in (CAMERA.resized(120, 67), CAMERA.resized(53, 41), CAMERA.resized(321, 243)):
        background = BackgroundModel(DynamicsConfig(settle_time=1.0))
        board = Level(camera, np.full(camera.shape, 2, np.float32), np.full(camera.shape, 0.5, np.float32))
        for i in range(15):
            background.update(i / 30, board, np.eye(4), np.zeros(camera.shape, bool))
        hole = np.zeros(camera.shape, bool)
        hole[camera.height // 4 : camera.height * 3 // 4, camera.width // 4 : camera.width * 3 // 4] = True
        dark = Level(camera, np.where(hole, np.float32(0), board.depth), np.where(hole, np.float32(0), board.intensity))
        hidden = background.hidden(0.5, dark, np.eye(4))
        assert not hidden[~hole].any()
        assert hidden[hole].mean() > 0.85
