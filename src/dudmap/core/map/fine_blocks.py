"""Blocks with half the voxel size inside blocks of the next coarser level."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.octree_field import FinerLevels
from dudmap.core.backends.mirror import grown
from dudmap.core.backends.parameters import VoxelGrid
from dudmap.core.map.voxel_blocks import BLOCK, INTENSITY, BlockRecords, VoxelBlocks
from dudmap.core.state import Remembered, Stateful
from dudmap.errors import MapError

NO_VOXELS = np.zeros((1, BLOCK**3), dtype=np.int32)
NO_CHILDREN = np.full((0, 8), -1, dtype=np.int32)
OCTANTS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], dtype=np.int32)
"""Offset (8, 3) of each child in its parent, in child sizes; number 4 dx + 2 dy + dz."""


class FineBlocks(Stateful):
    """One level of refinement. A block covers one octant of its parent.

    Attributes:
        voxel_size: Metres.
        blocks: Blocks; coordinates in units of their own size.
        children: (slots of the parents, 8) int32 slot of the child in each octant, -1 = none.
        parents: (slots,) int32 slot of the parent.
        calm: (slots,) uint8 successive evaluations in which a block was not needed.
        voxels: Geometry and colours of all blocks, stored whole.
    """

    blocks: Remembered[VoxelBlocks]
    calm: Remembered[NDArray[np.uint8]]
    voxels: Remembered[tuple[NDArray[np.int32], NDArray[np.int32]]]

    def __init__(self, voxel_size: float, blocks: VoxelBlocks | None = None, finer: "FineBlocks | None" = None) -> None:
        self.voxel_size, self._finer = voxel_size, finer
        self.blocks = blocks or VoxelBlocks()
        self.children = np.full((0, 8), -1, dtype=np.int32)
        self.parents = np.full(len(self.blocks.entry_of), -1, dtype=np.int32)
        self.calm = np.zeros(len(self.blocks.entry_of), dtype=np.uint8)

    def state(self) -> dict[str, Any]:
        """The level without spare capacity."""
        m, blocks = self.blocks.num_slots, self.blocks
        return {"blocks": blocks, "calm": self.calm[:m], "voxels": (blocks.geometry[:m], blocks.colors[:m])}

    def restore(self, state: dict[str, Any]) -> None:
        """Restore a stored level, to be linked (``link``)."""
        blocks, (geometry, colors) = self.blocks, state["voxels"]
        if not len(state["calm"]) == len(geometry) == len(colors) == blocks.num_slots:
            raise ValueError("the arrays of the finer blocks have different lengths")
        blocks.write(np.arange(blocks.num_slots), geometry, colors)
        self.calm = grown(state["calm"], len(blocks.entry_of), 0)

    def make_room(self, parents: VoxelBlocks) -> None:
        """Grow the link arrays to the slots of parents and level."""
        if len(self.children) < len(parents.entry_of):
            self.children = grown(self.children, len(parents.entry_of), -1)
        if len(self.parents) < len(self.blocks.entry_of):
            self.parents = grown(self.parents, len(self.blocks.entry_of), -1)
            self.calm = grown(self.calm, len(self.blocks.entry_of), 0)

    def open(
        self, parents: VoxelBlocks, slots: NDArray[np.int32], octants: NDArray[np.int64], frame_number: int
    ) -> NDArray[np.int32]:
        """Create empty blocks in free octants (n,) of parents in slots (n,); returns their slots (n,) int32."""
        coords = (2 * parents.slot_coords[slots] + OCTANTS[octants]).astype(np.int32)
        entries = self.blocks.entries_at(coords, len(coords))
        new = self.blocks.allocate(entries, frame_number)
        self.make_room(parents)
        self.parents[new], self.calm[new] = slots, 0
        self.children[slots, octants] = new
        return new

    def drop(self, slots: NDArray[np.int32]) -> None:
        """Remove blocks (n,) and all finer ones inside."""
        if len(slots) == 0:
            return
        if self._finer is not None:
            self._finer.drop(self._finer.children_of(slots))
        octants = self.octants_of(slots)
        self.children[self.parents[slots], octants] = -1
        self.blocks.release(slots, 0)
        self.parents[slots] = -1

    def records(self, slots: NDArray[np.int32]) -> BlockRecords:
        """Copies of blocks (n,); ``free_count`` holds ``calm``."""
        owners = np.arange(len(slots), dtype=np.int32)
        voxels = self.blocks.geometry[slots], self.blocks.colors[slots], self.blocks.fused[slots]
        return BlockRecords(self.blocks.slot_coords[slots], self.calm[slots], owners, *voxels)

    def remove(self, slots: NDArray[np.int32], frame_number: int) -> None:
        """Remove blocks (n,) whose parents the caller removes next."""
        blocks = self.blocks
        self.children[self.parents[slots], self.octants_of(slots)] = -1
        self.parents[slots] = -1
        dropped = np.flatnonzero(blocks.slot_of[: blocks.num_entries] < 0)  # entries without slots
        blocks.remove(np.concatenate([blocks.entry_of[slots], dropped]), frame_number)

    def insert(self, parents: VoxelBlocks, records: BlockRecords, frame_number: int) -> None:
        """Add unknown blocks whose parents are already inserted."""
        slots = self.blocks.insert(replace(records, free_count=np.zeros_like(records.free_count)), frame_number)
        self.make_room(parents)
        self.calm[slots], self.parents[slots] = records.free_count, parents.slots_at(records.coords >> 1)
        self.children[self.parents[slots], self.octants_of(slots)] = slots

    def take_colors(
        self, slots: NDArray[np.int32], other: "FineBlocks", interpolated: tuple[NDArray[np.int32], NDArray[np.int32]]
    ) -> None:
        """Give blocks (n,) colours and intensities of this level of another map; missing ones take the ``interpolated``
        voxels and colours (n, 512)."""
        blocks, (voxels, colors) = self.blocks, interpolated
        there = other.blocks.slots_at(blocks.slot_coords[slots].astype(np.int32))
        painted = (there[:, None] >= 0) & (other.blocks.colors[there] != 0)
        colors = np.where(painted, other.blocks.colors[there], colors)
        intensities = np.where(painted, other.blocks.geometry[there], voxels) & INTENSITY
        blocks.write(slots, (blocks.geometry[slots] & ~INTENSITY) | intensities, colors)

    def octants_of(self, slots: NDArray[np.int32]) -> NDArray[np.int64]:
        """Octant (n,) of the parent that each block (n,) covers."""
        low = (self.blocks.slot_coords[slots] & 1).astype(np.int64)
        return 4 * low[:, 0] + 2 * low[:, 1] + low[:, 2]

    def children_of(self, slots: NDArray[np.int32]) -> NDArray[np.int32]:
        """Slots (n,) int32 of all children of parents in slots (m,), in the parents' order."""
        found = self.children[slots[slots < len(self.children)]].ravel()  # slots beyond the array have no children yet
        return found[found >= 0]

    def link(self, parents: VoxelBlocks) -> NDArray[np.bool_]:
        """Rebuild the parent links from coordinates; returns whether each active slot (n,) has a parent."""
        self.children = np.full((len(parents.entry_of), 8), -1, dtype=np.int32)
        self.parents = np.full(len(self.blocks.entry_of), -1, dtype=np.int32)
        self.calm = grown(self.calm[: len(self.parents)], len(self.parents), 0)
        slots = self.blocks.active_slots
        found = parents.slots_at((self.blocks.slot_coords[slots] >> 1).astype(np.int32))
        known = found >= 0
        self.parents[slots[known]] = found[known]
        self.children[found[known], self.octants_of(slots[known])] = slots[known]
        return known

    def grid(self, origin: NDArray[np.int64], sdf_unit: float) -> VoxelGrid:
        """The voxels for ``Backend.fuse``, relative to ``origin`` (3,), in blocks of this level."""
        coords = self.blocks.slot_coords
        coords = coords if not origin.any() else (coords - origin).astype(coords.dtype)
        nothing = np.empty(0, dtype=np.int32)
        return VoxelGrid(
            nothing, np.zeros(3, np.int64), origin, self.blocks.geometry, self.blocks.colors,
            coords, self.blocks.free_count, self.voxel_size, sdf_unit,
        )  # fmt: skip


