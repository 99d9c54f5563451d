"""Nothing keeps memory of the caller, and nothing handed out is memory of the system: all of it is overwritten here."""

import copy
import dataclasses
import pickle
import time
from types import SimpleNamespace

import numpy as np
import pytest

from dudmap import (
    Calibration,
    Camera,
    Config,
    DatasetError,
    Frame,
    Mesh,
    Slam,
    Trajectory,
    TsdfVolume,
    resume_system,
    run,
    save_system,
    synthetic,
)
from dudmap.app.pipeline.inspection import inspect, repeats
from dudmap.io.cameras import CameraFrame, LiveCamera
from dudmap.io.sequences import open_sequence

CAMERA = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)
SMALL = Config().override(["volume.voxel_size=0.03", "similarity.max_translation=0"])
COUNT = 14


@pytest.fixture(scope="module")
def frames():
    """Frames and masks of a person who walks through a room."""
    recording = synthetic.sequence("room", frames=COUNT, camera=CAMERA, camera_path="handheld", start_dynamic=True)
    found = [(recording[index], recording.mask(index)) for index in range(COUNT)]
    assert np.mean([mask for _, mask in found]) > 0.05
    return found


def poison(value, seen=None):
    """Overwrite all arrays in a value and in its members."""
    seen = set() if seen is None else seen
    if id(value) in seen or value is None or isinstance(value, str | int | float | bool | Camera):
        return
    seen.add(id(value))
    if isinstance(value, np.ndarray):
        if value.flags.writeable and value.dtype != object:
            value[...] = 1 if value.dtype == bool else 77
    elif isinstance(value, tuple | list):
        for item in value:
            poison(item, seen)
    elif isinstance(value, dict):
        for item in value.values():
            poison(item, seen)
    elif dataclasses.is_dataclass(value):
        for item in vars(value).values():
            poison(item, seen)


def outcome(slam, results):
    """Results of a system: poses, masks and mesh."""
    mesh = slam.volume.extract_mesh()
    return [
        *(result.status for result in results),
        *(result.T_world_camera for result in results),
        *(result.dynamic_mask for result in results),
        *(mover.points for result in results for mover in result.movers),
        slam.trajectory.Ts_world_camera, mesh.vertices, mesh.colors, mesh.faces,
    ]  # fmt: skip


def assert_equal(found, expected):
    """Bit for bit."""
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.fixture(scope="module")
def expected(frames):
    """Outcome with arrays that nobody touches, with and without masks."""
    found = {}
    for masked in (False, True):
        slam = Slam(CAMERA, SMALL)
        results = [slam.process(copy.deepcopy(frame), np.array(mask) if masked else None) for frame, mask in frames]
        found[masked] = outcome(slam, results)
    return found


class Buffers:
    """One colour image, one depth image and one mask that are filled again and again, as drivers do."""

    def __init__(self):
        self.depth, self.color = np.empty(CAMERA.shape, np.float32), np.empty((*CAMERA.shape, 3), np.uint8)
        self.mask = np.empty(CAMERA.shape, bool)

    def fill(self, frame, mask=None):
        self.depth[...], self.color[...] = frame.depth, frame.color
        if mask is not None:
            self.mask[...] = mask
        return Frame(frame.timestamp, self.depth, self.color)


def as_frame(slam, frame, mask):
    return slam.process(frame, mask)


def as_arrays(slam, frame, mask):
    return slam.process(depth=frame.depth, rgb=frame.color, timestamp=frame.timestamp, dynamic_mask=mask)


def prepared(slam, frame, mask):
    view = slam.prepare(frame, mask)
    poison([frame, mask])
    return slam.process(view)


@pytest.mark.parametrize(("process", "masked"), [(as_frame, False), (as_arrays, True), (prepared, True)])
def test_images_may_be_overwritten_after_each_call(frames, expected, process, masked):
    slam, buffers, results = Slam(CAMERA, SMALL), Buffers(), []
    for frame, mask in frames:
        given = buffers.fill(frame, mask)
        results.append(process(slam, given, buffers.mask if masked else None))
        poison([given, buffers.mask])
    assert_equal(outcome(slam, results), expected[masked])


