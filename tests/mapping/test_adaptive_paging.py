"""A map with several voxel sizes whose far blocks wait on disk is the map that is in memory as a whole."""

import numpy as np
import pytest

from dudmap.app.state.database import StateDatabase, StateReader
from dudmap.app.state.system import take_snapshot
from dudmap.config import SensorConfig
from dudmap.core.geometry import se3
from dudmap.core.geometry.mesh import joined
from dudmap.core.map.adaptive_volume import AdaptiveVolume
from dudmap.core.map.incremental_mesh import IncrementalMesh
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.scratch_store import ScratchStore
from dudmap.errors import MapError
from state_parts import restore
from triangles import triangles
from wavy_wall import CAMERA, CONSTANT, wall

SENSOR = SensorConfig(sigma_base=0.0005, sigma_scale=0.0005)
CONFIG = CONSTANT.model_copy(
    update={
        "min_weight": 1, "voxel_size": 0.02, "carving": True, "adaptive": True, "adaptive_levels": 2,
        "adaptive_bend": 0.2,
    }
)  # fmt: skip
DEPTH = 1.2
MAX_BLOCKS = 300
STRIP = np.zeros(CAMERA.shape, bool)
STRIP[18:30] = True
"""Rows of the image that are fused, so that the mesh is small."""
PATH = [*np.arange(0.0, 18.0, 0.25), *np.arange(18.0, -0.6, -0.7)]
"""Positions along a wall and back: finer blocks open on the way, and change or are dropped on the way back."""


def frame(number):
    image = wall(0.7 + 0.004 * (number % 3), number, bump=0.05)
    return image, se3.exp(np.array([PATH[number], 0, 0, 0, 0.05 * (number % 4), 0]))


def volume(limit=None, levels=2):
    config = CONFIG.model_copy(update={"adaptive_levels": levels})
    return AdaptiveVolume(CAMERA, config, SENSOR, DEPTH, max_blocks=limit)


def walk(volumes, numbers):
    for number in numbers:
        for each in volumes:
            each.integrate(*frame(number), STRIP)


def in_memory(one):
    return one.all_blocks.num_voxel_blocks


@pytest.fixture(scope="module")
def maps():
    whole, paged = volume(), volume(MAX_BLOCKS)
    most = 0
    for number in range(len(PATH)):
        walk([whole, paged], [number])
        most = max(most, in_memory(paged))
    return whole, paged, most


def content(one):
    """Everything that is known of each block of each level, by its coordinates."""
    out = {}
    for whole in one.records():
        for level, part in enumerate([whole, *whole.finer]):
            voxels = {int(row): n for n, row in enumerate(part.owners)}
            for n, coords in enumerate(part.coords):
                m = voxels.get(n)
                words = None
                if m is not None:
                    words = part.geometry[m].tobytes(), part.colors[m].tobytes(), int(part.fused[m])
                assert (level, *coords) not in out
                out[(level, *coords)] = int(part.free_count[n]), words
    return out


def assert_linked(one):
    for level, parents in zip(one.levels, one.all_blocks.parents, strict=True):
        slots = level.blocks.active_slots
        parent = level.parents[slots]
        np.testing.assert_array_equal(parents.slot_coords[parent], level.blocks.slot_coords[slots] >> 1)
        np.testing.assert_array_equal(level.children[parent, level.octants_of(slots)], slots)
        assert np.count_nonzero(level.children >= 0) == len(slots)


def test_memory_is_bounded_while_the_map_grows(maps):
    whole, paged, most = maps
    assert all(level.blocks.num_voxel_blocks > 200 for level in whole.levels)
    assert most < 0.65 * in_memory(whole)
    assert paged.num_blocks == whole.num_blocks
    assert paged.num_bytes < 0.75 * whole.num_bytes


def test_the_content_is_bit_for_bit_that_of_a_map_in_memory(maps):
    whole, paged, _ = maps
    assert content(paged) == content(whole)
    assert_linked(paged)


def test_views_are_those_of_a_map_in_memory(maps):
    whole, paged, _ = maps
    for position in (0.0, 8.0, 13.0):
        T = se3.exp(np.array([position, 0, 0, 0, 0.05, 0]))
        a, b = paged.raycast(T), whole.raycast(T)
        assert np.any(b.depth > 0)
        assert all(np.array_equal(*pair) for pair in zip(a, b, strict=True))


