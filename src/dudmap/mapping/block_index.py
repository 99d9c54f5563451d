"""Blocks and window of a map, of which a device may be ahead that numbers new blocks itself."""

import numpy as np
from numpy.typing import NDArray

from dudmap.kernels.block_index import DeviceIndex, IndexArrays
from dudmap.kernels.parameters import VoxelGrid
from dudmap.mapping.block_window import BlockWindow
from dudmap.mapping.voxel_blocks import MAX_COORDINATE, VoxelBlocks


class BlockIndex:
    """Where the blocks of a map are; see ``kernels/block_index.py``.

    The host follows the device when the blocks are asked for here; where they may be changed, the device has to take
    them over again.

    Args:
        blocks, window: In the host's memory.
        on_host: Whether no device may number blocks, since the host needs the index in every frame.

    Attributes:
        copy: The index on a device; None = the host's is the only one.
    """

    def __init__(self, blocks: VoxelBlocks, window: BlockWindow, *, on_host: bool = False) -> None:
        self._blocks, self._window, self.on_host = blocks, window, on_host
        self.copy: DeviceIndex | None = None

    @property
    def blocks(self) -> VoxelBlocks:
        """The blocks, up to date; they may be changed."""
        self.leave()
        return self._blocks

    @property
    def window(self) -> BlockWindow:
        """The window, up to date; it may be changed."""
        self.leave()
        return self._window

    @property
    def place(self) -> BlockWindow:
        """The window, for where it is alone: its cells and slots may be those of an earlier frame."""
        return self._window

    @property
    def held(self) -> VoxelBlocks:
        """The blocks, for their mirrors of voxels alone: all else may be that of an earlier frame."""
        return self._blocks

    @property
    def to_read(self) -> VoxelBlocks:
        """The blocks, up to date; they must not be changed."""
        self.catch_up()
        return self._blocks

    @property
    def may_lead(self) -> bool:
        """Whether a device may number the blocks: the host also refuses what lies too far away."""
        origin = self._window.origin
        if self.on_host or origin is None:
            return False
        return bool(origin.min() > -MAX_COORDINATE and (origin + self._window.shape).max() < MAX_COORDINATE)

    @property
    def num_voxel_blocks(self) -> int:
        """Blocks that own voxels."""
        if self._ahead is None:
            return self._blocks.num_voxel_blocks
        return self._ahead.counts.slots - self._ahead.counts.released

    @property
    def num_near(self) -> int:
        """Blocks in the window that own voxels."""
        return len(self._window.near) if self._ahead is None else self._ahead.counts.near

    def slots_at(self, coords: NDArray[np.int32]) -> NDArray[np.int32]:
        """Slots (n,) int32 of the blocks at coordinates (n, 3) int32 in the window; -1 where there are no voxels."""
        if self.copy is not None and self._window.origin is not None:
            cells = self._window.cells_at(coords)
            found = self._window.mirror.take(np.maximum(cells, 0), np.zeros_like(cells))
            if not self.copy.is_lost:
                return np.where(cells >= 0, np.maximum(found, -1), -1).astype(np.int32)
        return self.to_read.slots_at(coords)

    def arrays(self) -> IndexArrays:
        """See ``kernels.block_index.BlockIndex``."""
        self.catch_up()
        return self._blocks.arrays(self._window.near)

    def reserve(self, entries: int, slots: int) -> None:
        """See ``kernels.block_index.BlockIndex``."""
        self._blocks.reserve_entries(entries)
        self._blocks.reserve_slots(slots)
        for mirror in (self._blocks.geometry_mirror, self._blocks.colors_mirror):
            mirror.use(slots)

    def refreshed(self, grid: VoxelGrid) -> VoxelGrid:
        """See ``kernels.block_index.BlockIndex``."""
        self.catch_up()
        return grid._replace(slot_coords=self._blocks.slot_coords, free_count=self._blocks.free_count)

    def leave(self) -> None:
        """See ``kernels.block_index.BlockIndex``."""
        self.catch_up()
        self.copy = None

    def catch_up(self) -> None:
        """Bring the host up to date. Where the device has failed, it stays as it was when it was last."""
        ahead = self._ahead
        if ahead is None:
            return
        index = ahead.pull()
        if index is not None:
            self._blocks.follow(index)
            self._window.follow(index.near, self._blocks)
            return
        self.copy = None
        self._blocks.use_slots(self._blocks.num_slots)
        if self._window.origin is not None:
            self._window.fill(self._window.origin, self._blocks)

    @property
    def _ahead(self) -> DeviceIndex | None:
        """The index on a device that has changed it."""
        return self.copy if self.copy is not None and self.copy.is_ahead else None
