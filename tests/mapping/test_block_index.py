"""The host's index of a map follows one that was changed elsewhere."""

import numpy as np

from dudmap.kernels import hashing
from dudmap.mapping.block_index import BlockIndex
from dudmap.mapping.block_window import BlockWindow
from dudmap.mapping.voxel_blocks import VoxelBlocks


class Leader:
    """Stands for a device: blocks of its own, whose index is asked for."""

    def __init__(self, blocks):
        self.device, self.is_ahead, self.is_lost, self.blocks = "another", True, False, blocks

    @property
    def counts(self):
        raise AssertionError("the host asks for the index instead")

    def pull(self):
        self.is_ahead = self.is_lost
        return None if self.is_lost else self.blocks.arrays(np.arange(3, dtype=np.int32))


def grow(blocks, random, frame):
    """Blocks that come, and some that lose their voxels."""
    coords = np.unique(random.integers(-50, 50, (2500, 3)), axis=0).astype(np.int32)
    unknown = np.count_nonzero(hashing.find_all(blocks.table, blocks.coords, coords) < 0)
    entries = blocks.entries_at(coords, int(unknown))
    slots = blocks.allocate(entries[blocks.slot_of[entries] < 0][:300], frame)
    blocks.write(slots, *random.integers(1, 9, (2, len(slots), 512)).astype(np.int32))
    blocks.release(random.choice(blocks.active_slots, 50, replace=False), 4)


def test_the_host_follows_while_all_arrays_grow():
    """Entries, slots and the cells of the hash table are those of the leader; voxels of a slot that another block had
    are removed."""
    leader, host, random = VoxelBlocks(), VoxelBlocks(), np.random.default_rng(3)
    index = BlockIndex(host, BlockWindow(0.1, 16))
    for frame in range(1, 9):
        grow(leader, random, frame)
        had = host.arrays(np.empty(0, np.int32)).slot_coords.copy(), host.entry_of[: host.num_slots] >= 0
        index.copy = Leader(leader)
        index.reserve(leader.num_entries, leader.num_slots)
        held = index.to_read
        expected, found = (one.arrays(np.empty(0, np.int32)) for one in (leader, held))
        for name, array in expected._asdict().items():
            np.testing.assert_array_equal(getattr(found, name), array, err_msg=name)
        kept = had[1] & (held.entry_of[: len(had[1])] >= 0)
        kept &= np.all(held.slot_coords[: len(kept)] == had[0], axis=1)
        assert not held.geometry[: len(kept)][had[1] & ~kept].any()
        held.geometry[: held.num_slots] = leader.geometry[: held.num_slots]  # as they come down from a device
        held.colors[: held.num_slots] = leader.colors[: held.num_slots]
        assert np.array_equal(held.slots_at(held.coords[: held.num_entries]), held.slot_of[: held.num_entries])
        assert (index.copy.is_ahead, held.num_bytes) == (False, leader.num_bytes)
        assert index.blocks is held
        assert index.copy is None
    assert np.array_equal(held.table, leader.table)
    assert len(held.table) > 1 << 14
    assert len(held.entry_of) > 1 << 10


def test_the_host_keeps_a_whole_index_where_the_leader_is_lost():
    leader, host, random = VoxelBlocks(), VoxelBlocks(), np.random.default_rng(4)
    window = BlockWindow(0.1, 16)
    window.fill(np.full(3, -8), host)
    index = BlockIndex(host, window)
    for frame in range(1, 4):
        grow(leader, random, frame)
        index.copy = Leader(leader)
        index.copy.is_lost = frame == 3
        index.reserve(leader.num_entries, leader.num_slots)
        if frame < 3:
            expected = [array.copy() for array in index.to_read.arrays(np.empty(0, np.int32))]
    found = index.to_read.arrays(np.empty(0, np.int32))
    assert all(np.array_equal(one, other) for one, other in zip(found, expected, strict=True))
    assert index.copy is None
    assert host.geometry_mirror.used == host.num_slots < leader.num_slots
    inside = np.all((host.slot_coords >= -8) & (host.slot_coords < 8), axis=1)[: host.num_slots]
    np.testing.assert_array_equal(window.near, np.flatnonzero(inside & (host.entry_of[: host.num_slots] >= 0)))
