"""Blocks of the maps and stored frames on their way into the database and back: only what changed is written."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu import hashing
from dudmap.core.map.block_pager import Away, Region
from dudmap.core.map.block_window import BlockWindow
from dudmap.core.map.fine_blocks import FineBlocks
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.map.voxel_blocks import BLOCK, BlockRecords, VoxelBlocks, grown
from dudmap.core.places.frame_store import EncodedFrame, FrameStore
from dudmap.errors import StateError

LARGEST_TABLE = 2**26
"""Largest number of places of the hash table of a map: that of 50 million blocks."""
VOXELS = 2 * BLOCK**3
"""Words of 32 bits of a block: the geometry of its voxels, then their colours, as in memory."""


@dataclass(frozen=True, eq=False)
class MapSnapshot:
    """What changed in a map since the last checkpoint.

    Attributes:
        number: Number of the map in the database.
        map_id, frame: The map in this process, and its number of fused frames.
        slots, coords, voxels: (n,), (n, 3), (n, VOXELS) int32 of the blocks that were written.
        released: Slots that hold no block any more.
        num_slots: Number of slots in use; there are none behind them.
        away: Number of the content of each region that has left the memory.
        regions: Those of them that the database lacks.
    """

    number: int
    map_id: int
    frame: int
    slots: NDArray[np.int32]
    coords: NDArray[np.int32]
    voxels: NDArray[np.int32]
    released: NDArray[np.int32]
    num_slots: int
    away: dict[Region, int]
    regions: list[tuple[Region, BlockRecords]]


class StoredMap(NamedTuple):
    """A map in the database: its number, the frame that it was stored after, the numbers of its regions' contents."""

    number: int
    frame: int
    regions: dict[Region, int]


class StoredMaps:
    """Knows which blocks are in the database as they are in memory.

    Attributes:
        by_id: The maps in the database by ``TsdfVolume.map_id``.
    """

    def __init__(self) -> None:
        self.by_id: dict[int, StoredMap] = {}
        self._next = 0  # number of the next map that the database lacks

    def snapshot(self, volume: TsdfVolume) -> tuple[dict[str, Any], MapSnapshot]:
        """Index of a map, and a copy of the blocks that the database lacks or has in an earlier state."""
        stored, blocks = self.by_id.get(volume.map_id), volume.blocks
        number = self._next if stored is None else stored.number
        self._next = max(self._next, number + 1)
        slots = volume.active_slots if stored is None else volume.written_since(stored.frame)[0]
        used = blocks.entry_of[slots] >= 0
        slots, released = slots[used], slots[~used]
        voxels = np.concatenate([blocks.geometry[slots], blocks.colors[slots]], axis=1)
        away = {} if volume.pager is None else volume.pager.away()
        serials, regions = {region: serial for region, (serial, *_) in away.items()}, []
        if volume.pager is not None:
            known = {} if stored is None else stored.regions
            unknown = [region for region, serial in serials.items() if known.get(region) != serial]
            regions = [(region, volume.pager.records(region)) for region in unknown]
        changed = MapSnapshot(
            number, volume.map_id, volume.num_integrated, slots, blocks.slot_coords[slots], voxels, released,
            blocks.num_slots, serials, regions,
        )  # fmt: skip
        return _index(volume) | {"away": _away_rows(away)}, changed

    def commit(self, maps: list[MapSnapshot]) -> None:
        """The blocks of these maps are in the database, and no other maps."""
        self.by_id = {changed.map_id: StoredMap(changed.number, changed.frame, changed.away) for changed in maps}

    def add(self, volume: TsdfVolume, number: int) -> None:
        """A map has been read from the database."""
        regions = {} if volume.pager is None else {r: serial for r, (serial, *_) in volume.pager.away().items()}
        self.by_id[volume.map_id] = StoredMap(number, volume.num_integrated, regions)
        self._next = max(self._next, number + 1)


