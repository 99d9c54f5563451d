"""A map whose far blocks wait on disk is the map that is in memory as a whole."""

import sqlite3

import numpy as np
import pytest

from dudmap.app.state.database import StateDatabase, StateReader
from dudmap.app.state.system import take_snapshot
from dudmap.core.geometry import se3
from dudmap.core.map.block_pager import REGION, BlockPager
from dudmap.core.map.fine_blocks import BlockTree
from dudmap.core.map.incremental_mesh import IncrementalMesh
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.map.voxel_blocks import VoxelBlocks
from dudmap.core.scratch_store import ScratchStore
from dudmap.errors import MapError
from state_parts import restore
from triangles import triangles
from wavy_wall import CAMERA, CONSTANT, wall

CONFIG = CONSTANT.model_copy(update={"min_weight": 1, "voxel_size": 0.02, "carving": True})
DEPTH = 3.0
MAX_BLOCKS = 400
PATH = [*np.arange(0.0, 21.0, 1.5), *np.arange(21.0, -1.0, -3.0)]
"""Positions along a wall and back: other voxels on the way back, and many windows apart at the far end."""


def frame(number):
    return wall(1.5 + 0.05 * (number % 3), number), se3.exp(np.array([PATH[number], 0, 0, 0, 0.1 * (number % 4), 0]))


@pytest.fixture(scope="module")
def maps():
    whole, paged = TsdfVolume(CAMERA, CONFIG, depth_max=DEPTH), TsdfVolume(
        CAMERA, CONFIG, depth_max=DEPTH, max_blocks=MAX_BLOCKS
    )  # fmt: skip
    most = 0
    for number in range(len(PATH)):
        for volume in (whole, paged):
            volume.integrate(*frame(number))
        most = max(most, paged.blocks.num_voxel_blocks)
    return whole, paged, most


def content(volume):
    """Everything that is known of each block, by its coordinates."""
    out = {}
    for part in volume.records():
        voxels = {int(row): n for n, row in enumerate(part.owners)}
        for n, coords in enumerate(part.coords):
            m = voxels.get(n)
            words = None if m is None else (part.geometry[m].tobytes(), part.colors[m].tobytes(), int(part.fused[m]))
            assert tuple(coords) not in out
            out[tuple(coords)] = int(part.free_count[n]), words
    return out


def test_memory_is_bounded_while_the_map_grows(maps):
    whole, paged, most = maps
    assert whole.num_blocks > 8 * MAX_BLOCKS
    assert most < 0.6 * whole.num_blocks  # the regions that the window meets are never sent away
    assert paged.num_blocks == whole.num_blocks
    assert paged.num_bytes < 0.7 * whole.num_bytes


def test_the_content_is_bit_for_bit_that_of_a_map_in_memory(maps):
    whole, paged, _ = maps
    assert content(paged) == content(whole)
    assert paged.blocks.num_voxel_blocks < 0.6 * whole.num_blocks


def test_mesh_and_views_are_those_of_a_map_in_memory(maps):
    whole, paged, _ = maps
    assert np.array_equal(triangles(paged.extract_mesh()), triangles(whole.extract_mesh()))
    for position in (0.0, 10.0, 20.0):
        T = se3.exp(np.array([position, 0, 0, 0, 0.05, 0]))
        a, b = paged.raycast(T), whole.raycast(T)
        assert np.any(b.depth > 0)
        assert all(np.array_equal(*pair) for pair in zip(a, b, strict=True))


def test_a_paged_map_is_saved_whole(maps, tmp_path):
    whole, paged, _ = maps
    paged.save(tmp_path / "map.npz")
    assert content(TsdfVolume.load(tmp_path / "map.npz")) == {
        coords: (free, words and (*words[:2], 0)) for coords, (free, words) in content(whole).items()
    }


def test_colors_are_taken_over_by_blocks_on_disk_too():
    volumes = [TsdfVolume(CAMERA, CONFIG, depth_max=DEPTH, max_blocks=limit) for limit in (None, MAX_BLOCKS)]
    others = [TsdfVolume(CAMERA, CONFIG, depth_max=DEPTH, max_blocks=limit) for limit in (None, MAX_BLOCKS)]
    for volume, other in zip(volumes, others, strict=True):
        for number in range(12):
            volume.integrate(*frame(number))
            image, T = frame(number)
            other.integrate(type(image)(image.timestamp, image.depth, image.color[:, ::-1].copy()), T)
        volume.take_colors(other)
        volume.integrate(*frame(0))
    assert content(volumes[0]) == content(volumes[1])


