"""Copy of a growing volume that another thread may read."""

import copy

import numpy as np

from dudmap.mapping.volume import TsdfVolume
from dudmap.mapping.voxel_blocks import VoxelBlocks, grown


class VolumeMirror:
    """Copy of a volume, brought up to date by copying only the blocks that were written since the last update.

    ``update`` runs in the thread that changes the volume; between two updates any thread may read the copy.

    Args:
        volume: The volume to follow.

    Attributes:
        volume: The copy; for reading only (``sample``, ``extract_mesh``, ``IncrementalMesh``).
    """

    def __init__(self, volume: TsdfVolume) -> None:
        self.volume = copy.copy(volume)
        self.volume.blocks = VoxelBlocks()
        self._source = volume
        self._map_id, self._seen = -1, -1

    def update(self) -> None:
        """Take over what was integrated since the last update."""
        source, target = self._source.blocks, self.volume.blocks
        if self._source.map_id != self._map_id:  # the map was cleared: its frames count from zero again
            self.volume.blocks = target = VoxelBlocks()
            self._map_id, self._seen = self._source.map_id, -1
        slots, _ = self._source.written_since(self._seen)
        if len(target.geometry) < len(source.geometry):
            target.geometry = grown(target.geometry, len(source.geometry), 0)
            target.colors = grown(target.colors, len(source.colors), 0)
        for part in np.split(slots, np.flatnonzero(np.diff(slots) > 1) + 1):  # runs of slots: no intermediate copy
            run = slice(part[0], part[-1] + 1) if len(part) else slice(0)
            target.geometry[run], target.colors[run] = source.geometry[run], source.colors[run]
        for name in ("table", "coords", "slot_of", "free_count", "entry_of", "slot_coords", "written", "fused"):
            setattr(target, name, getattr(source, name).copy())
        target.num_entries, target.num_slots = source.num_entries, source.num_slots
        self.volume._frame_number = self._seen = self._source.num_integrated
        self.volume.map_id = self._map_id