def _index(volume: TsdfVolume) -> dict[str, Any]:
    """Everything of the blocks and the window of a map except the voxels."""
    window = {"near": volume.window.near, "origin": volume.window.origin}
    return _index_of(volume.blocks) | window | {"levels": [_fine_index(level) for level in volume.levels]}


def _index_of(blocks: VoxelBlocks) -> dict[str, Any]:
    """Everything of blocks except the voxels."""
    n, m = blocks.num_entries, blocks.num_slots
    return {
        "coords": blocks.coords[:n], "free_count": blocks.free_count[:n], "slot_of": blocks.slot_of[:n],
        "entry_of": blocks.entry_of[:m], "slot_coords": blocks.slot_coords[:m], "written": blocks.written[:m],
        "fused": blocks.fused[:m], "released": blocks._released, "table": len(blocks.table),
    }  # fmt: skip


def _fine_index(level: FineBlocks) -> dict[str, Any]:
    """The same of a finer level, with the voxels: they are few, and are stored as arrays."""
    m = level.blocks.num_slots
    voxels = {"geometry": level.blocks.geometry[:m], "colors": level.blocks.colors[:m], "calm": level.calm[:m]}
    return _index_of(level.blocks) | voxels


def _away_rows(away: dict[Region, Away]) -> NDArray[np.int64]:
    """Coordinates, number of the content, and numbers of blocks (n, 7) of regions that have left the memory."""
    return np.array([(*region, *numbers) for region, numbers in away.items()], np.int64).reshape(-1, 7)


