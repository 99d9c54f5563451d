"""Merging of many runs: exact fusion in any order and any ranges, tiles by the rules of 3D Tiles, refusals."""

import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pygltflib
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dudmap.config import VolumeConfig
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.map import morton
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.saved_map import KEYFRAME_FILE, MAP_FILE
from dudmap.errors import ConfigError, DudmapError, MapError
from dudmap.evaluation.surface import Surface
from dudmap.fleet import fusion
from dudmap.fleet.fusion import T_GLTF_MAP, PlacedRun, fuse_range, planned_ranges, write_tile, write_tileset, write_tree
from dudmap.fleet.map_fusion import FusedRange, fuse_maps, joined
from dudmap.fleet.merge import merge_fleet
from dudmap.fleet.workers import MapHeader, Workers, check_runs
from rendered_places import record, true_map

SMALL = Camera(fx=60.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)
POSES = [np.eye(4), *[se3.exp(np.array([0.6 * k, 0.1, 0.02, 0.02, 0.1 * k, 0.03])) for k in (1, 2)]]


def wall(distance, shift):
    """Map of a wall seen from two places; the second map sees it farther away."""
    volume = TsdfVolume(SMALL, VolumeConfig(voxel_size=0.02))
    color = np.full((*SMALL.shape, 3), 90, np.uint8)
    for x in (0.0, shift):
        T = np.eye(4)
        T[0, 3] = x
        for _ in range(4):
            volume.integrate(Frame(0.0, np.full(SMALL.shape, distance, np.float32), color), T)
    return volume


@pytest.fixture(scope="module")
def walls(tmp_path_factory):
    """Three placed runs, and all maps."""
    volumes = [wall(1.5, 0.8), wall(1.9, 0.5), wall(1.5, -0.7)]
    runs = []
    for number, (volume, T) in enumerate(zip(volumes, POSES, strict=True)):
        folder = tmp_path_factory.mktemp(f"wall-{number}")
        volume.save(folder / MAP_FILE)
        runs.append(PlacedRun(folder, T))
    return runs, volumes


def fuse(runs, out, limit, workers=1, bits=9):
    """Ranges of some runs, with small cells so that there are many."""
    for name in ("map", "tiles", ".work"):
        shutil.rmtree(out / name, ignore_errors=True)
        (out / name).mkdir(parents=True)
    like = MapHeader.read(runs[0].folder / MAP_FILE)
    with pytest.MonkeyPatch.context() as patch, Workers(workers) as crew:
        patch.setattr(fusion, "CELL_BITS", bits)
        ranges = planned_ranges(runs, crew, limit)
        return list(crew.map(partial(fuse_range, like, out, out / ".work"), ranges))


def blocks_of(volume):
    """All blocks of a map."""
    blocks, n = volume.blocks, volume.blocks.num_entries
    has_voxels, slots = blocks.slot_of[:n] >= 0, blocks.slot_of[:n][blocks.slot_of[:n] >= 0]
    voxels = blocks.free_count[:n], blocks.geometry[slots], blocks.colors[slots]
    return FusedRange(morton.encode(blocks.coords[:n]), has_voxels, *voxels)


def content(blocks):
    """Blocks in the order of their codes."""
    order = np.argsort(blocks.codes)
    rows = np.cumsum(blocks.has_voxels) - 1
    rows = rows[order][blocks.has_voxels[order]]
    parts = blocks.codes[order], blocks.has_voxels[order], blocks.free_count[order]
    return *parts, blocks.geometry[rows], blocks.colors[rows]


