"""Blocks of a map in memory and on disk."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.config import VolumeConfig
from dudmap.core.map.block_pager import REGION, BlockPager, regions_of
from dudmap.core.map.block_window import BlockWindow
from dudmap.core.map.fine_blocks import BlockTree, FineBlocks
from dudmap.core.map.memory_limit import MemoryLimit
from dudmap.core.map.voxel_blocks import BlockRecords, VoxelBlocks
from dudmap.core.state import Remembered, Stateful


class PagedMap(Stateful):
    """Block management of ``TsdfVolume``, which documents the attributes."""

    config: VolumeConfig
    block_size: float
    _window_cells: int
    blocks: Remembered[VoxelBlocks]
    levels: Remembered[Sequence[FineBlocks]]
    window: Remembered[BlockWindow]
    pager: Remembered[BlockPager | None]
    _frame_number: Remembered[int]
    num_frames: Remembered[int] = 0
    _left: Remembered[NDArray[np.int64] | None]  # origin of the window when all blocks left the memory

    def restore(self, state: dict[str, Any]) -> None:
        """Restore a stored map except the coarsest voxels.

        Raises:
            ValueError: Its parts do not fit each other.
        """
        super().restore(state)
        parents = self.blocks
        for level in self.levels:
            if not np.all(level.link(parents)):
                raise ValueError("blocks with smaller voxels have no parent block")
            parents = level.blocks
        self.window.refill(self.blocks)

    @property
    def all_blocks(self) -> BlockTree:
        """The blocks in memory of all levels."""
        return BlockTree(self.blocks, self.levels)

    @property
    def num_blocks(self) -> int:
        """Blocks with voxels, in memory and on disk."""
        return self.blocks.num_voxel_blocks + (self.pager.num_blocks if self.pager else 0)

    @property
    def is_empty(self) -> bool:
        """Whether no frame has been integrated yet."""
        return self.num_blocks == 0

    @property
    def num_bytes(self) -> int:
        """Memory of the map (``VoxelBlocks.num_bytes``), without the window."""
        return self.blocks.num_bytes

    @property
    def active_slots(self) -> NDArray[np.int32]:
        """Slots (n,) int32 with voxels, ascending."""
        return self.blocks.active_slots

    @property
    def view_bytes(self) -> int:
        """Memory of the voxels around the view."""
        slots, count = self.window.near, len(self.window.near)
        for level in self.levels:
            slots = level.children_of(slots)
            count += len(slots)
        return count * self.blocks.slot_bytes

    def _new_blocks(self) -> VoxelBlocks:
        """Empty blocks; under a memory limit they reserve address space."""
        blocks, limit = VoxelBlocks(), None if self.pager is None else self.pager.max_blocks
        return VoxelBlocks(limit.limit // blocks.slot_bytes) if isinstance(limit, MemoryLimit) else blocks

    def _empty(self) -> None:
        self.levels = []
        self.blocks, self.window = self._new_blocks(), BlockWindow(self.block_size, self._window_cells)

    def page_out(self) -> None:
        """Move all blocks to disk, if paging is enabled."""
        if self.pager is None or self.blocks.num_entries == 0:
            return
        if self.pager.page_out(self.all_blocks, self._frame_number):
            self._left = self._left if self.window.origin is None else self.window.origin
            self._empty()

    def _place_window(self, origin: NDArray[np.int64]) -> None:
        self._bring(origin, origin + self.window.shape)
        self.window.fill(origin, self.blocks)

    def _bring(self, low: NDArray[np.integer], high: NDArray[np.integer]) -> None:
        if self.pager is not None:
            self.pager.focus(self.all_blocks, low, high, self._frame_number)

    def _visited_regions(self) -> Iterator[NDArray[np.int32]]:
        """First block of each region, which is in memory with its neighbours until the next."""
        for region in regions_of(self.all_blocks, self.pager):
            first = np.array(region, dtype=np.int32) * REGION
            self._bring(first, first + REGION)
            yield first
        if self.pager is not None and self.window.origin is not None:
            self._place_window(self.window.origin)

    def records(self) -> Iterator[BlockRecords]:
        """Copies of all blocks: one part if all are in memory, else one per region."""
        if self.pager is None:
            yield self.all_blocks.records(np.arange(self.blocks.num_entries), by_slot=True)  # in the order of the mesh
            return
        for first in self._visited_regions():
            yield self.all_blocks.records(self.blocks.entries_in(first, first + REGION))

    def take_colors(self, other: "PagedMap") -> None:
        """Replace colours and intensities from another map of the same world. A voxel without colour there takes the
        next measurement's."""
        assert other.config == self.config
        number = self._frame_number + 1
        for level in range(1 + len(self.levels)):
            for first in self._visited_regions():
                other._bring(first, first + REGION)
                slots = self.blocks.slot_of[self.blocks.entries_in(first, first + REGION)]
                slots = slots[slots >= 0]
                self._take_level_colors(level, slots, other, number)
                self.blocks.written[slots] = number
                if self.pager is not None:
                    self.pager.changed(first)
        self._frame_number = number

    def _take_level_colors(self, level: int, slots: NDArray[np.int32], other: "PagedMap", number: int) -> None:
        """Replace the colours of a level (0 = coarsest) within coarsest blocks; frame ``number`` wrote them."""
        assert level == 0
        self.blocks.take_colors(slots, other.blocks)

    @property
    def num_integrated(self) -> int:
        """Number of integrated frames."""
        return self._frame_number

    def written_since(self, num_integrated: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Slots (n,) int32 written or released after frame ``num_integrated``, and the coordinates (n, 3) int32 of
        their last or new blocks."""
        blocks = self.blocks
        slots = np.flatnonzero(blocks.written[: blocks.num_slots] > num_integrated).astype(np.int32)
        return slots, blocks.slot_coords[slots].astype(np.int32)

    def slots_at(self, coords: NDArray[np.int32]) -> NDArray[np.int32]:
        """Slots (n,) int32 at coordinates (n, 3) int32; -1 = no voxels."""
        return self.blocks.slots_at(coords)
