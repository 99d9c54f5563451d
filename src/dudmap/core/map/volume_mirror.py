"""Copy of a growing volume that another thread may read."""

import copy

import numpy as np
from numpy.typing import NDArray

from dudmap.core.map.fine_blocks import FineBlocks
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.map.voxel_blocks import VoxelBlocks, grown

GROWTH = 4
"""Capacity in units of the volume's: growing copies all blocks at once, spare capacity is only address space."""


class VolumeMirror:
    """Copy of a volume, brought up to date by copying only the blocks that were written since they were copied.

    ``update`` runs in the thread that changes the volume; between two updates any thread may read its copy ``volume``
    (``extract_mesh``, ``IncrementalMesh``), whose frames count the updates.
    """

    def __init__(self, volume: TsdfVolume) -> None:
        self.volume = copy.copy(volume)
        self._source = volume
        self._start()

    def _start(self) -> None:
        self.volume.blocks = VoxelBlocks()
        self.volume.levels = [FineBlocks(level.voxel_size) for level in self._source.levels]
        self.volume.map_id, self.volume._frame_number = self._source.map_id, 0
        levels = 1 + len(self.volume.levels)
        self._copied = [np.zeros(0, dtype=np.int32) for _ in range(levels)]  # frame up to which each slot was copied

    def update(self, limit: int | None = None) -> None:
        """Take over what was integrated since the last update; at most ``limit`` blocks of the coarsest level, those
        copied longest ago first: the others keep an earlier state. None copies all."""
        if self._source.map_id != self.volume.map_id:  # the map was cleared
            self._start()
        source, target = self._source.blocks, self.volume.blocks
        slots = self._copy(0, source, target, limit)
        for name in ("table", "coords", "slot_of", "free_count", "entry_of", "slot_coords", "fused"):
            setattr(target, name, getattr(source, name).copy())
        target.num_entries = source.num_entries
        for number, (theirs, ours) in enumerate(zip(self._source.levels, self.volume.levels, strict=True), start=1):
            self._copy(number, theirs.blocks, ours.blocks, None)
            ours.blocks.entry_of, ours.blocks.slot_coords = (
                theirs.blocks.entry_of.copy(),
                theirs.blocks.slot_coords.copy(),
            )
            ours.children, ours.parents = theirs.children.copy(), theirs.parents.copy()
        self.volume._frame_number += 1
        target.written[slots] = self.volume._frame_number

    def _copy(self, level: int, source: VoxelBlocks, target: VoxelBlocks, limit: int | None) -> NDArray[np.int64]:
        """Copy the voxels that were written since they were copied; their slots (n,)."""
        if len(self._copied[level]) < len(source.geometry):
            for name in ("geometry", "colors", "written"):
                setattr(target, name, grown(getattr(target, name), GROWTH * len(source.geometry), 0))
            self._copied[level] = grown(self._copied[level], GROWTH * len(source.geometry), -1)
        copied = self._copied[level]
        slots = np.flatnonzero(source.written[: source.num_slots] > copied[: source.num_slots])
        if limit is not None and len(slots) > limit:
            slots = np.sort(slots[np.argpartition(copied[slots], limit)[:limit]])
        target.write(slots, source.geometry[slots], source.colors[slots])
        target.use_slots(source.num_slots)
        copied[slots] = self._source.num_integrated
        return slots
