"""Stored frames that were removed: a system that goes on from a checkpoint, and the room in its database."""

import numpy as np
import pytest

from dudmap import resume_system, save_system
from dudmap.app.state.database import StateDatabase, StateReader
from dudmap.app.state.system import take_snapshot
from dudmap.config import Config
from dudmap.core.geometry.camera import Camera
from dudmap.core.places import frame_thinning
from dudmap.core.slam import Slam
from dudmap.lab import synthetic
from state_differences import differences

SMALL = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)
SETTINGS = [
    "loops.keep_gap=1", "volume.max_readings=3", "similarity.threshold=0.5", "similarity.max_translation=1e-9",
    "dynamics.start_seconds=0",
]  # fmt: skip


@pytest.fixture
def slam(monkeypatch):
    """A system whose camera stays: every frame is stored, and replaced by the ten that follow."""
    monkeypatch.setattr(frame_thinning, "MIN_KEPT", 4)
    return Slam(SMALL, Config().override(SETTINGS))


@pytest.fixture(scope="module")
def frames():
    sequence = synthetic.sequence("room", movers=(), frames=40, camera=SMALL, camera_path="still", noise="kinect")
    return [sequence[index] for index in range(len(sequence))]


def content(store):
    return {number: store.encoded(number) for number in store.kept}


def test_a_system_with_removed_frames_goes_on_the_same(slam, frames, tmp_path):
    for frame in frames[:25]:
        slam.process(frame)
    store = slam.atlas.history
    assert len(store.kept) <= len(store) - 3
    save_system(slam, tmp_path / "state.db")
    again = resume_system(tmp_path / "state.db")
    other = again.atlas.history
    assert content(other) == content(store)
    for frame in frames[25:]:
        slam.process(frame)
        again.process(frame)
    assert other.kept == store.kept
    assert len(store.kept) < len(store) - 10
    assert content(other) == content(store)
    assert differences(slam, again) == []


def test_the_database_uses_the_room_of_removed_frames_again(slam, frames, tmp_path):
    database = StateDatabase(tmp_path / "state.db")
    sizes, numbers = [], []
    for number, frame in enumerate(frames):
        slam.process(frame)
        if number % 4:
            continue
        database.write(take_snapshot({"slam": slam}, database), {})
        reader = StateReader(tmp_path / "state.db")
        store = slam.atlas.history
        assert reader.frames(0) == store.kept
        assert {n: reader.frame(0, n) for n in store.kept} == content(store)
        reader.close()
        sizes.append(sum(len(part) for parts in content(store).values() for part in parts))
        numbers.append(len(store.kept))
    assert len(store.kept) < len(store) - 10
    database.close()
    np.testing.assert_array_less(numbers, 25)
