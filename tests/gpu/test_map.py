"""Operations on the map: the device against the CPU, and twice on the device."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dudmap.config import Config
from dudmap.core.backends.cpu.filtering import intensity
from dudmap.core.backends.device import make_backend
from dudmap.core.backends.parameters import LevelImage, RegistrationParameters
from dudmap.core.frames.observation import Pyramid
from dudmap.core.frames.preprocess import Preprocessor
from dudmap.core.geometry import se3
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.tracking.tracker import NO_STEP, Tracker
from small_maps import CAMERA, CONFIG, integrated, voxels

pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")

from dudmap.core.backends.warp import memory


def linearized(volume, recording, huber=0.02, index=4):
    """Normal equations of a frame at a pose a little beside its own."""
    T = recording.ground_truth.Ts_world_camera[index].copy()
    T[:3, 3] += [0.01, -0.005, 0.008]
    frame = recording[index]
    depth, shade = frame.depth.astype(np.float32), intensity(np.ascontiguousarray(frame.color))
    weights = np.linspace(0, 1, depth.size, dtype=np.float32).reshape(depth.shape)
    volume.look_at(T)
    image = LevelImage(depth, shade, weights, CAMERA.intrinsics)
    parameters = RegistrationParameters(volume.band, huber, 0.02, 0.1, 0.003)
    return volume.backend.register(volume.grid, image, T, None, NO_STEP, parameters).equations


def test_maps_have_the_same_blocks_and_voxels(maps):
    """Blocks, weights and free space are equal but for pixels on whose border a voxel projects (one in a thousand);
    distances differ by rounding, one step of ten micrometres, elsewhere."""
    expected, found = voxels(maps[0]), voxels(maps[1])
    assert expected.keys() == found.keys()
    assert maps[0].blocks.num_free(maps[0].config.free_after) == maps[1].blocks.num_free(maps[1].config.free_after) > 10
    a, b = (np.array([words for words, _ in each.values()]) for each in (expected, {k: found[k] for k in expected}))
    assert ((a >> 8 & 0xFF) != (b >> 8 & 0xFF)).mean() < 1e-3
    assert (np.abs((a >> 16) - (b >> 16)) > 1).mean() < 1e-3
    assert (np.abs((a & 0xFF) - (b & 0xFF)) > 1).mean() < 1e-3
    a, b = (np.array([paint for _, paint in each.values()]) for each in (expected, {k: found[k] for k in expected}))
    assert (np.abs((a >> 20) - (b >> 20)) > 1).mean() < 1e-3


def test_normal_equations_are_those_of_the_cpu(maps, recording):
    """The map is that of the CPU on both, so that only the arithmetic differs."""
    other = on_device(maps[0], maps[1].backend)
    expected, found = linearized(maps[0], recording), linearized(other, recording)
    assert abs(found.num_inliers - expected.num_inliers) <= 2
    assert expected.num_inliers > 5000
    np.testing.assert_allclose(found.H, expected.H, atol=2e-5 * np.abs(expected.H).max())
    np.testing.assert_allclose(found.b, expected.b, atol=2e-4 * np.abs(expected.b).max())
    for name in ("cost", "readings", "weight", "chi_square"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-4)
    for k in range(2):
        assert np.mean(np.isnan(found.residuals[k]) != np.isnan(expected.residuals[k])) < 1e-3
        np.testing.assert_allclose(np.nan_to_num(found.residuals[k] - expected.residuals[k]), 0, atol=1e-4)


def test_sums_are_the_same_in_every_run(maps, recording):
    one, two = linearized(maps[1], recording), linearized(maps[1], recording)
    assert np.array_equal(one.H, two.H)
    assert np.array_equal(one.b, two.b)
    assert one.cost == two.cost


def test_results_follow_what_changes(maps, recording):
    """Pose, images, parameters and the map change between calls; each result is that of a back end that begins."""
    volume = on_device(maps[0], make_backend("warp-cpu"))
    for index, huber in ((4, 0.02), (4, 0.05), (3, 0.05), (4, 0.02)):
        found = linearized(volume, recording, huber, index)
        fresh = linearized(on_device(maps[0], make_backend("warp-cpu")), recording, huber, index)
        assert np.array_equal(found.H, fresh.H)
        assert np.array_equal(found.b, fresh.b)
    volume.blocks.write(volume.active_slots, *np.zeros((2, volume.num_blocks, 512), np.int32))
    assert linearized(volume, recording).num_inliers == 0
    assert np.array_equal(found.residuals[1], fresh.residuals[1], equal_nan=True)  # not read, nor overwritten, so far


def test_samples_are_those_of_the_cpu(maps, recording):
    other = on_device(maps[0], maps[1].backend)
    T, depth = recording.ground_truth.Ts_world_camera[4], recording[4].depth.astype(np.float32)
    shade = np.zeros(depth.shape, np.float32)
    for volume in (maps[0], other):
        volume.look_at(T)
    expected, found = (volume.sample(depth, shade, CAMERA, T) for volume in (maps[0], other))
    assert (expected.occupancy != found.occupancy).mean() < 1e-3
    same = expected.occupancy == found.occupancy
    for a, b in ((expected.distance, found.distance), (expected.difference, found.difference)):
        np.testing.assert_allclose(b[same], a[same], atol=1e-4)


def test_a_view_shows_what_the_device_has_fused(maps, recording):
    """Views are made on the CPU: from the voxels that come down."""
    T = recording.ground_truth.Ts_world_camera[2]
    expected, found = on_device(maps[1], maps[0].backend).raycast(T), maps[1].raycast(T)
    assert (expected.depth > 0).mean() > 0.5
    near = np.abs(expected.depth - found.depth) < 1e-3  # roundings: the windows begin at other blocks
    assert near.mean() > 0.99
    assert (np.abs(expected.color[near].astype(int) - found.color[near]) <= 1).mean() > 0.999


def test_a_registration_ends_where_that_of_the_cpu_does(maps, recording):
    """The steps are one text; only the sums differ, by roundings."""
    tracker = Tracker(*(getattr(Config(), name) for name in ("tracker", "sensor")))
    config = Config().override(["tracker.widths=[40,80,160]"])
    levels = Pyramid.of(Preprocessor(CAMERA, config.preprocess)(recording[4]), CAMERA, config).tracked
    T = se3.exp(np.array([0.01, -0.005, 0.008, 0.004, -0.006, 0.003])) @ recording.ground_truth.Ts_world_camera[4]
    expected, found = (tracker.align(v, levels, T) for v in (maps[0], on_device(maps[0], maps[1].backend)))
    moved = np.linalg.norm((expected.T_world_camera - T)[:3, 3])
    assert expected.accepted
    assert found.accepted
    assert np.linalg.norm((expected.T_world_camera - found.T_world_camera)[:3, 3]) < 0.01 * moved
    assert found.residual == pytest.approx(expected.residual, rel=1e-3)


def test_voxels_come_down_once(maps, recording, monkeypatch):
    volume, pulled = integrated(recording, "warp-cpu", frames=2), []
    down = memory.down
    monkeypatch.setattr(memory, "down", lambda array: pulled.append(array.shape[0]) or down(array))
    _ = volume.blocks.geometry
    assert len(volume.active_slots) == pulled[0]
    _ = volume.blocks.geometry
    assert len(pulled) == 1


def test_the_mesh_of_a_map_made_on_the_device_is_within_a_quarter_voxel(maps):
    a, b = (volume.extract_mesh(1).vertices for volume in maps)
    distance = cKDTree(a).query(b)[0]
    assert np.quantile(distance, 0.999) < CONFIG.voxel_size / 4


def test_map_files_are_exchanged(maps, tmp_path):
    """A map made on the device, saved, loaded on the CPU, and gone on in on the device."""
    maps[1].save(tmp_path / "map.npz")
    loaded = TsdfVolume.load(tmp_path / "map.npz")
    assert [*voxels(loaded)] == [*voxels(maps[1])]
    again = loaded.for_camera(CAMERA, maps[1].backend)
    np.testing.assert_array_equal(again.extract_mesh(1).faces, maps[1].extract_mesh(1).faces)


def test_what_the_host_changes_reaches_the_device(recording):
    """Colours taken from another map, as when a calibration repaints it, and fusion after that."""
    painted, plain = integrated(recording, "warp-cpu"), integrated(recording, "warp-cpu")
    reference = integrated(recording, "cpu")
    grey = integrated(recording, "cpu")
    grey.blocks.write(grey.active_slots, *(0 * grey.blocks.geometry[grey.active_slots],) * 2)
    for volume in (painted, reference):
        volume.take_colors(grey)
    T = recording.ground_truth.Ts_world_camera[0]
    assert plain.raycast(T).color.max() > 0
    assert painted.raycast(T).color.max() == 0
    for volume in (painted, reference):
        volume.integrate(recording[5], recording.ground_truth.Ts_world_camera[5])
    a, b = voxels(reference), voxels(painted)
    assert a.keys() == b.keys()
    paints = np.array([[a[key][1], b[key][1]] for key in a])
    assert (paints[:, 0] != paints[:, 1]).mean() < 1e-2
    assert (paints != 0).any()


def on_device(volume, backend):
    """The same blocks in a map on the device."""
    blocks, slots = volume.blocks, volume.active_slots
    other = TsdfVolume(CAMERA, CONFIG, depth_max=6.0, backend=backend)
    other.blocks = type(blocks).restored(
        blocks.coords[: blocks.num_entries], blocks.free_count[: blocks.num_entries], blocks.entry_of[slots],
        blocks.geometry[slots], blocks.colors[slots],
    )  # fmt: skip
    other.num_frames = volume.num_frames
    return other
