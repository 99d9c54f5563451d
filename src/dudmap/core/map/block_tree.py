"""The blocks of a map with several voxel sizes that are in memory, with those inside them, as they leave and return."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dudmap.core.map.fine_blocks import FineBlocks
from dudmap.core.map.voxel_blocks import BlockRecords, VoxelBlocks


class BlockTree:
    """Blocks of the coarsest level together with the finer ones that lie in them, for ``BlockPager``.

    Entries are those of the coarsest level; slots and memory count for all levels.

    Args:
        blocks: The coarsest level.
        levels: The finer ones, that with the larger voxels first.
    """

    def __init__(self, blocks: VoxelBlocks, levels: Sequence[FineBlocks]) -> None:
        self.blocks, self.levels = blocks, levels

    @property
    def parents(self) -> list[VoxelBlocks]:
        """The next coarser level of each finer one."""
        return [self.blocks, *(level.blocks for level in self.levels)][: len(self.levels)]

    @property
    def coords(self) -> NDArray[np.int32]:
        """See ``VoxelBlocks``."""
        return self.blocks.coords

    @property
    def slot_of(self) -> NDArray[np.int32]:
        """See ``VoxelBlocks``."""
        return self.blocks.slot_of

    @property
    def num_entries(self) -> int:
        """See ``VoxelBlocks``."""
        return self.blocks.num_entries

    @property
    def num_slots(self) -> int:
        """Slots of all levels, in use or released."""
        return self.blocks.num_slots + sum(level.blocks.num_slots for level in self.levels)

    @property
    def slot_bytes(self) -> int:
        """Bytes of a slot; that of a finer block has no more than its links besides, one in a hundred."""
        return self.blocks.slot_bytes

    @property
    def num_voxel_blocks(self) -> int:
        """Blocks of all levels that own voxels."""
        return self.blocks.num_voxel_blocks + sum(level.blocks.num_voxel_blocks for level in self.levels)

    def owned_slots(self) -> NDArray[np.int64]:
        """Number (entries,) of slots of each entry and of all blocks inside it."""
        finest = self.levels[-1].blocks if self.levels else self.blocks
        inside = np.zeros(len(finest.entry_of), np.int64)
        for level, parents in zip(self.levels[::-1], self.parents[::-1], strict=True):
            active = level.blocks.active_slots
            inside = np.bincount(level.parents[active], 1 + inside[active], minlength=len(parents.entry_of))
        slots = self.blocks.slot_of[: self.blocks.num_entries]
        return np.where(slots >= 0, 1 + inside[slots].astype(np.int64), 0)

    def records(self, entries: NDArray[np.integer], *, by_slot: bool = False) -> BlockRecords:
        """Copies of the blocks of entries (n,), see ``VoxelBlocks.records``, and of all blocks inside them."""
        out, finer = self.blocks.records(entries, by_slot=by_slot), []
        slots = self.blocks.slot_of[entries[out.owners]]
        for level in self.levels:
            slots = level.children_of(slots)
            finer.append(level.records(slots))
        return replace(out, finer=tuple(finer))

    def remove(self, entries: NDArray[np.integer], frame_number: int) -> None:
        """Forget entries (n,), their voxels and all blocks inside them; see ``VoxelBlocks.remove``."""
        slots = self.blocks.slot_of[entries]
        slots, leaving = slots[slots >= 0], []
        for level in self.levels:
            slots = level.children_of(slots)
            leaving.append(slots)
        for level, slots in zip(self.levels[::-1], leaving[::-1], strict=True):
            level.remove(slots, frame_number)
        self.blocks.remove(entries, frame_number)

    def insert(self, records: BlockRecords, frame_number: int) -> None:
        """Add blocks, none of which is known, and those inside them."""
        self.blocks.insert(records, frame_number)
        for level, parents, part in zip(self.levels, self.parents, records.finer, strict=False):
            level.insert(parents, part, frame_number)
        for level, parents in zip(self.levels, self.parents, strict=True):
            level.make_room(parents)