def test_a_mask_of_ignored_pixels_may_be_overwritten(frames):
    found = []
    for overwrites in (False, True):
        ignore = np.zeros(CAMERA.shape, bool)
        ignore[:40, :50] = True
        slam = Slam(CAMERA, SMALL, ignore=ignore)
        if overwrites:
            poison(ignore)
        found.append(outcome(slam, [slam.process(frame) for frame, _ in frames[:6]]))
    assert_equal(*found)


def test_results_may_be_overwritten(frames, expected):
    slam, kept = Slam(CAMERA, SMALL), []
    for frame, _ in frames:
        result = slam.process(frame)
        kept.append(copy.deepcopy(result))
        poison([result, result.movers, slam.trajectory, slam.calibration, slam.maps[0][0], slam.image_poses])
    assert_equal(outcome(slam, kept), expected[False])


def test_results_stay_as_they_are(frames):
    slam, results, kept = Slam(CAMERA, SMALL), [], []
    for frame, _ in frames:
        results.append(slam.process(frame))
        kept.append(copy.deepcopy(results[-1]))
    for result, was in zip(results, kept, strict=True):
        assert_equal([result.T_world_camera, result.dynamic_mask, result.residuals],
                     [was.T_world_camera, was.dynamic_mask, was.residuals])  # fmt: skip


def test_a_result_is_pickled_and_copied_with_its_moving_objects(frames):
    slam = Slam(CAMERA, SMALL)
    result = [slam.process(frame) for frame, _ in frames][-1]
    for found in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result), copy.copy(result)):
        assert [mover.id for mover in found.movers] == [mover.id for mover in result.movers]
        assert found.timings == result.timings
        np.testing.assert_array_equal(found.dynamic_mask, result.dynamic_mask)
        np.testing.assert_array_equal(found.T_world_camera, result.T_world_camera)
        assert [mover.id for mover in dataclasses.replace(found, submap=1).movers] == [m.id for m in result.movers]


def test_a_stored_system_holds_nothing_of_the_caller(frames, expected, tmp_path):
    slam, buffers, results = Slam(CAMERA, SMALL), Buffers(), []
    for number, (frame, _) in enumerate(frames):
        results.append(slam.process(buffers.fill(frame)))
        poison(vars(buffers))
        if number == COUNT // 2:
            save_system(slam, tmp_path / "state.db")
            slam = resume_system(tmp_path / "state.db")
    assert_equal(outcome(slam, results), expected[False])


def test_the_map_keeps_nothing_of_the_caller(frames):
    meshes, views = [], []
    for overwrites in (False, True):
        volume = TsdfVolume(CAMERA, SMALL.volume)
        for frame, mask in frames[:4]:
            given, T, static = frame.copy(), np.eye(4), ~mask
            volume.integrate(given, T, static)
            if overwrites:
                poison([given, T, static])
            T = np.eye(4)
            view = volume.raycast(T)
            depth, intensity = np.array(frame.depth), np.zeros(CAMERA.shape, np.float32)
            sample = volume.sample(depth, intensity, CAMERA, T)
            views.append([np.array(view.depth), np.array(view.color), np.array(sample.distance)])
            if overwrites:
                poison([view, sample, T, depth, intensity, volume.extract_mesh()])
        mesh = volume.extract_mesh()
        meshes.append([mesh.vertices, mesh.faces, mesh.colors, mesh.normals])
    assert_equal(meshes[1], meshes[0])
    for view, other in zip(views[:4], views[4:], strict=True):
        assert_equal(other, view)


def test_values_are_copied():
    stamps, Ts = np.arange(3.0), np.tile(np.eye(4), (3, 1, 1))
    T, sigma, distortion = np.eye(4), np.zeros(13), np.full(4, 0.1)
    vertices, faces = np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)
    colors, normals = np.full((3, 3), 9, np.uint8), np.eye(3, dtype=np.float32)
    depth, rgb = np.ones((20, 30), np.float32), np.ones((20, 30, 3), np.uint8)
    camera = Camera(100, 100, 80, 60, 160, 120, distortion=distortion)
    values = [
        Trajectory(stamps, Ts), Calibration(camera, T, sigma=sigma), Mesh(vertices, faces, colors, normals), camera,
        Frame.from_arrays(depth, rgb, 0.0),
    ]  # fmt: skip
    before = pickle.dumps(values)
    poison([stamps, Ts, T, sigma, distortion, vertices, faces, colors, normals, depth, rgb])
    assert pickle.dumps(values) == before


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: Trajectory(None, None), "times of a trajectory: found a NoneType; expected an array of numbers"),
        (lambda: Calibration(CAMERA, "T"), r"found a str; expected numbers of the shape \(4, 4\)"),
        (lambda: Mesh(None, None, None, None), "vertices of a mesh: found a NoneType"),
        (lambda: TsdfVolume(CAMERA).raycast(None), r"pose of a view: found a NoneType; .* \(4, 4\)"),
        (lambda: Slam(CAMERA).process(wall(), [[True]]), r"the mask is a list; expected \(120, 160\) bool"),
    ],
)
def test_what_is_no_array_is_refused_in_a_sentence(make, sentence):
    with pytest.raises(DatasetError, match=sentence):
        make()


