"""A saved map: its files, and runs that go on or find their way in it (rendered room, exact poses as truth)."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest

from dudmap.config import Config
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.place_recognition import Keyframe, PlacedFeatures
from dudmap.core.places.saved_map import KEYFRAME_FILE, MAP_FILE, SavedMap
from dudmap.core.slam import Slam
from dudmap.core.tracking.quality_monitor import RegistrationHistory
from dudmap.errors import ConfigError, MapError
from dudmap.lab.synthetic import sequence

SMALL = Camera(fx=140.0, fy=140.0, cx=79.5, cy=59.5, width=160, height=120)
CAMERA = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)
COARSE = Config().override(["volume.voxel_size=0.02"])


def keyframes(rng, counts=(3, 0, 5)):
    out = []
    for number, count in enumerate(counts):
        features = PlacedFeatures(rng.random((count, 128)).astype(np.float32), rng.random((count, 3)))
        out.append(Keyframe(0.5 * number, se3.exp(0.1 * rng.standard_normal(6)), features, submap=4))
    return out


def saved(folder, found=None):
    found = found or SavedMap(
        TsdfVolume(SMALL), keyframes(np.random.default_rng(1)), RegistrationHistory((1e-3,), (0.9,), (0.02,))
    )
    folder.mkdir(exist_ok=True)
    found.volume.save(folder / MAP_FILE)
    found.save_keyframes(folder / KEYFRAME_FILE)
    return found


def rewritten(path, **changes):
    with np.load(path) as data:
        content = {**data, **changes}
    np.savez_compressed(path, **content)


def digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_keyframes_come_back_as_they_were(tmp_path):
    before = saved(tmp_path)
    after = SavedMap.load(tmp_path, 0.01)
    assert len(after.keyframes) == 3
    assert after.registrations == before.registrations
    for a, b in zip(before.keyframes, after.keyframes, strict=True):
        assert (b.timestamp, b.submap, b.last_seen) == (a.timestamp, 0, -np.inf)
        np.testing.assert_array_equal(b.T_world_camera, a.T_world_camera)
        np.testing.assert_allclose(b.features.points, a.features.points, rtol=1e-7)
        np.testing.assert_allclose(b.features.descriptors, a.features.descriptors, rtol=1e-3)
        assert b.features.descriptors.dtype == np.float32
    assert sorted(path.name for path in tmp_path.iterdir()) == [KEYFRAME_FILE, MAP_FILE]


def test_a_failed_write_leaves_the_old_file(tmp_path):
    before = saved(tmp_path)
    old = digest(tmp_path / KEYFRAME_FILE)
    broken = replace(before, keyframes=[replace(before.keyframes[0], features=None)])
    with pytest.raises(TypeError):
        broken.save_keyframes(tmp_path / KEYFRAME_FILE)
    assert digest(tmp_path / KEYFRAME_FILE) == old
    with pytest.raises(MapError, match="cannot write the keyframes to"):
        before.save_keyframes(tmp_path / "nowhere" / KEYFRAME_FILE)


def test_bad_folders_are_refused_with_a_reason(tmp_path):
    with pytest.raises(MapError, match=r"holds no map\.npz and no keyframes\.npz, so no map to continue"):
        SavedMap.load(tmp_path)
    saved(tmp_path)
    with pytest.raises(ConfigError, match=r"has voxels of 0\.01 m, the run is to have 0\.02 m; set"):
        SavedMap.load(tmp_path, 0.02)
    path = tmp_path / KEYFRAME_FILE
    nothing = {"counts": np.zeros(0, int), "timestamps": np.zeros(0), "Ts_world_camera": np.zeros((0, 4, 4))}
    nothing |= {"points": np.zeros((0, 3)), "descriptors": np.zeros((0, 128))}
    for changes, reason in (
        ({"format": "dudmap keyframes 2"}, "has version 2 and this program reads up to 1; update dudmap"),
        ({"format": "something else"}, "is no keyframe file of dudmap"),
        ({"counts": np.array([3, 0, 4])}, "differ in number"),
        ({"voxel_size": 0.03}, "is mixed up"),
        (nothing, "holds no keyframe, so"),
    ):
        saved(tmp_path)
        rewritten(path, **changes)
        with pytest.raises(MapError, match=reason):
            SavedMap.load(tmp_path)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(MapError, match="is not a readable keyframe file"):
        SavedMap.load(tmp_path)
    path.unlink()
    with pytest.raises(MapError, match=r"holds no keyframes\.npz, so"):
        SavedMap.load(tmp_path)


@pytest.fixture(scope="module")
def first_run(tmp_path_factory):
    """Folder of a map of the room, and the true pose of its world frame."""
    recording = sequence("room", (), frames=60, seed=3, camera=CAMERA, camera_path="pan")
    slam = Slam(CAMERA, COARSE)
    for index in range(0, 60, 2):
        assert slam.process(recording[index]).status == "tracked"
    folder = tmp_path_factory.mktemp("run")
    saved(folder, slam.saved_map)
    return folder, recording.ground_truth.Ts_world_camera[0]


def next_recording():
    """Another recording of the same room, which does not start where the first did."""
    return sequence("room", (), frames=40, seed=9, camera=CAMERA, camera_path="pan")


def errors(results, recording, T_room_world, indices):
    """Errors (m, deg) of the tracked frames' poses in the world of the first run."""
    out = []
    for index, result in zip(indices, results, strict=True):
        if result.status == "tracked":
            truth = se3.inverse(T_room_world) @ recording.ground_truth.Ts_world_camera[index]
            error = se3.inverse(truth) @ result.T_world_camera
            out.append((np.linalg.norm(error[:3, 3]), np.degrees(se3.rotation_angle(error))))
    return np.array(out)