def restore_map(
    volume: TsdfVolume,
    index: dict[str, Any],
    slots: NDArray[np.int64],
    coords: NDArray[np.int64],
    voxels: NDArray[np.int32],
    read_region: Callable[[Region], BlockRecords],
) -> None:
    """Fill a map, whose other attributes are set, from its index and all its rows in the database, by slot: slots (n,),
    coordinates (n, 3) and voxels (n, VOXELS). ``read_region`` reads a region that has left the memory.

    Raises:
        StateError: The rows do not fit the index.
    """
    frame_number, left = volume._frame_number, volume._left
    volume.clear()
    volume._frame_number, volume._left = frame_number, left
    owned = _check_index(index)
    if not (np.array_equal(slots, owned) and np.array_equal(coords, index["slot_coords"][owned])):
        raise StateError(f"the stored map is damaged: {len(slots)} of {len(owned)} blocks fit its index")
    blocks = volume.blocks
    _restore_blocks(blocks, index, paged=volume.pager is not None)
    blocks.geometry[slots], blocks.colors[slots] = voxels[:, : VOXELS // 2], voxels[:, VOXELS // 2 :]
    _restore_levels(volume, index["levels"])
    if volume.pager is not None:
        away = {(x, y, z): tuple(numbers) for x, y, z, *numbers in index["away"].tolist()}
        volume.pager.continue_from(away, read_region)
    _restore_window(volume.window, blocks, index)


def _check_index(index: dict[str, Any]) -> NDArray[np.int64]:
    """Slots (n,) that own voxels; a ``StateError`` if the parts of an index do not fit each other."""
    n, m = len(index["coords"]), len(index["entry_of"])
    sizes = (len(index["free_count"]), n), (len(index["slot_of"]), n), (len(index["slot_coords"]), m)
    owned = np.flatnonzero(index["entry_of"] >= 0)
    if (
        any(a != b for a, b in (*sizes, (len(index["written"]), m), (len(index["fused"]), m)))
        or not np.array_equal(index["slot_of"][index["entry_of"][owned]], owned)
        or not isinstance(index["table"], int)
        or not 0.8 * min(index["table"], LARGEST_TABLE) >= n
        or index["table"] > LARGEST_TABLE
    ):
        raise StateError("the stored map is damaged: the parts of its index do not fit each other")
    return owned


def _restore_blocks(blocks: VoxelBlocks, index: dict[str, Any], *, paged: bool) -> None:
    """Fill empty blocks, but for their voxels, with an index; with room for more slots where a map is paged."""
    n, m = len(index["coords"]), len(index["entry_of"])
    capacity = max(m, len(blocks.geometry)) if paged else m
    blocks.num_entries = n
    blocks.coords, blocks.free_count, blocks.slot_of = index["coords"], index["free_count"], index["slot_of"]
    for name in ("slot_coords", "written", "fused"):
        setattr(blocks, name, grown(index[name], capacity, 0))
    blocks.entry_of, blocks._released = grown(index["entry_of"], capacity, -1), index["released"]
    blocks.geometry, blocks.colors = (np.zeros((capacity, BLOCK**3), np.int32) for _ in range(2))
    blocks.use_slots(m)
    blocks.table = np.full(index["table"], hashing.EMPTY, dtype=np.int32)
    hashing.rebuild(blocks.table, blocks.coords, n)


def _restore_levels(volume: TsdfVolume, indices: list[dict[str, Any]]) -> None:
    """Fill the finer levels of a map whose coarsest one is complete; a ``StateError`` if one does not fit."""
    parents = volume.blocks
    for level, index in zip(volume.levels, indices, strict=True):
        _check_index(index)
        blocks, m = level.blocks, len(index["entry_of"])
        _restore_blocks(blocks, index, paged=volume.pager is not None)
        if {len(index[name]) for name in ("geometry", "colors", "calm")} != {m}:
            raise StateError("the stored map is damaged: blocks with smaller voxels lack some of them")
        blocks.geometry[:m], blocks.colors[:m] = index["geometry"], index["colors"]
        if not np.all(level.link(parents)):
            raise StateError("the stored map is damaged: blocks with smaller voxels lie in no larger block")
        level.calm[:m] = index["calm"]
        parents = blocks


def _restore_window(window: BlockWindow, blocks: VoxelBlocks, index: dict[str, Any]) -> None:
    """Fill the window where it was; the order of the slots in it, in which they are fused, is kept."""
    if index["origin"] is None:
        return
    window.origin = index["origin"]
    window.cells.fill(-1)
    cells = window.cells.reshape(tuple(window.shape))
    inside = np.empty(blocks.num_entries, dtype=np.int32)
    count = hashing.fill_window(cells, window.origin, blocks.coords, blocks.slot_of, blocks.num_entries, inside)
    window.near = index["near"]
    if not np.array_equal(np.sort(window.near), np.sort(inside[:count])):
        raise StateError("the stored map is damaged: the blocks around the camera are not those of the map")


@dataclass(frozen=True, eq=False)
class FrameSnapshot:
    """What changed in a frame store since the last checkpoint.

    Attributes:
        number: Number of the store in the database.
        frames: The frames that the database lacks, by number: depth, colour and mask as files.
        gone: Numbers of those that it holds, and the store does not any more.
        kept: Numbers of the frames whose images are in the store.
        store: The store.
    """

    number: int
    frames: dict[int, EncodedFrame]
    gone: list[int]
    kept: set[int]
    store: FrameStore


class StoredFrames:
    """Knows which frames are in the database."""

    def __init__(self) -> None:
        self._stores: list[tuple[FrameStore, set[int]]] = []  # the number is the place in the list

    def snapshot(self, store: FrameStore) -> FrameSnapshot:
        """The frames that the database lacks, and those that it no longer needs; waits until the former are encoded."""
        number = next((n for n, (one, _) in enumerate(self._stores) if one is store), len(self._stores))
        if number == len(self._stores):
            self._stores.append((store, set()))
        stored, kept = self._stores[number][1], set(store.kept)
        frames = {n: store.encoded(n) for n in store.kept if n not in stored}
        return FrameSnapshot(number, frames, sorted(stored - kept), kept, store)

    def commit(self, frames: list[FrameSnapshot]) -> None:
        """What these snapshots hold is in the database."""
        for changed in frames:
            self._stores[changed.number] = changed.store, changed.kept

    def add(self, store: FrameStore, number: int) -> None:
        """The frames of a store come from the database."""
        while len(self._stores) <= number:
            self._stores.append((store, set()))
        self._stores[number] = store, set(store.kept)