def test_lists_of_numbers_are_arrays():
    assert Trajectory([0.0, 1.0], [np.eye(4).tolist()] * 2).Ts_world_camera.shape == (2, 4, 4)


def wall():
    return Frame(0.0, np.ones(CAMERA.shape, np.float32), np.zeros((*CAMERA.shape, 3), np.uint8))


class OneBuffer:
    """A recording of a user whose frames are always the same two arrays."""

    name, camera, calibration, ground_truth = "mine", CAMERA, None, None

    def __init__(self, frames):
        self.frames, self.buffers = frames, Buffers()
        self.timestamps = np.array([frame.timestamp for frame, _ in frames])

    def __len__(self):
        return len(self.frames)

    def __getitem__(self, index):
        return self.buffers.fill(*self.frames[index])

    def mask(self, index):
        self.buffers.mask[...] = self.frames[index][1]
        return self.buffers.mask


class Fresh(OneBuffer):
    """The same with new arrays for each frame."""

    def __getitem__(self, index):
        return super().__getitem__(index).copy()

    def mask(self, index):
        return super().mask(index).copy()


class Watcher:
    """Keeps the images of the frames that a run reports."""

    in_background = False

    def __init__(self):
        self.images = []

    def start(self, *args):
        """Nothing."""

    finish = event = resume = start

    def frame(self, index, read, result, ms):
        self.images += [read.frame.color.copy(), read.frame.depth.copy(), result.dynamic_mask.copy()]


def run_of(sequence, out):
    """Mask score, poses, mesh and images of a run over a sequence."""
    watcher = Watcher()
    report = run(sequence, SMALL, out, progress=False, save_masks=True, observers=(watcher,))
    mesh = Mesh.load(out / "mesh.ply")
    return [report.metrics["mask_iou_mean"], report.trajectory.Ts_world_camera, mesh.vertices, mesh.colors,
            *watcher.images]  # fmt: skip


def test_a_recording_of_the_user_may_reuse_its_images(frames, tmp_path):
    assert_equal(run_of(OneBuffer(frames), tmp_path / "one"), run_of(Fresh(frames), tmp_path / "fresh"))
    assert repeats(OneBuffer(frames)) == repeats(Fresh(frames)) == {"frame": 0, "depth": 0, "color": 0}
    assert inspect(OneBuffer(frames)).warnings == inspect(Fresh(frames)).warnings


class OneBufferCamera(LiveCamera):
    """A driver that fills the same images for every frame, as soon as the last one is read."""

    name, camera = "mine", CAMERA

    def __init__(self, frames):
        self.frames, self.buffers, self.number = frames, Buffers(), -1

    def read(self):
        self.number += 1
        if self.number >= len(self.frames):
            return None
        time.sleep(0.25)
        return CameraFrame(self.number, self.buffers.fill(*self.frames[self.number]), time.perf_counter())

    def preview(self, count):
        return []

    def close(self):
        """Nothing is open."""


def test_a_driver_may_reuse_its_images(frames, tmp_path):
    pytest.importorskip("rosbags")
    camera = OneBufferCamera(frames)
    run(camera, SMALL, tmp_path / "live", progress=False, record=tmp_path / "live.mcap")
    recorded = open_sequence(tmp_path / "live.mcap")
    assert len(recorded) == COUNT
    for index, (frame, _) in enumerate(frames):
        np.testing.assert_array_equal(recorded[index].color, frame.color)


def test_poison_reaches_all_arrays():
    inner = np.zeros(3)
    poison(SimpleNamespace(a=inner))
    assert not inner.any()
    poison([{"a": (inner,)}])
    assert np.all(inner == 77)
