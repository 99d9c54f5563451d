"""The whole algorithm on small synthetic recordings: accuracy, loss, redundancy, switches, determinism."""

import hashlib
import os
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dudmap.config import Config
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.slam import Slam
from dudmap.errors import ConfigError, FrameError
from dudmap.lab import synthetic
from off_course import LIMIT, off_course

SMALL = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)
FRAMES = 24


@pytest.fixture(scope="module")
def recording():
    sequence = synthetic.sequence("room", movers=(), frames=FRAMES, camera=SMALL, camera_path="dolly", noise="none")
    return sequence, [sequence[index] for index in range(FRAMES)]


@pytest.fixture(scope="module")
def followed(recording):
    """The system after the recording, its results, and the share of the time of each frame that its stages name."""
    slam, results, shares = Slam(recording[0].camera), [], []
    for frame in recording[1]:
        start = time.perf_counter()
        results.append(slam.process(frame))
        shares.append(sum(results[-1].timings.values()) / (1000 * (time.perf_counter() - start)))
    return slam, results, shares


def share(sequence, results) -> float:
    return off_course(sequence.ground_truth.Ts_world_camera, [result.T_world_camera for result in results])


def test_a_tracker_that_never_moves_is_off_course(recording):
    """What the bounds of this and other files rest on."""
    sequence, _ = recording
    Ts = sequence.ground_truth.Ts_world_camera
    assert off_course(Ts, [np.eye(4)] * len(Ts)) == 1
    assert off_course(Ts, [*(se3.inverse(Ts[0]) @ Ts[:-1]), None]) == 0


def test_the_stages_make_up_the_time_of_a_frame(followed):
    shares = followed[2]
    assert max(shares) <= 1
    assert np.median(shares[4:]) > 0.85


def test_a_static_room_is_followed(recording, followed):
    (sequence, frames), (slam, results, _) = recording, followed
    assert {result.status for result in results} == {"tracked"}
    assert share(sequence, results) < LIMIT
    assert np.mean([result.dynamic_share for result in results]) < 0.05
    assert np.array_equal(slam.trajectory.timestamps, [frame.timestamp for frame in frames])
    view = slam.volume.raycast(results[-1].T_world_camera)
    both = (view.depth > 0) & (frames[-1].depth > 0)
    assert both.mean() > 0.5
    assert np.median(np.abs(view.depth - frames[-1].depth)[both]) < 0.03


def test_a_map_is_exposed_as_usual_though_the_camera_begins_in_the_dark(recording, followed):
    (sequence, frames), (_, usual, _) = recording, followed
    slam, dark = Slam(sequence.camera), replace(frames[0], color=(0.12 * frames[0].color).astype(np.uint8))
    results = [slam.process(frame) for frame in (dark, *frames[1:4])]
    gains = [result._tracking.exposure[0] for result in results[1:]]
    assert 0.5 < min(gains) <= max(gains) < 2  # a map of the dark frame would have 0.12
    for result, other in zip(results[1:], usual[1:], strict=False):
        assert np.linalg.norm((result.T_world_camera - other.T_world_camera)[:3, 3]) < 0.005


@pytest.mark.parametrize(
    "assignments",
    [
        ["sensor.sigma_base=0.005", "sensor.sigma_scale=0", "tracker.exposure=false"],
        ["volume.weighting=constant", "volume.carving=false"],
        ["volume.truncation_voxels=6", "volume.truncation_behind_voxels=3"],
        ["preprocess.filter=none", "preprocess.fill_holes=false"],
        ["volume.voxel_size=0.03"],
        ["dynamics.enabled=false"],
        ["similarity.enabled=false"],
    ],
)
def test_every_part_can_be_switched(recording, assignments):
    sequence, frames = recording
    slam = Slam(sequence.camera, Config().override(assignments))
    results = [slam.process(frame) for frame in frames[:14]]
    assert all(result.status == "tracked" for result in results)
    assert share(sequence, results) < LIMIT


def test_a_blank_image_is_lost_not_fused_and_the_next_good_one_is_found(recording):
    sequence, frames = recording
    slam = Slam(sequence.camera)
    for frame in frames[:10]:
        slam.process(frame)
    before = slam.volume.num_blocks
    blank = Frame(frames[10].timestamp, np.zeros_like(frames[10].depth), frames[10].color)
    result = slam.process(blank)
    assert (result.status, result.fused, result.T_world_camera) == ("lost", False, None)
    assert result.verdict.reason
    assert slam.volume.num_blocks == before
    again = slam.process(frames[11])
    assert again.status == "tracked"
    assert len(slam.trajectory) == 11


def test_frames_made_ready_ahead_by_another_thread_give_the_same(recording):
    sequence, frames = recording
    alone, ahead = Slam(sequence.camera), Slam(sequence.camera)
    with ThreadPoolExecutor(1) as reader:
        for frame, prepared in zip(
            frames[:8], [reader.submit(ahead.prepare, frame) for frame in frames[:8]], strict=True
        ):
            expected, found = alone.process(frame), ahead.process(prepared.result())
            assert np.array_equal(expected.T_world_camera, found.T_world_camera)
            assert np.array_equal(expected.dynamic_mask, found.dynamic_mask)
            assert set(found.timings) == set(expected.timings)


