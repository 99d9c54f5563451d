"""A system that was stored and read again is the same, attribute by attribute, and goes on with the same results."""

import zlib
from functools import cache

import numpy as np
import pytest

from delayed_color import DELAY, FAULTS, find_early
from dudmap import resume_system, save_system
from dudmap.app.state.database import StateDatabase
from dudmap.app.state.system import parts_of, take_snapshot
from dudmap.config import Config
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.places.pose_graph import Edge
from dudmap.core.slam import Slam
from dudmap.lab import synthetic
from state_differences import differences

SMALL = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)


@cache
def scene(movers=("person",), frames=27):
    sequence = synthetic.sequence("room", movers=movers, frames=frames, camera=SMALL, noise="kinect")
    return sequence, [sequence[index] for index in range(frames)]


def assert_same_results(a, b):
    for field in ("timestamp", "status", "reasons", "fused", "events", "submap"):
        assert getattr(a, field) == getattr(b, field), field
    for field in ("T_world_camera", "dynamic_mask", "residuals"):
        np.testing.assert_array_equal(getattr(a, field), getattr(b, field), err_msg=field)
    assert [(m.id, m.centroid.tolist(), m.velocity.tolist()) for m in a.movers] == [
        (m.id, m.centroid.tolist(), m.velocity.tolist()) for m in b.movers
    ]


def dark(frame):
    return Frame(frame.timestamp, np.zeros_like(frame.depth), np.zeros_like(frame.color))


CASES = {
    "a person": ([], 18, 23, ()),
    "the first moments": ([], 4, 10, ()),
    "objects with meshes": (["movers.meshes=true", "movers.enabled=true"], 18, 23, ()),
    "every frame kept": (["loops.keep_gap=1", "relocalization.keyframe_gap=1", "loops.min_age=0.2"], 18, 23, ()),
    "lost": (["submaps.patience=0.3"], 16, 24, range(12, 18)),
    "several voxel sizes": (["volume.adaptive=true", "volume.adaptive_bend=0.05"], 9, 14, ()),
    "a second submap": (["submaps.patience=0.3"], 23, 27, range(6, 18)),
}
"""Settings, the number of frames before the system is stored and in all, and the frames without light."""


@pytest.mark.parametrize("case", CASES)
def test_a_stored_system_is_the_same_and_goes_on_the_same(tmp_path, case):
    settings, stop, end, unlit = CASES[case]
    movers = ("person", "ball") if "objects" in case else ("person",)
    sequence, frames = scene(movers)
    frames = [dark(frame) if number in unlit else frame for number, frame in enumerate(frames[:end])]
    voxel_size = 0.04 if "voxel sizes" in case else 0.02  # finer ones open where the sensor resolves them
    slam = Slam(sequence.camera, Config().override([*settings, f"volume.voxel_size={voxel_size}"]))
    for frame in frames[:stop]:
        slam.process(frame)
    if "voxel sizes" in case:
        assert slam.volume.levels[0].blocks.num_voxel_blocks > 100
    save_system(slam, tmp_path / "state.db")
    again = resume_system(tmp_path / "state.db")
    assert differences(slam, again) == []
    for frame in frames[stop:]:
        assert_same_results(slam.process(frame), again.process(frame))
    mesh, other = slam.volume.extract_mesh(), again.volume.extract_mesh()
    for name in ("vertices", "faces", "colors", "normals"):
        np.testing.assert_array_equal(getattr(mesh, name), getattr(other, name))


def test_a_system_that_calibrates_itself_is_stored_after_every_frame(tmp_path, monkeypatch):
    """The colours of the recording are late: what is kept of a frame has levels whose colours nobody has needed yet."""
    find_early(monkeypatch, (4,))
    sequence = synthetic.sequence("room", movers=("person",), frames=14, camera=SMALL, camera_path="fast",
                                  faults=FAULTS)  # fmt: skip
    settings = [
        "volume.voxel_size=0.02",
        "dynamics.start_seconds=0.1",
        "tracker.widths=[40, 80, 160]",
        "dynamics.width=80",
    ]
    slam, calibrated = Slam(sequence.camera, Config().override(settings)), []
    again = slam
    for index in range(len(sequence)):
        frame = dark(sequence[index]) if index in (9, 10) else sequence[index]
        result = slam.process(frame)
        if again is not slam:
            assert_same_results(result, again.process(frame))
        assert (result.status == "lost") == (index in (9, 10))
        calibrated.append("calibrated" in result.events)
        save_system(slam, tmp_path / "state.db")
        again = resume_system(tmp_path / "state.db")
        assert differences(slam, again) == []
    assert sum(calibrated) == 1
    assert slam.calibration.delay == DELAY


def test_what_a_snapshot_does_not_copy_never_changes(tmp_path):
    """Arrays of frozen classes are written by another thread while the next frames are processed."""
    sequence = synthetic.sequence("room", movers=("person", "ball"), frames=20, camera=SMALL, camera_path="fast",
                                  faults=FAULTS)  # fmt: skip
    config = Config().override(["movers.meshes=true", "volume.voxel_size=0.02", "submaps.patience=0.2"])
    slam, database, taken = Slam(sequence.camera, config), StateDatabase(tmp_path / "state.db"), []
    for index in range(len(sequence)):
        slam.process(dark(sequence[index]) if 12 <= index < 15 else sequence[index])
        snapshot = take_snapshot(parts_of(slam), database)
        taken += [(array, zlib.crc32(array.copy())) for array in map(snapshot.arrays.__getitem__, snapshot.constant)]
    assert len(taken) > 500
    assert all(zlib.crc32(array.copy()) == before for array, before in taken)


def test_a_map_that_is_being_rebuilt_goes_on_being_rebuilt(tmp_path, monkeypatch):
    """A loop says that the camera is 3 mm farther; the map of the 18 frames stored is rebuilt over the next 14."""
    for module in ("atlas", "loop_correction"):
        monkeypatch.setattr(f"dudmap.core.places.{module}.MAX_IMMEDIATE", 4)
    monkeypatch.setattr(
        "dudmap.core.places.loop_correction._is_worse", lambda after, before, unit: False
    )  # there was no loop
    sequence, frames = scene(movers=(), frames=36)
    settings = ["loops.keep_gap=1", "loops.min_age=100", "volume.voxel_size=0.02"]
    slam = Slam(sequence.camera, Config().override(settings))
    for frame in frames[:18]:
        slam.process(frame)
    Ts = [frame.T_world_camera for frame in slam.atlas.history.frames]
    farther = se3.exp(np.array([0, 0, 0.003, 0, 0, 0]))
    last = len(Ts) - 1
    edge = Edge(0, last, farther @ se3.inverse(Ts[0]) @ Ts[last], 0.005, 0.003)
    correction = slam.loops.corrector.correct(edge)
    assert correction is not None
    slam.motion.apply_correction(correction)
    for frame in frames[18:22]:
        slam.process(frame)
    assert len(slam.atlas.rebuildings[0].missing) > 6
    save_system(slam, tmp_path / "state.db")
    again = resume_system(tmp_path / "state.db")
    assert differences(slam, again) == []
    for frame in frames[22:]:
        assert_same_results(slam.process(frame), again.process(frame))
    assert not slam.atlas.rebuildings
    mesh, other = slam.volume.extract_mesh(), again.volume.extract_mesh()
    for name in ("vertices", "faces", "colors", "normals"):
        np.testing.assert_array_equal(getattr(mesh, name), getattr(other, name))