def test_localizing_finds_the_way_and_changes_nothing(first_run):
    folder, T_room_world = first_run
    before = {name: digest(folder / name) for name in (MAP_FILE, KEYFRAME_FILE)}
    loaded = SavedMap.load(folder, 0.02)
    words, count = loaded.volume.blocks.geometry.copy(), len(loaded.keyframes)
    slam, recording = Slam(CAMERA, COARSE, saved_map=loaded, localize=True), next_recording()
    results = [slam.process(recording[index]) for index in range(25, 40)]
    assert results[0].status == "tracked"
    assert "relocalized" in results[0].events
    assert not any(result.fused or "redundant" in result.verdict for result in results)
    found = errors(results, recording, T_room_world, range(25, 40))
    assert len(found) == 15
    assert found[:, 0].max() < 0.02
    assert found[:, 1].max() < 0.5
    np.testing.assert_array_equal(slam.volume.blocks.geometry, words)
    assert len(slam.atlas.keyframes.keyframes) == count
    assert {name: digest(folder / name) for name in before} == before


def test_going_on_fuses_into_the_saved_map(first_run):
    folder, T_room_world = first_run
    loaded = SavedMap.load(folder, 0.02)
    blocks, count = loaded.volume.num_blocks, len(loaded.keyframes)
    slam, recording = Slam(CAMERA, COARSE, saved_map=loaded), next_recording()
    indices = range(0, 40, 2)
    results = [slam.process(recording[index]) for index in indices]
    assert any(result.fused for result in results)
    assert slam.volume.num_blocks > blocks
    assert len(slam.saved_map.keyframes) >= count
    found = errors(results, recording, T_room_world, indices)
    assert found[:, 0].max() < 0.02
    assert found[:, 1].max() < 0.5  # the camera turns by 30 degrees and moves by 4 cm
    assert slam.atlas.saved == 0


def test_frames_of_another_place_are_lost_until_a_submap_starts(first_run):
    folder, _ = first_run
    slam = Slam(CAMERA, COARSE.override(["submaps.patience=0.4"]), saved_map=SavedMap.load(folder))
    recording = sequence("desk", (), frames=22, seed=1, camera=CAMERA)
    results = [slam.process(recording[index]) for index in range(22)]
    assert {result.verdict.reason for result in results if result.status == "lost"} == {
        "the camera has not been recognised in the saved map yet"
    }
    assert all(result.submap == 1 for result in results if result.status == "tracked")
    assert results[-1].status == "tracked"  # in a submap of its own, begun after submaps.patience
    assert len(slam.maps[0][0]) == 0  # the saved map stays the main one, in whose world no pose is known


@pytest.mark.slow
def test_a_submap_is_joined_with_the_saved_map_when_that_is_recognised(first_run):
    folder, T_room_world = first_run
    slam = Slam(CAMERA, COARSE, saved_map=SavedMap.load(folder))
    recording = sequence("room", (), frames=240, seed=4, camera=CAMERA, camera_path="round")
    results = [slam.process(recording[index]) for index in range(110, 235)]
    assert {0, 1} <= {result.submap for result in results if result.status == "tracked"}
    assert list(slam.atlas.volumes) == [0]
    poses = slam.trajectory
    truth = recording.ground_truth
    offsets = [
        np.linalg.norm(T[:3, 3] - (se3.inverse(T_room_world) @ truth.interpolate(stamp))[:3, 3])
        for stamp, T in zip(poses.timestamps, poses.Ts_world_camera, strict=True)
    ]
    assert len(offsets) > 60
    assert max(offsets) < 0.05
