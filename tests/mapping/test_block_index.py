"""The index of blocks, its hash table and the window, against dictionaries."""

import numpy as np

from dudmap.config import VolumeConfig
from dudmap.core.backends.cpu import hashing
from dudmap.core.map.block_window import BlockWindow
from dudmap.core.map.volume import TsdfVolume
from wavy_wall import CAMERA, CONSTANT, box_before_wall, wall


def test_hash_table_agrees_with_a_dictionary():
    rng = np.random.default_rng(4)
    wanted = rng.integers(-50, 50, (5000, 3)).astype(np.int32)
    table, coords = np.full(6007, hashing.EMPTY, np.int32), np.empty((5000, 3), np.int16)
    entries, count = hashing.insert_all(table, coords, 0, wanted)
    expected: dict[tuple[int, ...], int] = {}
    for row in wanted:
        expected.setdefault(tuple(row), len(expected))
    assert count == len(expected)
    assert [expected[tuple(row)] for row in wanted] == entries.tolist()
    others = rng.integers(-60, 60, (3000, 3)).astype(np.int32)
    found = hashing.find_all(table, coords, others)
    assert found.tolist() == [expected.get(tuple(row), -1) for row in others]


def test_the_index_of_blocks_grows_like_a_dictionary():
    """Entries, coordinates and voxels of every block stay what they were while all arrays and the hash are enlarged."""
    volume = TsdfVolume(CAMERA, VolumeConfig(voxel_size=0.01), depth_max=4.0)
    volume.look_at(np.eye(4))
    rng, size = np.random.default_rng(5), int(np.prod(volume.window.shape))
    expected: dict[int, int] = {}
    marked: dict[int, int] = {}
    for batch in range(12):
        cells = rng.choice(size, 2500, replace=False).astype(np.int32)
        entries = volume.window.entries_of(cells, volume.blocks)
        assert entries.tolist() == [expected.setdefault(int(cell), len(expected)) for cell in cells]
        fresh = np.array([cell for cell in cells[:300].tolist() if cell not in marked], dtype=np.int32)
        volume.window.allocate(fresh, volume.blocks, 1)
        volume.blocks.geometry[volume.window.cells[fresh]] = fresh[:, None]
        marked |= {int(cell): batch for cell in fresh}
    assert volume.blocks.num_entries == len(expected) > 4 * (1 << 12)
    assert len(volume.blocks.table) > 1 << 14
    known = np.array(list(expected), dtype=np.int64)
    coords = np.stack(np.unravel_index(known, tuple(volume.window.shape)), axis=1) + volume.window.origin
    assert np.array_equal(volume.blocks.coords[: len(known)], coords)
    entries = volume.window.entries_of(known[::-1].astype(np.int32), volume.blocks)
    assert entries.tolist() == list(range(len(known)))[::-1]
    slots = volume.blocks.slot_of[[expected[cell] for cell in marked]]
    assert np.all(volume.blocks.geometry[slots] == np.array(list(marked))[:, None])
    assert np.array_equal(volume.window.cells[list(marked)], slots)


def test_the_window_is_a_copy_of_the_hash_table():
    """Also of blocks that were seen to be empty, and of those whose surface has come back."""
    volume = TsdfVolume(CAMERA, CONSTANT.model_copy(update={"carve_rate": 4, "voxel_size": 0.02}), depth_max=4.0)
    released, before = 0, np.empty(0, np.int32)
    for frame in (*[box_before_wall()] * 8, *[wall(3.0, bump=0.0)] * 16, *[box_before_wall()] * 3):
        volume.integrate(frame, np.eye(4))
        window = volume.window
        fresh = BlockWindow(volume.block_size, int(window.shape[0]))
        fresh.fill(window.origin, volume.blocks)
        np.testing.assert_array_equal(window.cells, fresh.cells)
        np.testing.assert_array_equal(np.sort(window.near), fresh.near)
        released += len(np.setdiff1d(before, fresh.near))
        before = fresh.near
    assert released > 0
