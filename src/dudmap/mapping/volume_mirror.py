"""Copy of a growing volume that another thread may read."""

import copy

import numpy as np

from dudmap.mapping.volume import TsdfVolume
from dudmap.mapping.voxel_blocks import VoxelBlocks, grown

GROWTH = 4
"""Capacity in units of the volume's: growing copies all blocks at once, spare capacity is only address space."""


class VolumeMirror:
    """Copy of a volume, brought up to date by copying only the blocks that were written since they were copied.

    ``update`` runs in the thread that changes the volume; between two updates any thread may read the copy.

    Args:
        volume: The volume to follow.

    Attributes:
        volume: The copy; for reading only (``extract_mesh``, ``IncrementalMesh``). Its frames count the updates.
    """

    def __init__(self, volume: TsdfVolume) -> None:
        self.volume = copy.copy(volume)
        self._source = volume
        self._start()

    def _start(self) -> None:
        self.volume.blocks = VoxelBlocks()
        self.volume.map_id, self.volume._frame_number = self._source.map_id, 0
        self._copied = np.zeros(0, dtype=np.int32)  # frame up to which each slot was copied

    def update(self, limit: int | None = None) -> None:
        """Take over what was integrated since the last update.

        Args:
            limit: Number of blocks to copy at most, those copied longest ago first; the others keep an earlier state.
                None copies all.
        """
        if self._source.map_id != self.volume.map_id:  # the map was cleared
            self._start()
        source, target = self._source.blocks, self.volume.blocks
        if len(self._copied) < len(source.geometry):
            for name in ("geometry", "colors", "written"):
                setattr(target, name, grown(getattr(target, name), GROWTH * len(source.geometry), 0))
            self._copied = grown(self._copied, GROWTH * len(source.geometry), -1)
        slots = np.flatnonzero(source.written[: source.num_slots] > self._copied[: source.num_slots])
        if limit is not None and len(slots) > limit:
            slots = np.sort(slots[np.argpartition(self._copied[slots], limit)[:limit]])
        target.write(slots, source.geometry[slots], source.colors[slots])
        for name in ("table", "coords", "slot_of", "free_count", "entry_of", "slot_coords", "fused"):
            setattr(target, name, getattr(source, name).copy())
        target.num_entries = source.num_entries
        target.use_slots(source.num_slots)
        self.volume.levels = [level.copied() for level in self._source.levels]
        self.volume._frame_number += 1
        target.written[slots] = self.volume._frame_number
        self._copied[slots] = self._source.num_integrated
