"""A run with a memory limit has the result of a run without one."""

from dataclasses import replace

import numpy as np
import pytest

from dudmap.config import Config
from dudmap.core.geometry.mesh import Mesh, joined
from dudmap.core.geometry.mesh_pieces import load_simplified, save_pieces
from dudmap.core.map.fine_blocks import BlockTree
from dudmap.core.map.memory_limit import MemoryLimit, resident_bytes
from dudmap.core.map.voxel_blocks import VoxelBlocks
from dudmap.core.slam import Slam
from dudmap.errors import ConfigError
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA
from ring_corridor import ring_corridor
from triangles import triangles

FRAMES = 58
SETTINGS = [
    "volume.voxel_size=0.01", "preprocess.depth_max=3", "loops.keep_distance=0.3", "dynamics.start_seconds=0",
]  # fmt: skip


@pytest.fixture(scope="module")
def corridor():
    recording = ring_corridor(40, speed=1.8, camera=DEFAULT_CAMERA.resized(160, 120))
    return recording.camera, [recording[index] for index in range(FRAMES)]


def processed(corridor, max_blocks=None, dark=(), settings=()):
    config = Config().override([*SETTINGS, *settings])
    camera, frames = corridor
    slam, most = Slam(camera, config, max_blocks=max_blocks), 0
    for index, frame in enumerate(frames):
        slam.process(replace(frame, depth=np.zeros_like(frame.depth)) if index in dark else frame)
        most = max(most, sum(volume.blocks.num_voxel_blocks for volume in slam.atlas.volumes.values()))
    return slam, most


def test_the_result_is_that_of_a_run_in_memory(corridor, monkeypatch):
    """Also with a second submap, begun in the dark: the first then waits on disk as a whole."""
    monkeypatch.setattr("dudmap.core.places.place_recognition.MAX_CORRECTION", 1e-6)
    options = {"dark": range(23, 31), "settings": ["submaps.patience=0.2"]}
    whole, all_blocks = processed(corridor, **options)
    paged, most = processed(corridor, max_blocks=6000, **options)
    assert most < 0.9 * all_blocks
    assert len(whole.maps) == len(paged.maps) == 2
    assert min(len(trajectory) for trajectory, _ in whole.maps) > 10
    for (path, volume), (expected_path, expected) in zip(paged.maps, whole.maps, strict=True):
        assert np.array_equal(path.Ts_world_camera, expected_path.Ts_world_camera)
        assert np.array_equal(triangles(volume.extract_mesh()), triangles(expected.extract_mesh()))


def test_a_limit_is_met_by_what_is_left_for_the_map():
    limit = MemoryLimit(2 * resident_bytes() + 1_000_000_000)
    blocks = VoxelBlocks()
    expected = (0.75 * limit.limit - resident_bytes()) / 4.1e3
    assert 0.9 * expected < limit(BlockTree(blocks, ())) < 1.1 * expected
    blocks.num_slots += 1000  # slots that were provided are resident, used or not
    assert limit(BlockTree(blocks, ())) >= 1000
    with pytest.raises(ConfigError, match="found a memory limit of 1 MB; the program takes"):
        MemoryLimit(1_000_000)


def grid(step, offset):
    """Square of two triangles per cell."""
    u, v = np.meshgrid(np.arange(40.0), np.arange(40.0), indexing="ij")
    vertices = np.stack([step * u + offset, step * v, 0 * u], axis=-1).reshape(-1, 3).astype(np.float32)
    first = (np.arange(39)[:, None] * 40 + np.arange(39)).reshape(-1)
    faces = np.concatenate([first[:, None] + (0, 40, 41), first[:, None] + (0, 41, 1)]).astype(np.int32)
    up = np.tile(np.float32([0, 0, 1]), (len(vertices), 1))
    return Mesh(vertices, faces, np.full((len(vertices), 3), 90, np.uint8), up)


def test_a_mesh_written_in_pieces_is_their_union(tmp_path):
    pieces = [grid(0.01, 0.0), grid(0.01, 0.39), grid(0.01, 2.0)]
    counts = save_pieces(iter(pieces), tmp_path / "mesh.ply")
    whole = joined(pieces)
    loaded = Mesh.load(tmp_path / "mesh.ply")
    assert counts == (len(whole.vertices), len(whole.faces))
    for name in ("vertices", "faces", "colors", "normals"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(whole, name))


def test_a_large_mesh_is_simplified_as_it_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr("dudmap.core.geometry.mesh_pieces.FACES_AT_ONCE", 2000)
    pieces = [grid(0.01, 0.0), grid(0.01, 0.39), grid(0.01, 2.0)]
    save_pieces(iter(pieces), tmp_path / "mesh.ply")
    small = load_simplified(tmp_path / "mesh.ply", 1000)
    assert 100 < len(small.faces) <= 1000
    assert small.area() == pytest.approx(joined(pieces).area(), rel=0.15)
    assert np.all(small.colors == 90)
    every = load_simplified(tmp_path / "mesh.ply", 100_000)
    assert every.area() == pytest.approx(joined(pieces).area(), rel=1e-4)