def test_meshes_in_pieces_and_live_are_that_of_a_map_in_memory():
    """Every triangle of every piece is one of the whole mesh, bit for bit, so that pieces meet without cracks."""
    whole, paged = volume(levels=1), volume(MAX_BLOCKS, levels=1)
    live = IncrementalMesh(paged)
    for number in [*range(0, 72, 2), *range(72, 80)]:
        walk([whole, paged], [number])
        if number % 6 == 0 or number > 70:  # on the way back what has changed may be gone some frames later
            live.update()
    expected = triangles(whole.extract_mesh())
    assert len(expected) > 20_000
    pieces = list(paged.extract_pieces())
    assert len(pieces) > 4
    np.testing.assert_array_equal(triangles(joined(pieces)), expected)
    np.testing.assert_array_equal(triangles(paged.extract_mesh()), expected)
    np.testing.assert_array_equal(triangles(live.mesh()), expected)


def test_a_paged_map_is_saved_whole_and_goes_on(maps, tmp_path):
    whole, paged, _ = maps
    paged.save(tmp_path / "paged.npz")
    whole.save(tmp_path / "whole.npz")
    again, expected = (TsdfVolume.load(tmp_path / f"{name}.npz") for name in ("paged", "whole"))
    assert content(again) == content(expected)
    assert {key: words and words[:2] for key, (_, words) in content(again).items()} == {
        key: words and words[:2] for key, (_, words) in content(whole).items()
    }
    limited = again.for_camera(CAMERA, max_blocks=MAX_BLOCKS)
    walk([limited, expected], range(4))
    walk([limited, expected], range(68, 73))
    assert limited.num_blocks > limited.blocks.num_voxel_blocks
    assert content(limited) == content(expected)
    assert_linked(limited)


def test_blocks_stay_in_memory_while_the_disk_is_full(monkeypatch):
    def full(self, region, records):
        raise MapError("the disk is full")

    monkeypatch.setattr(ScratchStore, "write", full)
    whole, paged = volume(), volume(MAX_BLOCKS)
    walk([whole, paged], range(50))
    assert paged.pager is not None
    paged.look_at(frame(0)[1])
    assert "disk is full" in paged.pager.failure
    assert content(paged) == content(whole)
    assert_linked(paged)


def test_a_paged_map_is_stored_and_goes_on(tmp_path):
    whole, paged = volume(), volume(MAX_BLOCKS)
    database = StateDatabase(tmp_path / "state.db")
    for number in range(len(PATH)):
        walk([whole, paged], [number])
        if number % 3 == 0:
            database.write(take_snapshot({"map": paged}, database), {})
        if number in (60, 84):
            database.close()
            reader, database = StateReader(tmp_path / "state.db"), StateDatabase(tmp_path / "state.db")
            paged = restore(reader, {"map": TsdfVolume}, database)["map"]
            assert paged.pager.num_blocks > 0
            assert content(paged) == content(whole)
            assert_linked(paged)
    assert content(paged) == content(whole)
    database.close()


def test_a_map_that_has_left_the_memory_is_stored_and_returns(tmp_path):
    one = volume(MAX_BLOCKS)
    walk([one], range(8))
    before = content(one)
    database = StateDatabase(tmp_path / "state.db")
    one.page_out()
    assert in_memory(one) == 0 < one.num_blocks
    database.write(take_snapshot({"map": one}, database), {})
    again = restore(StateReader(tmp_path / "state.db"), {"map": TsdfVolume})["map"]
    assert content(again) == content(one) == before
    walk([one, again], [3])
    assert content(again) == content(one)


def test_colors_are_taken_over_by_blocks_on_disk_too():
    volumes, others = ([volume(limit) for limit in (None, MAX_BLOCKS)] for _ in range(2))
    walk(volumes, range(50))
    for number in range(0, 50, 2):  # half of the frames: other blocks are refined
        image, T = frame(number)
        for other in others:
            other.integrate(type(image)(image.timestamp, image.depth, image.color[:, ::-1].copy()), T, STRIP)
    for one, other in zip(volumes, others, strict=True):
        one.take_colors(other)
        one.integrate(*frame(0), STRIP)
    assert content(volumes[0]) == content(volumes[1])
