"""The long corridor is one in which places can be told apart."""

import numpy as np
import pytest

from dudmap.config import Config
from dudmap.core.frames.preprocess import Preprocessor
from dudmap.core.places.place_recognition import KeyframeDatabase
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA
from ring_corridor import ring_corridor

LENGTH, BETWEEN = 60, 1.0
"""Of the walk until it is where it began, and between two keyframes, metres."""


@pytest.fixture(scope="module")
def corridor():
    return ring_corridor(LENGTH, speed=1.0, fps=12, beyond=4, camera=DEFAULT_CAMERA.resized(320, 240))


def test_the_walk_ends_where_it_began(corridor):
    Ts = corridor.ground_truth.Ts_world_camera
    assert np.linalg.norm(Ts[LENGTH * 12, :2, 3] - Ts[0, :2, 3]) < 0.2  # the camera sways
    steps = np.linalg.norm(np.diff(Ts[:, :3, 3], axis=0), axis=1)
    assert 0.07 < steps.min() < steps.max() < 0.11


def test_the_way_back_is_recognised_and_not_mistaken(corridor):
    config, camera = Config(), corridor.camera
    keyframes = KeyframeDatabase(config.relocalization, camera, config.sensor)
    prepared, Ts = Preprocessor(camera, config.preprocess), corridor.ground_truth.Ts_world_camera
    for number in range(0, (LENGTH - 2) * 12, int(BETWEEN * 12)):
        keyframes._frames_since_last = config.relocalization.keyframe_gap
        keyframes.add(prepared(corridor[number]), Ts[number])
    right = wrong = 0
    for number in range((LENGTH + 1) * 12, (LENGTH + 4) * 12, 4):
        matches = keyframes.match(keyframes.extract(prepared(corridor[number])))
        if not matches:
            continue
        off = np.linalg.norm(matches[0].T_world_camera[:3, 3] - Ts[number, :3, 3])
        right, wrong = right + (off < 0.1), wrong + (off > 1)
    assert right >= 5
    assert wrong <= 1