@given(order=st.permutations(range(3)), limit=st.integers(1, 300))
@settings(max_examples=4, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_order_and_any_ranges_give_the_voxels_of_a_fusion_at_once(walls, tmp_path, order, limit):
    runs, volumes = walls
    expected = content(blocks_of(fuse_maps(volumes, POSES)))
    results = fuse([runs[n] for n in order], tmp_path, limit)
    parts = [blocks_of(TsdfVolume.load(tmp_path / entry["file"])) for entry, _ in results]
    for part, (entry, _) in zip(parts, results, strict=True):
        assert ((part.codes >= entry["codes"][0]) & (part.codes < entry["codes"][1])).all()
    for a, b in zip(content(joined(parts)), expected, strict=True):
        np.testing.assert_array_equal(a, b)


def test_two_processes_give_the_same_files(walls, tmp_path):
    runs, _ = walls
    for workers in (1, 2):
        fuse(runs, tmp_path / str(workers), 150, workers, bits=12)
    names = sorted(path.relative_to(tmp_path / "1") for path in (tmp_path / "1").rglob("*.*") if path.is_file())
    assert len(names) > 4
    for name in names:
        if name.suffix == ".npz":
            a, b = (blocks_of(TsdfVolume.load(tmp_path / w / name)) for w in "12")
            for left, right in zip(content(a), content(b), strict=True):
                np.testing.assert_array_equal(left, right)
        else:
            assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes()


def boxes(tile):
    """Corners of the bounding volume of a tile and of all below it, after checking the rules of the specification."""
    numbers = np.array(tile["boundingVolume"]["box"])
    assert numbers.shape == (12,)
    half = np.abs(numbers[3:].reshape(3, 3)).sum(axis=0)
    low, high = numbers[:3] - half, numbers[:3] + half
    assert tile["refine"] == "REPLACE"
    for child in tile.get("children", []):
        assert child["geometricError"] < tile["geometricError"]
        below, above = boxes(child)
        assert (below >= low - 1e-6).all()
        assert (above <= high + 1e-6).all()
    return low, high


def tiles_of(tile):
    return [tile, *(one for child in tile.get("children", []) for one in tiles_of(child))]


def test_tiles_keep_the_rules_of_3d_tiles_and_the_surface(walls, tmp_path):
    runs, volumes = walls
    leaves = [tile for _, tiles in fuse(runs, tmp_path, 100) for tile in tiles]
    with Workers(1) as crew:
        root = write_tree(leaves, 0.02, tmp_path, tmp_path / ".work", crew)
    write_tileset(root, 0.02, tmp_path)
    tree = json.loads((tmp_path / "tileset.json").read_text())
    assert tree["asset"]["version"] == "1.1"
    assert tree["geometricError"] > tree["root"]["geometricError"] > 0
    boxes(tree["root"])
    tiles = tiles_of(tree["root"])
    assert sorted(tile["content"]["uri"] for tile in tiles) == sorted(
        f"tiles/{path.name}" for path in (tmp_path / "tiles").iterdir()
    )
    area = 0.0
    for tile in tiles:
        path = tmp_path / tile["content"]["uri"]
        document = pygltflib.GLTF2().load(str(path))
        assert document.asset.version == "2.0"
        np.testing.assert_allclose(np.reshape(document.nodes[0].matrix, (4, 4)).T, T_GLTF_MAP)
        mesh = trimesh.load(path).to_geometry()
        points = mesh.vertices @ T_GLTF_MAP[:3, :3]  # the axes of the map again
        numbers = np.array(tile["boundingVolume"]["box"])
        assert (np.abs(points - numbers[:3]) <= np.diag(numbers[3:].reshape(3, 3)) + 1e-5).all()
        if "children" not in tile:
            assert tile["geometricError"] == 0
            area += mesh.area
    whole = fuse_maps(volumes, POSES).extract_mesh()
    np.testing.assert_allclose(area, whole.area(), rtol=1e-5)
    top = trimesh.load(tmp_path / tree["root"]["content"]["uri"]).to_geometry()
    assert 0 < len(top.faces) < len(whole.faces) / 4
    distance = Surface(whole, "the whole").distances((top.vertices @ T_GLTF_MAP[:3, :3]).astype(np.float32))
    assert distance.max() < tree["root"]["geometricError"]


def run_folder(folder, found):
    folder.mkdir()
    found.saved.volume.save(folder / MAP_FILE)
    found.saved.save_keyframes(folder / KEYFRAME_FILE)
    Trajectory(np.array([0.0, 1.0]), np.tile(np.eye(4), (2, 1, 1))).save(folder / "trajectory.txt")
    return folder


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """Two runs in one room, one at a desk elsewhere, and the true relative pose of the first two."""
    folder = tmp_path_factory.mktemp("places")
    room, other = true_map(record("room", 1, frames=45)), true_map(record("room", 3, "handheld", frames=45))
    desk = true_map(record("desk", 1, "handheld", frames=15))
    runs = [run_folder(folder / name, one) for name, one in (("room", room), ("desk", desk), ("other", other))]
    return runs, room.T_world_other(other)


def test_runs_become_a_world_and_a_run_elsewhere_is_named(places, tmp_path):
    runs, T = places
    report = merge_fleet(runs, tmp_path / "world")
    assert report.sentences == ["1 run(s) overlap no other and are left out: desk"]
    tree = json.loads((tmp_path / "world/world.json").read_text())
    assert [Path(run["folder"]).name for run in tree["runs"]] == ["room", "other"]
    error = se3.inverse(T) @ np.array(tree["runs"][1]["T_world_run"])
    assert np.linalg.norm(error[:3, 3]) < 0.01
    second = Trajectory.load(tmp_path / "world" / tree["runs"][1]["trajectories"][0])
    np.testing.assert_allclose(second.Ts_world_camera[1], tree["runs"][1]["T_world_run"], atol=1e-6)
    parts = [TsdfVolume.load(tmp_path / "world" / one["file"]) for one in tree["ranges"]]
    assert sum(part.num_blocks for part in parts) == tree["map_blocks"]
    assert (tmp_path / "world" / "tileset.json").is_file()
    assert not (tmp_path / "world" / ".work").exists()
    again = merge_fleet(runs[::2], tmp_path / "world")
    assert again.tree["map_blocks"] == tree["map_blocks"]


def test_runs_without_overlap_are_refused_and_nothing_is_written(places, tmp_path):
    with pytest.raises(MapError, match="no two of the 2 runs are joined, nothing is written: too few places"):
        merge_fleet(places[0][:2], tmp_path / "world")
    assert list((tmp_path / "world").iterdir()) == []


def test_bad_input_is_named_before_anything_is_computed(places, tmp_path):
    a, b, _ = places[0]
    with pytest.raises(ConfigError, match=r"found 1 run folder\(s\)"):
        check_runs([a], tmp_path)
    with pytest.raises(ConfigError, match="is named twice"):
        check_runs([a, b, a], tmp_path)
    with pytest.raises(DudmapError, match="is one of the runs to be merged"):
        check_runs([a, b], b)
    copy = Path(shutil.copytree(a, tmp_path / "copy"))
    (copy / KEYFRAME_FILE).unlink()
    with pytest.raises(MapError, match=r"copy holds no keyframes\.npz; name a complete run folder"):
        check_runs([a, copy], tmp_path)
    shutil.copy(a / KEYFRAME_FILE, copy)
    (copy / MAP_FILE).write_bytes((a / MAP_FILE).read_bytes()[:5000])
    with pytest.raises(MapError, match=r"map\.npz is cut off or damaged"):
        check_runs([a, copy], tmp_path)
    TsdfVolume(SMALL, VolumeConfig(voxel_size=0.05)).save(copy / MAP_FILE)
    with pytest.raises(ConfigError, match=r"has voxels of 0\.02 m and .*copy of 0\.05 m"):
        check_runs([a, copy], tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("mine")
    with pytest.raises(DudmapError, match="is not empty and holds no world"):
        merge_fleet([a, b], tmp_path / "full")


def test_a_world_of_one_tile_has_a_tileset(tmp_path):
    for name in ("tiles", "work"):
        (tmp_path / name).mkdir()
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    mesh = Mesh(triangle, np.array([[0, 1, 2]], np.int32), np.zeros((3, 3), np.uint8), np.zeros((3, 3), np.float32))
    leaf = write_tile(mesh, f"{5:013x}", 0, tmp_path, tmp_path / "work")
    with Workers(1) as crew:
        write_tileset(write_tree([leaf], 0.02, tmp_path, tmp_path / "work", crew), 0.02, tmp_path)
    tree = json.loads((tmp_path / "tileset.json").read_text())
    assert tree["geometricError"] > tree["root"]["geometricError"] == 0