@pytest.mark.parametrize("grey", [0, 255])
def test_a_camera_that_is_blinded_goes_on_by_distances_and_fuses_nothing(recording, grey):
    sequence, frames = recording
    slam = Slam(sequence.camera)
    results = [slam.process(frame) for frame in frames[:14]]
    before = slam.volume.num_blocks
    for frame in frames[14:18]:
        results.append(slam.process(replace(frame, color=np.full_like(frame.color, grey))))
    assert all(result.status == "tracked" for result in results), [result.verdict.reason for result in results]
    assert [(result.blind, result.fused) for result in results[14:]] == [(True, False)] * 4
    assert slam.volume.num_blocks == before
    assert not slam.predictor.image_motion.active  # the last image with something to see was taken from elsewhere
    results.append(slam.process(frames[18]))
    assert (results[-1].blind, results[-1].fused) == (False, True)
    assert share(sequence, results) < LIMIT


def test_a_turn_that_no_prediction_expects_is_followed():
    sequence = synthetic.sequence("room", movers=(), frames=14, camera=SMALL, camera_path="dolly", seed=1)
    slam = Slam(sequence.camera, Config().override(["dynamics.start_seconds=0.1", "relocalization.enabled=false"]))
    results = [slam.process(sequence[index]) for index in range(13)]
    predict = slam.motion.predict
    slam.motion.predict = lambda timestamp: predict(timestamp) @ se3.exp(np.array([0, 0, 0, 0, np.radians(6.0), 0]))
    results.append(slam.process(sequence[13]))
    assert results[-1].status == "tracked", results[-1].verdict.reason
    assert share(sequence, results) < LIMIT


def test_another_room_is_never_taken_for_this_one(recording):
    sequence, frames = recording
    slam = Slam(sequence.camera)
    for frame in frames[:10]:
        slam.process(frame)
    other = synthetic.sequence("corridor", movers=(), frames=3, camera=SMALL, seed=7, noise="none")
    shifted = Frame(frames[10].timestamp, other[0].depth, other[0].color)
    result = slam.process(shifted)
    assert result.status == "lost"
    assert not result.fused


def test_nothing_to_start_from_is_lost():
    slam = Slam(SMALL)
    empty = Frame(0.0, np.zeros(SMALL.shape, np.float32), np.zeros((*SMALL.shape, 3), np.uint8))
    result = slam.process(empty)
    assert result.status == "lost"
    assert slam.volume.is_empty
    assert len(slam.trajectory) == 0


def test_a_redundant_view_gets_a_pose_but_is_not_fused():
    sequence = synthetic.sequence("room", movers=(), camera_path="still", frames=24, camera=SMALL)
    slam = Slam(SMALL)
    results = [slam.process(sequence[index]) for index in range(24)]
    redundant = ["redundant" in result.verdict for result in results]
    assert not any(redundant[: 2 * slam.config.volume.free_after])
    assert sum(redundant) >= 4
    assert [result.fused for result in results] == [not skipped for skipped in redundant]
    assert {result.status for result in results} == {"tracked"}
    assert len(slam.trajectory) == 24


def test_images_of_a_wrong_size_or_type_are_errors_of_one_class():
    depth, rgb, slam = np.ones((120, 160), np.float32), np.zeros((120, 160, 3), np.uint8), Slam(SMALL)
    for wrong, what in (
        ({"depth": depth[:10]}, "160x120"),
        ({"depth": depth.astype(np.int64)}, "int64"),
        ({"rgb": rgb.astype(float)}, "float64"),
        ({"timestamp": np.nan}, "nan"),
    ):
        with pytest.raises(FrameError, match=what):
            slam.process(**{"depth": depth, "rgb": rgb, "timestamp": 0.0} | wrong)


def test_what_is_printed_of_a_result_is_one_line():
    slam = Slam(SMALL)
    frame = Frame.from_arrays(np.full((120, 160), 2, np.float32), np.zeros((120, 160, 3), np.uint8), 1.5)
    result = slam.process(frame)
    printed = f"{frame} {result} {slam.trajectory} {slam.volume.extract_mesh()}"
    assert printed.startswith(
        "Frame(1.500000 s, depth (120, 160), colour (120, 160, 3)) FrameResult(1.500000 s, tracked"
    )
    assert "Trajectory(1 poses, 1.500000 to 1.500000 s) Mesh(" in printed
    assert len(printed) < 300


def digest():
    """Checksum of the poses, masks and mesh of a small run."""
    sequence = synthetic.sequence("room", movers=("person",), frames=10, camera=SMALL, start_dynamic=True)
    slam = Slam(SMALL)
    found = hashlib.sha256()
    for index in range(10):
        found.update(slam.process(sequence[index]).dynamic_mask.tobytes())
    found.update(slam.trajectory.Ts_world_camera.tobytes())
    for part in vars(slam.volume.extract_mesh()).values():
        found.update(part.tobytes())
    return found.hexdigest()


def test_the_result_does_not_depend_on_the_number_of_threads_or_the_run(give_threads):
    give_threads(3)
    command = [sys.executable, "-c", "import test_slam; print(test_slam.digest())"]
    done = subprocess.run(
        command, cwd=Path(__file__).parent, env={**os.environ, "DUDMAP_THREADS": "1"}, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    assert done.stdout.strip() == digest()


def test_importing_dudmap_is_light():
    code = "import sys, dudmap; print([name for name in ('numba', 'cv2', 'scipy', 'trimesh') if name in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "[]"


@pytest.mark.parametrize(("arguments", "expected"), [
    ({"poses": "gven"}, "poses is 'gven', expected 'estimated', 'given', 'refined'"),
    ({"config": {"volume": {}}}, "config is a dict, expected a Config"),
    ({"saved_map": "office"}, "saved_map is a str, expected a SavedMap: SavedMap.load"),
])  # fmt: skip
def test_an_argument_of_another_kind_is_refused_by_name(arguments, expected):
    with pytest.raises(ConfigError, match=re.escape(expected)):
        Slam(SMALL, **arguments)