class BlockTree:
    """Blocks of the coarsest level, the entries, with all finer blocks inside. Slots and memory count all levels,
    larger voxels first."""

    def __init__(self, blocks: VoxelBlocks, levels: Sequence[FineBlocks]) -> None:
        self.blocks, self.levels = blocks, levels

    @property
    def parents(self) -> list[VoxelBlocks]:
        """The next coarser level of each finer one."""
        return [self.blocks, *(level.blocks for level in self.levels)][: len(self.levels)]

    @property
    def num_slots(self) -> int:
        """Slots of all levels, in use or released."""
        return self.blocks.num_slots + sum(level.blocks.num_slots for level in self.levels)

    @property
    def num_voxel_blocks(self) -> int:
        """Blocks with voxels, of all levels."""
        return self.blocks.num_voxel_blocks + sum(level.blocks.num_voxel_blocks for level in self.levels)

    def owned_slots(self) -> NDArray[np.int64]:
        """Slots (entries,) of each entry and all blocks inside."""
        finest = self.levels[-1].blocks if self.levels else self.blocks
        inside = np.zeros(len(finest.entry_of), np.int64)
        for level, parents in zip(self.levels[::-1], self.parents[::-1], strict=True):
            active = level.blocks.active_slots
            inside = np.bincount(level.parents[active], 1 + inside[active], minlength=len(parents.entry_of))
        slots = self.blocks.slot_of[: self.blocks.num_entries]
        return np.where(slots >= 0, 1 + inside[slots].astype(np.int64), 0)

    def records(self, entries: NDArray[np.integer], *, by_slot: bool = False) -> BlockRecords:
        """Copies of entries (n,) and all blocks inside, see ``VoxelBlocks.records``."""
        out, finer = self.blocks.records(entries, by_slot=by_slot), []
        slots = self.blocks.slot_of[entries[out.owners]]
        for level in self.levels:
            slots = level.children_of(slots)
            finer.append(level.records(slots))
        return replace(out, finer=tuple(finer))

    def remove(self, entries: NDArray[np.integer], frame_number: int) -> None:
        """Remove entries (n,), their voxels and all blocks inside; see ``VoxelBlocks.remove``."""
        slots = self.blocks.slot_of[entries]
        slots, leaving = slots[slots >= 0], []
        for level in self.levels:
            slots = level.children_of(slots)
            leaving.append(slots)
        for level, slots in zip(self.levels[::-1], leaving[::-1], strict=True):
            level.remove(slots, frame_number)
        self.blocks.remove(entries, frame_number)

    def insert(self, records: BlockRecords, frame_number: int) -> None:
        """Add unknown blocks and the blocks inside them."""
        self.blocks.insert(records, frame_number)
        for level, parents, part in zip(self.levels, self.parents, records.finer, strict=False):
            level.insert(parents, part, frame_number)
        for level, parents in zip(self.levels, self.parents, strict=True):
            level.make_room(parents)

    def restore(self, finer: Sequence[VoxelBlocks]) -> None:
        """Fill the finer levels with read blocks.

        Raises:
            MapError: The blocks do not fit the levels or each other.
        """
        if len(finer) > len(self.levels):
            raise MapError(
                f"the map is damaged: it has {len(finer)} levels of smaller voxels, its configuration allows "
                f"{len(self.levels)}"
            )
        for number, level in enumerate(self.levels[: len(finer)]):
            level.blocks = finer[number]
            if not np.all(level.link(self.parents[number])):  # the parents were just read
                raise MapError(f"the map is damaged: blocks with voxels of {level.voxel_size} m have no parent block")
        for level, parents in zip(self.levels, self.parents, strict=True):
            level.make_room(parents)


def two_levels(levels: Sequence[FineBlocks]) -> FinerLevels:
    """The finer levels (at most two) in the form that ray casting reads."""
    if not levels:
        return FinerLevels()
    missing = [(NO_CHILDREN, NO_VOXELS, NO_VOXELS)] * (2 - len(levels))
    arrays = [(level.children, level.blocks.geometry, level.blocks.colors) for level in levels]
    return FinerLevels(*zip(*arrays, *missing, strict=True))
