"""Copy of a growing map for another thread, and a mesh of which only changed parts are extracted again."""

import copy

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.mesh import Mesh, joined
from dudmap.core.map.fine_blocks import FineBlocks
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.map.voxel_blocks import VoxelBlocks, grown

GROWTH = 4
"""Capacity in the volume's capacities; spare capacity is only address space."""


class VolumeMirror:
    """Copy of a volume, updated by the blocks written since the last copy.

    ``update`` runs in the thread that changes the volume. Between updates any thread may read ``volume``, whose frames
    count the updates.
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
        """Copy at most ``limit`` blocks of the coarsest level written since, least recently copied first; None copies
        all."""
        if self._source.map_id != self.volume.map_id:  # the map was cleared
            self._start()
        source, target = self._source.blocks, self.volume.blocks
        slots = self._copy(0, source, target, limit)
        for name in ("table", "coords", "slot_of", "free_count", "entry_of", "slot_coords", "fused"):
            setattr(target, name, getattr(source, name).copy())
        target.num_entries, self.volume.num_frames = source.num_entries, self._source.num_frames
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


EDGE = 4
"""Blocks along the edge of a chunk."""
Chunk = tuple[int, int, int]


class IncrementalMesh:
    """Mesh of a growing volume for a live view.

    An update extracts the chunks of 4x4x4 blocks that touch a written block; its time grows with the view. The chunks
    equal ``TsdfVolume.extract_mesh`` with duplicate vertices between them. Not during ``integrate``.

    ``chunks``: meshes by chunk coordinates; chunk (i, j, k) begins at block (4 i, 4 j, 4 k).
    """

    def __init__(self, volume: TsdfVolume) -> None:
        self.chunks: dict[Chunk, Mesh] = {}
        self._volume = volume
        self._map_id = volume.map_id
        self._seen = -1
        self._coords_of = np.empty((0, 3), dtype=np.int32)  # of every slot, at the last update
        # with several voxel sizes, a vertex depends on the voxel sizes in all neighbours of its block
        self._reach = 2 if volume.levels else 1

    def update(self) -> list[Chunk]:
        """Extract the changed chunks, and return the coordinates of all that may have changed, also without surface
        now."""
        removed: list[Chunk] = []
        if self._volume.map_id != self._map_id:  # the map was cleared: its frame numbers restart
            removed = list(self.chunks)
            self.chunks.clear()
            self._map_id, self._seen, self._coords_of = self._volume.map_id, -1, self._coords_of[:0]
        slots, coords = self._volume.written_since(self._seen)
        self._seen = self._volume.num_integrated
        known = slots[slots < len(self._coords_of)]
        changed = np.concatenate([coords, self._coords_of[known]])  # a slot may belong to another block now
        if len(slots) and slots[-1] >= len(self._coords_of):
            more = np.zeros((2 * (int(slots[-1]) + 1), 3), dtype=np.int32)
            more[: len(self._coords_of)] = self._coords_of
            self._coords_of = more
        self._coords_of[slots] = coords
        stale = _touched(changed, self._reach)
        if self._volume.pager is not None:  # a block that was paged out left its slot, but not the map
            corners = _corners(-self._reach, EDGE - 1 + self._reach)
            away = self._volume.pager.is_away((stale[:, None] * EDGE + corners).reshape(-1, 3))
            stale = stale[~np.any(away.reshape(-1, 8), axis=1)]
        if len(stale) == 0:
            return removed
        meshes = self._extract(stale)
        keys: list[Chunk] = [(int(i), int(j), int(k)) for i, j, k in stale]
        for key, mesh in zip(keys, meshes, strict=True):
            if len(mesh.faces):
                self.chunks[key] = mesh
            else:
                self.chunks.pop(key, None)
        return keys + [key for key in removed if key not in self.chunks]

    def mesh(self) -> Mesh:
        """All chunks as one mesh."""
        return joined(list(self.chunks.values()))

    def _extract(self, stale: NDArray[np.int32]) -> list[Mesh]:
        reach = np.arange(-1, EDGE + 1, dtype=np.int32)
        offsets = np.stack(np.meshgrid(reach, reach, reach, indexing="ij"), axis=-1).reshape(-1, 3)
        inner = np.all((offsets >= 0) & (offsets < EDGE), axis=1)
        slots = self._volume.slots_at((stale[:, None] * EDGE + offsets).reshape(-1, 3)).reshape(len(stale), -1)
        chunk_of = np.where(inner, np.arange(len(stale))[:, None], -1)
        exists = slots >= 0
        chosen, groups = slots[exists], chunk_of[exists]
        # a block next to two chunks is listed for both and for its own chunk: keep one, its own chunk first
        order = np.lexsort((-groups, chosen))
        chosen, groups = chosen[order], groups[order]
        once = np.ones(len(chosen), dtype=bool)
        once[1:] = chosen[1:] != chosen[:-1]
        meshes = self._volume.extract_chunks(chosen[once], groups[once])
        return meshes + [joined([])] * (len(stale) - len(meshes))


def _corners(low: int, high: int) -> NDArray[np.int32]:
    return np.array([[i, j, k] for i in (low, high) for j in (low, high) for k in (low, high)], dtype=np.int32)


def _touched(blocks: NDArray[np.int32], reach: int) -> NDArray[np.int32]:
    chunks = ((blocks[:, None] + _corners(-reach, reach)) // EDGE).reshape(-1, 3).astype(np.int64)
    packed = ((chunks[:, 0] + (1 << 20)) << 42) | ((chunks[:, 1] + (1 << 20)) << 21) | (chunks[:, 2] + (1 << 20))
    unique = np.unique(packed)
    axes = [(unique >> shift) & ((1 << 21) - 1) for shift in (42, 21, 0)]
    return (np.stack(axes, axis=1) - (1 << 20)).astype(np.int32)
