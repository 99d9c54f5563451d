"""Merging of maps: samples against an analytic distance, exact sums, relative poses of rendered rooms, refusals."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dudmap.app.viewing.report import write_report
from dudmap.app.viewing.run_files import RunFiles
from dudmap.config import Config, VolumeConfig
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.saved_map import KEYFRAME_FILE, MAP_FILE, SavedMap
from dudmap.errors import DudmapError, MapError
from dudmap.fleet import map_merging
from dudmap.fleet.agreement import agreement
from dudmap.fleet.map_fusion import BlockSums, block_sums, fuse_maps, fused
from dudmap.fleet.map_merging import Hypothesis, MapSurface, compare_maps, decided
from dudmap.fleet.map_samples import EMPTY, OBSERVED, sample_map, surface_points
from dudmap.fleet.merge import merge_runs
from rendered_places import looking_elsewhere, rearranged, record, retextured, true_map

SMALL = Camera(fx=60.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)
WALL = 1.5


def wall(distance=WALL, grey=100, config=None, poses=None):
    """Volume of a wall z = distance, seen from several poses that only shift along x and y."""
    volume = TsdfVolume(SMALL, config or VolumeConfig(voxel_size=0.02))
    depth = np.full(SMALL.shape, distance, np.float32)
    color = np.full((*SMALL.shape, 3), grey, np.uint8)
    for T in poses or [np.eye(4)]:
        for _ in range(6):
            volume.integrate(Frame(0.0, depth, color), T)
    return volume


def shifted(x=0.0, y=0.0, z=0.0):
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def test_samples_are_the_distance_to_the_wall():
    volume = wall()
    points = np.array([[0.1, -0.05, WALL + d] for d in (-0.05, -0.013, 0.0, 0.007, 0.03)])
    samples = sample_map(volume, points)
    assert (samples.state == OBSERVED).all()
    np.testing.assert_allclose(samples.sdf, WALL - points[:, 2], atol=2e-3)
    np.testing.assert_allclose(samples.sdf_gradient[1:4], np.tile([0, 0, -1], (3, 1)), atol=0.08)
    np.testing.assert_allclose(samples.color[2], 100, atol=1)
    np.testing.assert_allclose(samples.intensity[2], 100 / 255, atol=0.01)
    far = sample_map(volume, np.array([[0.0, 0.0, 0.7], [0.0, 0.0, 3.0]]))
    assert list(far.state) == [EMPTY, 0]


def test_gradients_are_the_derivatives_of_the_samples():
    """On a slanted wall that is lit from one corner, inside the cells, where every value is linear along an axis."""
    v, u = np.indices(SMALL.shape)
    depth = (WALL + 0.003 * (u - 30) - 0.005 * (v - 20)).astype(np.float32)
    color = np.repeat((40 + 2 * u + v).astype(np.uint8)[..., None], 3, axis=2)
    volume = TsdfVolume(SMALL, VolumeConfig(voxel_size=0.02))
    volume.integrate(Frame(0.0, depth, color), np.eye(4))
    rng = np.random.default_rng(4)
    chosen = v[8:40, 8:56].reshape(-1), u[8:40, 8:56].reshape(-1)
    points = SMALL.points(chosen[1], chosen[0], depth[chosen].astype(np.float64)) / 0.02
    points = 0.02 * (np.floor(points) + rng.uniform(0.2, 0.8, points.shape))
    samples, step = sample_map(volume, points), 0.002
    lit = (samples.state == OBSERVED) & (samples.intensity > 0)
    for axis, shift in enumerate(step * np.eye(3)):
        forth, back = sample_map(volume, points + shift), sample_map(volume, points - shift)
        for name in ("sdf", "intensity"):
            numeric = (getattr(forth, name) - getattr(back, name)) / (2 * step)
            found = getattr(samples, f"{name}_gradient")[:, axis]
            np.testing.assert_allclose(found[lit], numeric[lit], atol=1e-3)
            assert np.abs(found[lit]).mean() > 0.02
    assert np.count_nonzero(lit) > 300


def words(volume):
    """Content of a map by block."""
    blocks = volume.blocks
    order = np.lexsort(blocks.coords[: blocks.num_entries].T)
    slots = blocks.slot_of[: blocks.num_entries][order]
    geometry = np.where((slots >= 0)[:, None], blocks.geometry[np.maximum(slots, 0)], 0)
    colors = np.where((slots >= 0)[:, None], blocks.colors[np.maximum(slots, 0)], 0)
    return blocks.coords[: blocks.num_entries][order], blocks.free_count[: blocks.num_entries][order], geometry, colors


@pytest.fixture(scope="module")
def sums_of_walls():
    rng = np.random.default_rng(0)
    volumes = [wall(1.5 + 0.004 * k, grey=60 + 20 * k, poses=[shifted(*rng.uniform(-0.4, 0.4, 2))]) for k in range(5)]
    coords = np.unique(np.concatenate([v.blocks.coords[: v.blocks.num_entries] for v in volumes]), axis=0)
    Ts = [None, se3.exp(np.array([0.01, 0, 0, 0, 0.02, 0])), None, None, se3.exp(np.array([0, 0.02, 0, 0.01, 0, 0]))]
    unit = volumes[0].sdf_unit
    return [block_sums(v, coords.astype(np.int32), T, unit) for v, T in zip(volumes, Ts, strict=True)]


def total_of(parts):
    total = BlockSums.zeros(parts[0].coords)
    for part in parts:
        total.add(np.arange(len(part.coords)), part)
    return total


@given(order=st.permutations(range(5)), cut=st.integers(1, 4))
@settings(max_examples=10, deadline=None)
def test_any_order_and_grouping_of_the_sums_gives_the_same_voxels(sums_of_walls, order, cut):
    expected = fused(total_of(sums_of_walls), 1000, 4, 4)
    groups = [total_of([sums_of_walls[number] for number in part]) for part in (order[:cut], order[cut:])]
    found = fused(total_of(groups), 1000, 4, 4)
    for name in ("geometry", "colors", "has_voxels", "free_count"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_a_map_fused_alone_stays_as_it_is_and_orders_do_not_matter():
    a, b = wall(1.5, 80), wall(1.52, 120, poses=[shifted(0.3)])
    alone = fuse_maps([a], [np.eye(4)])
    for found, expected in zip(words(alone), words(a), strict=True):
        np.testing.assert_array_equal(found, expected)
    for found, expected in zip(
        words(fuse_maps([a, b], [np.eye(4)] * 2)), words(fuse_maps([b, a], [np.eye(4)] * 2)), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


def test_the_fused_wall_is_the_weighted_mean():
    a, b = wall(1.50), wall(1.51)
    merged = fuse_maps([a, b], [np.eye(4), np.eye(4)])
    point = np.array([[0.0, 0.0, 1.5]])
    in_a, in_b, in_both = (sample_map(volume, point) for volume in (a, b, merged))
    mean = (in_a.sdf * in_a.weight + in_b.sdf * in_b.weight) / (in_a.weight + in_b.weight)
    np.testing.assert_allclose(in_both.sdf, mean, atol=1e-3)
    np.testing.assert_allclose(in_both.weight, in_a.weight + in_b.weight)


def test_a_moved_map_lies_where_its_pose_says():
    T = se3.exp(np.array([0.05, -0.02, 0.1, 0.03, 0.05, -0.04]))
    moved = fuse_maps([wall(9.9), wall()], [np.eye(4), T])  # the first sees nothing within range
    local = np.array([[x, y, WALL + d] for x in (-0.3, 0.2) for y in (-0.2, 0.1) for d in (-0.02, 0.0, 0.02)])
    samples = sample_map(moved, local @ T[:3, :3].T + T[:3, 3])
    assert (samples.state == OBSERVED).all()
    np.testing.assert_allclose(samples.sdf, WALL - local[:, 2], atol=3e-3)


def test_what_stood_in_one_run_and_was_gone_in_the_other_leaves_the_map():
    config = VolumeConfig(voxel_size=0.02)
    ghost, empty = wall(1.0, config=config), wall(2.0, config=config, poses=[np.eye(4)] * 6)
    assert sample_map(ghost, np.array([[0.0, 0.0, 1.0]])).state[0] == OBSERVED
    merged = fuse_maps([ghost, empty], [np.eye(4), np.eye(4)])
    behind = sample_map(merged, np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.01], [0.0, 0.0, 2.0]]))
    assert (behind.sdf[:2] > 0.02).all()
    np.testing.assert_allclose(behind.sdf[2], 0, atol=2e-3)


@pytest.fixture(scope="module")
def room():
    return true_map(record("room", 1))


@pytest.fixture(scope="module")
def same_room():
    return true_map(record("room", 3, "handheld"))


def test_two_maps_of_one_room_are_joined_at_the_true_pose(room):
    other = true_map(record("room", 3, "handheld"))
    pair = compare_maps(room.saved, other.saved)
    assert pair.reason == ""
    error = se3.inverse(room.T_world_other(other)) @ pair.T_a_b
    assert np.linalg.norm(error[:3, 3]) < 0.01
    assert np.degrees(se3.rotation_angle(error)) < 0.2
    swapped = compare_maps(other.saved, room.saved)
    back = swapped.T_a_b @ pair.T_a_b
    assert np.linalg.norm(back[:3, 3]) < 0.005


def test_maps_are_recognised_in_the_order_in_which_they_can_be(room, monkeypatch):
    T = np.eye(4)
    T[:3, 3] = 1, 2, 3
    other = replace(room.saved, keyframes=room.saved.keyframes[:2])

    def only_in(a, b, *_):
        return [Hypothesis(T, 2, 50)] if len(a) > len(b) else []

    monkeypatch.setattr(map_merging, "relative_poses", only_in)
    monkeypatch.setattr(map_merging, "decided", lambda a, b, found, **_: found)
    assert np.array_equal(compare_maps(room.saved, other)[0].T_a_b, T)
    assert np.allclose(compare_maps(other, room.saved)[0].T_a_b, se3.inverse(T))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (looking_elsewhere, "too few places"),
        (retextured, "too few places|cannot be aligned|the colours disagree"),
        (lambda scene: retextured(scene, walls=False), "too few places|the colours disagree"),
        (rearranged, "too few places|features and surfaces|free space|the colours disagree"),
    ],
    ids=["elsewhere", "other textures", "other things", "rearranged"],
)
def test_look_alikes_are_refused(room, change, reason):
    pair = compare_maps(room.saved, true_map(record("room", 2, change=change)).saved)
    assert pair.T_a_b is None
    assert any(part in pair.reason for part in reason.split("|"))


def striped_wall(picture):
    """Map of a wall of 9.6 x 2.4 m with stripes, with or without a picture of 40 x 40 cm, and points on it."""
    volume = TsdfVolume(SMALL, VolumeConfig(voxel_size=0.04))
    v, u = np.mgrid[: SMALL.height, : SMALL.width]
    for shift in (0.0, 3.2, 6.4):
        x, y = (u - SMALL.cx) * 3 / SMALL.fx + shift, (v - SMALL.cy) * 3 / SMALL.fy
        grey = 120 + 40 * np.sin(2 * np.pi * x / 0.8)
        if picture:
            grey = np.where((np.abs(x - 3.2) < 0.2) & (np.abs(y) < 0.2), 220, grey)
        color = np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)
        for _ in range(6):
            volume.integrate(Frame(0.0, np.full(SMALL.shape, 3.0, np.float32), color), shifted(shift))
    return volume, surface_points(volume, np.zeros((1, 3)), 20_000)


def test_among_many_maps_one_other_picture_makes_a_place_another_one():
    (plain, of_plain), (same, of_same), (other, of_other) = striped_wall(False), striped_wall(False), striped_wall(True)
    found = agreement(plain, same, of_plain, of_same, np.eye(4))
    assert found.other_color == 0
    assert found.rejection_reason(many=True) == ""
    found = agreement(plain, other, of_plain, of_other, np.eye(4))
    assert found.color_share > 0.98
    assert 0.1 < found.other_color < 0.36  # 0.16 m2, in whole cells of 25 cm
    assert found.rejection_reason() == ""
    assert "m2 have another colour" in found.rejection_reason(many=True)


def test_a_map_without_a_surface_is_left_out():
    (wall, of_wall), nothing = striped_wall(False), TsdfVolume(SMALL, VolumeConfig(voxel_size=0.04))
    depth = np.zeros(SMALL.shape, np.float32)
    depth[SMALL.height // 2, SMALL.width // 2] = 1.0
    nothing.integrate(Frame(0.0, depth), np.eye(4))  # one reading makes no triangle
    empty = MapSurface(nothing, surface_points(nothing, np.zeros((1, 3)), 100))
    pair = decided(MapSurface(wall, of_wall), empty, [Hypothesis(np.eye(4), 3, 100)])
    assert pair.T_a_b is None
    assert pair.reason == "the second has no surface, its mesh is empty; leave that run out"
    assert pair.agreement is None


def run_folder(folder, found, times):
    folder.mkdir()
    found.saved.volume.save(folder / MAP_FILE)
    found.saved.save_keyframes(folder / KEYFRAME_FILE)
    Config().save(folder / "config.toml")
    Trajectory(np.array(times), np.tile(np.eye(4), (len(times), 1, 1))).save(folder / "trajectory.txt")
    return folder


def test_run_folders_are_merged_into_one_that_can_be_merged_again(room, same_room, tmp_path):
    a, b = run_folder(tmp_path / "a", room, [0.0, 1.0]), run_folder(tmp_path / "b", same_room, [0.0, 1.0, 2.0])
    out = tmp_path / "ab"
    tree = merge_runs(a, b, out)
    assert sorted(path.name for path in out.iterdir()) == [
        "config.toml", "keyframes.npz", "map.npz", "merge.json", "mesh.ply", "metrics.json", "trajectory-2.txt",
        "trajectory.txt",
    ]  # fmt: skip
    assert json.loads((out / "merge.json").read_text()) == tree
    np.testing.assert_allclose(Trajectory.load(out / "trajectory-2.txt").Ts_world_camera[1], tree["T_a_b"], atol=1e-6)
    shown = RunFiles.load(out)
    assert [frame.timestamp for frame in shown.figures()] == [0.0, 1.0]
    assert shown.mesh is not None
    assert 0.99 * tree["mesh_triangles"] < len(shown.mesh.faces) <= tree["mesh_triangles"]  # without the loose pieces
    assert "5 of 5 frames were tracked" in write_report(out, tmp_path / "report.html").read_text()
    merged = SavedMap.load(out)
    assert len(merged.keyframes) == len(room.saved.keyframes) + len(same_room.saved.keyframes)
    again = merge_runs(out, run_folder(tmp_path / "c", room, [5.0]), tmp_path / "abc")
    assert again["trajectories"] == ["trajectory.txt", "trajectory-2.txt", "trajectory-3.txt"]
    with pytest.raises(DudmapError, match="is one of the runs to be merged"):
        merge_runs(a, b, a)


def test_a_refused_merge_says_why_and_writes_nothing(room, tmp_path):
    desk = true_map(record("desk", 1, "handheld", frames=30))
    a, b = run_folder(tmp_path / "a", room, [0.0]), run_folder(tmp_path / "b", desk, [0.0])
    with pytest.raises(MapError, match="are not merged: too few places of one were recognised in the other"):
        merge_runs(a, b, tmp_path / "ab")
    assert not (tmp_path / "ab").exists()