def test_a_live_mesh_keeps_what_waits_on_disk():
    whole, paged = (TsdfVolume(CAMERA, CONFIG, depth_max=DEPTH, max_blocks=limit) for limit in (None, MAX_BLOCKS))
    live = IncrementalMesh(paged)
    for number in range(len(PATH)):
        whole.integrate(*frame(number))
        paged.integrate(*frame(number))
        live.update()
    np.testing.assert_array_equal(triangles(live.mesh()), triangles(whole.extract_mesh()))


def test_blocks_stay_in_memory_while_the_disk_is_full(monkeypatch):
    def full(self, region, records):
        raise MapError("the disk is full")

    whole, paged = (TsdfVolume(CAMERA, CONFIG, depth_max=DEPTH, max_blocks=limit) for limit in (None, MAX_BLOCKS))
    with monkeypatch.context() as patch:
        patch.setattr(ScratchStore, "write", full)
        for number in range(12):
            whole.integrate(*frame(number))
            paged.integrate(*frame(number))
        paged.look_at(se3.exp(np.array([0.0, 0, 0, 0, 0, 0])))
        assert "disk is full" in paged.pager.failure
        assert content(paged) == content(whole)


def test_an_unreadable_store_is_reported(maps, monkeypatch):
    class Broken:
        def execute(self, *arguments):
            raise sqlite3.OperationalError("disk I/O error")

    store = ScratchStore("blocks of the map")
    monkeypatch.setattr(store, "_connection", Broken())
    with pytest.raises(MapError, match=r"cannot be read from .*disk I/O error"):
        store.read("(0, 0, 0)")


def test_a_paged_map_is_stored_and_goes_on(tmp_path):
    """The map, its regions on disk included, is in a database after each checkpoint, whatever came and went between."""
    whole, paged = (TsdfVolume(CAMERA, CONFIG, depth_max=DEPTH, max_blocks=limit) for limit in (None, MAX_BLOCKS))
    database = StateDatabase(tmp_path / "state.db")
    for number in range(len(PATH)):
        whole.integrate(*frame(number))
        paged.integrate(*frame(number))
        if number % 3 == 0:
            database.write(take_snapshot({"map": paged}, database), {})
        if number in (12, 18):
            database.close()
            reader, database = StateReader(tmp_path / "state.db"), StateDatabase(tmp_path / "state.db")
            paged = restore(reader, {"map": TsdfVolume}, database)["map"]
            assert paged.pager.num_blocks > 0
            assert content(paged) == content(whole)
    assert content(paged) == content(whole)
    database.close()


def test_a_map_that_has_left_the_memory_is_stored_and_goes_on(tmp_path):
    """All its blocks leave between two checkpoints; some have come back into other slots since."""
    volume = TsdfVolume(CAMERA, CONFIG, depth_max=DEPTH, max_blocks=MAX_BLOCKS)
    database = StateDatabase(tmp_path / "state.db")
    for number in range(8):
        volume.integrate(*frame(number))
    database.write(take_snapshot({"map": volume}, database), {})
    volume.page_out()
    assert volume.blocks.num_voxel_blocks == 0 < volume.num_blocks
    for came_back in (False, True):
        if came_back:
            volume.look_at(frame(2)[1])
        database.write(take_snapshot({"map": volume}, database), {})
        again = restore(StateReader(tmp_path / "state.db"), {"map": TsdfVolume})["map"]
        assert content(again) == content(volume)
        if not came_back:
            volume.page_out()
    for each in (volume, again):
        each.integrate(*frame(3))
    assert content(again) == content(volume)


def scattered(*starts):
    """Blocks, each in a region of its own along x, 20 regions from each start (block coordinates)."""
    blocks = VoxelBlocks()
    coords = np.array([(start + REGION * n, 0, 0) for start in starts for n in range(20)], np.int32)
    blocks.allocate(blocks.entries_at(coords, len(coords)), 1)
    return BlockTree(blocks, ())


def seen(pager, blocks, start):
    pager.focus(blocks, np.array([start + 8, 0, 0]), np.array([start + 19 * REGION, 8, 8]), 1)


def test_what_is_far_leaves_before_what_is_near_comes(monkeypatch):
    blocks, pager = scattered(0, 2000), BlockPager(25)
    seen(pager, blocks, 0)
    assert blocks.num_voxel_blocks <= 25
    insert, most = VoxelBlocks.insert, []

    def counted(self, *rest):
        insert(self, *rest)
        most.append(self.num_voxel_blocks)

    monkeypatch.setattr(VoxelBlocks, "insert", counted)
    seen(pager, blocks, 2000)
    assert len(most) >= 15
    assert max(most) <= 25
