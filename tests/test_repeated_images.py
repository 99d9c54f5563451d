"""Frames that repeat the one before, or its depth: they have poses, and are told from lost ones."""

from dataclasses import replace

import numpy as np
import pytest

from dudmap import Config, Slam
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.lab import synthetic

CAMERA = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)
CONFIG = Config().override(["volume.voxel_size=0.02", "sensor.self_calibration=false"])


@pytest.fixture(scope="module")
def recording():
    room = synthetic.sequence("room", movers=(), frames=16, fps=15, camera=CAMERA, noise="kinect", seed=3)
    return [room[index] for index in range(len(room))], room.ground_truth.Ts_world_camera


def off(trajectory, timestamps, truth):
    """Distance (n,) of the poses at these times from the true ones."""
    rows = np.searchsorted(trajectory.timestamps, timestamps)
    assert np.allclose(trajectory.timestamps[rows], timestamps)
    expected = se3.inverse(truth[0]) @ truth
    return np.linalg.norm((trajectory.Ts_world_camera[rows] - expected)[:, :3, 3], axis=1)


def test_a_repeated_frame_has_the_pose_of_the_one_it_repeats(recording):
    frames, _ = recording
    slam, results = Slam(CAMERA, CONFIG), []
    for frame in frames[:8]:
        results.append(slam.process(frame))
        results.append(slam.process(replace(frame, timestamp=frame.timestamp + 1 / 30)))
    assert [result.status for result in results] == ["tracked", "repeated"] * 8
    assert not any(result.fused or "redundant" in result.verdict for result in results[1::2])
    for first, again in zip(results[::2], results[1::2], strict=True):
        assert "frame_repeats" in again.verdict
        assert np.array_equal(first.T_world_camera, again.T_world_camera)
        assert np.array_equal(first.dynamic_mask, again.dynamic_mask)
    assert len(slam.trajectory) == 16
    plain = Slam(CAMERA, CONFIG)
    expected = [plain.process(frame).T_world_camera for frame in frames[:8]]
    assert np.array_equal(slam.trajectory.Ts_world_camera[::2], np.stack(expected))  # repeats change no result


def test_where_depth_alone_repeats_the_pose_is_interpolated(recording):
    frames, truth = recording
    late = [replace(frames[k], depth=frames[k - k % 2].depth) for k in range(len(frames))]
    slam = Slam(CAMERA, CONFIG)
    results = [slam.process(frame) for frame in late]
    assert ["depth_repeats" in result.verdict for result in results] == [False, True] * 8
    assert [result.status for result in results] == ["tracked", "repeated"] * 8
    assert all(
        np.trace(b.covariance) > np.trace(a.covariance) for a, b in zip(results[::2], results[1::2], strict=True)
    )
    errors = off(slam.trajectory, [frame.timestamp for frame in frames], truth)
    step = np.median(np.linalg.norm(np.diff(truth[::2, :3, 3], axis=0), axis=1))
    assert errors[2:-1].max() < 0.15 * np.linalg.norm(truth[-1, :3, 3] - truth[0, :3, 3]), errors
    assert np.median(errors[3:-1:2]) < np.median(errors[2:-1:2]) + 0.25 * step  # as good as the tracked ones beside


@pytest.mark.parametrize("what", [{"depth"}, {"depth", "color"}])
def test_a_sensor_that_hangs_is_not_believed_for_long(recording, what):
    frames, _ = recording
    slam = Slam(CAMERA, CONFIG)
    for frame in frames[:4]:
        assert slam.process(frame).status == "tracked"
    old = {name: getattr(frames[3], name) for name in what}
    frozen = [slam.process(replace(frame, **old)) for frame in frames[4:12]]
    states = [result.status for result in frozen]
    assert states == sorted(states, reverse=True)  # repeated first, lost then
    assert set(states) == {"repeated", "lost"}
    assert "the sensor hangs" in frozen[-1].reasons[0]
    assert slam.process(replace(frames[11], timestamp=frames[11].timestamp + 0.03, **old)).status == "lost"
    assert slam.process(frames[12]).status == "tracked"


def test_a_frame_that_arrives_twice_with_one_stamp_has_one_pose(recording):
    frames, _ = recording
    slam = Slam(CAMERA, CONFIG)
    results = [slam.process(frame) for frame in (frames[0], frames[1], frames[1])]
    results.append(slam.process(replace(frames[1], timestamp=frames[1].timestamp + 1 / 30)))
    assert ["duplicate" in result.verdict for result in results] == [False, False, True, False]
    assert [result.status for result in results] == ["tracked", "tracked", "rejected", "repeated"]
    assert len(slam.trajectory) == 3


def test_a_frame_that_repeats_a_lost_one_is_lost(recording):
    frames, _ = recording
    slam = Slam(CAMERA, CONFIG)
    slam.process(frames[0])
    dark = replace(frames[1], depth=np.where(frames[1].depth > 0, np.float32(0.25), 0).astype(np.float32))
    first = slam.process(dark)
    again = slam.process(replace(dark, timestamp=dark.timestamp + 1 / 30))
    assert first.status == again.status == "lost"
    assert again.reasons[0] == first.reasons[0]
    assert "frame_repeats" in again.verdict
    assert len(slam.trajectory) == 1
