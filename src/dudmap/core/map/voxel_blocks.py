"""Blocks of 8x8x8 voxels: hash table and voxel memory."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu import hashing
from dudmap.core.backends.mirror import Mirror, grown
from dudmap.core.backends.parameters import BLOCK
from dudmap.core.state import Remembered, Stateful

__all__ = ["BLOCK", "VoxelBlocks", "grown"]

COORDINATE_BITS = 18
"""Bits of a block coordinate: three, and one of 512 maps, form a database key."""
MAX_COORDINATE = 1 << (COORDINATE_BITS - 1)
"""Bound of a coordinate: 10.4 km with blocks of 8 cm."""
NEIGHBOURHOOD = np.array([[i, j, k] for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)], dtype=np.int32)
"""Offset (27, 3) of a block's neighbours and itself; number 9 (dx + 1) + 3 (dy + 1) + dz + 1."""
INTENSITY = 0xFF
"""Intensity bits of a voxel's geometry word (``core/formulas/voxel.py``)."""
LARGEST_TABLE = 2**26
"""Places in the hash table of a stored map: 50 million blocks."""
MAX_LOAD = 0.8
"""Largest load factor: an insertion takes 16 ns then, 9 ns in a larger table."""


@dataclass(frozen=True, eq=False)
class BlockRecords:
    """Copies of blocks of a map.

    Attributes:
        coords: (n, 3) int32 block coordinates.
        free_count: (n,) uint8 observations of emptiness.
        owners: (m,) int32 rows of ``coords`` of the blocks with voxels.
        geometry, colors: (m, 512) int32 packed voxels.
        fused: (m,) uint8 frames fused into each block, saturated.
        finer: Blocks inside these per finer level (``FineBlocks.records``).
    """

    coords: NDArray[np.int32]
    free_count: NDArray[np.uint8]
    owners: NDArray[np.int32]
    geometry: NDArray[np.int32]
    colors: NDArray[np.int32]
    fused: NDArray[np.uint8]
    finer: "tuple[BlockRecords, ...]" = ()


COLUMNS = tuple(field.name for field in fields(BlockRecords) if field.name != "finer")
_TYPES = {
    "coords": (np.int32, 3), "free_count": (np.uint8, 1), "owners": (np.int32, 1), "geometry": (np.int32, BLOCK**3),
    "colors": (np.int32, BLOCK**3), "fused": (np.uint8, 1),
}  # fmt: skip


class VoxelBlocks(Stateful):
    """The blocks of a map.

    An entry is an observed block; near a surface it owns a slot of 512 voxels. Arrays grow by factors; reserved
    ``slots`` take no memory while unused.

    Attributes:
        table: Hash table of entry numbers (``core/backends/cpu/hashing.py``).
        coords, slot_of, free_count: Per entry (``num_entries``): (3,) int32 block coordinates; int32 slot, -1 = no
            voxels; uint8 observations of emptiness.
        geometry, colors: (slots, 512) int32 packed voxels; ``write`` changes them.
        geometry_mirror, colors_mirror: The same for back ends, which may hold copies on a device.
        entry_of, slot_coords, written, fused: Per slot (``num_slots``, in use or released): int32 entry, -1 = unused;
            (3,) int32 block coordinates; int32 last frame that wrote it; uint8 frames fused into it, saturated.
        table_size: Places in the hash table of stored blocks.
    """

    coords: Remembered[NDArray[np.int32]]
    slot_of: Remembered[NDArray[np.int32]]
    free_count: Remembered[NDArray[np.uint8]]
    entry_of: Remembered[NDArray[np.int32]]
    slot_coords: Remembered[NDArray[np.int32]]
    written: Remembered[NDArray[np.int32]]
    fused: Remembered[NDArray[np.uint8]]
    _released: Remembered[NDArray[np.int32]]
    table_size: Remembered[int]

    def __init__(self, slots: int = 1 << 16) -> None:
        self.table = np.full(1 << 14, hashing.EMPTY, dtype=np.int32)
        self.coords = np.empty((1 << 12, 3), dtype=np.int32)
        self.slot_of = np.full(1 << 12, -1, dtype=np.int32)
        self.free_count = np.zeros(1 << 12, dtype=np.uint8)
        self.num_entries = 0
        self.geometry_mirror = Mirror(np.zeros((slots, BLOCK**3), dtype=np.int32))
        self.colors_mirror = Mirror(np.zeros((slots, BLOCK**3), dtype=np.int32))
        self.entry_of = np.full(slots, -1, dtype=np.int32)
        self.slot_coords = np.zeros((slots, 3), dtype=np.int32)
        self.written = np.zeros(slots, dtype=np.int32)
        self.fused = np.zeros(slots, dtype=np.uint8)
        self.use_slots(0)
        self._released = np.empty(0, dtype=np.int32)

    def state(self) -> dict[str, Any]:
        """The index without spare capacity; voxels are stored by block (``app/state``)."""
        self.table_size = len(self.table)
        state, n, m = super().state(), self.num_entries, self.num_slots
        state |= {name: state[name][:n] for name in ("coords", "slot_of", "free_count")}
        return state | {name: state[name][:m] for name in ("entry_of", "slot_coords", "written", "fused")}

    def restore(self, state: dict[str, Any]) -> None:
        """Restore the index without voxels; ``ValueError`` if its parts do not fit."""
        room = max(len(self.entry_of), len(state["entry_of"]))
        super().restore(state)
        n, m, owned = len(self.coords), len(self.entry_of), np.flatnonzero(self.entry_of >= 0)
        sizes = [len(array) for array in (self.free_count, self.slot_of, self.slot_coords, self.written, self.fused)]
        fitting = sizes == [n, n, m, m, m] and np.array_equal(self.slot_of[self.entry_of[owned]], owned)
        if not (fitting and n / MAX_LOAD <= self.table_size <= LARGEST_TABLE):
            raise ValueError("the parts of the index of a map do not fit each other")
        self.num_entries = n
        for name, unused in (("entry_of", -1), ("slot_coords", 0), ("written", 0), ("fused", 0)):
            setattr(self, name, grown(getattr(self, name), room, unused))
        self.geometry, self.colors = (np.zeros((room, BLOCK**3), np.int32) for _ in range(2))
        self.use_slots(m)
        self.table = np.full(self.table_size, hashing.EMPTY, dtype=np.int32)
        self._fill_table()

    @property
    def geometry(self) -> NDArray[np.int32]:
        """Packed voxels (slots, 512) int32 in host memory."""
        return self.geometry_mirror.host

    @geometry.setter
    def geometry(self, array: NDArray[np.int32]) -> None:
        self.geometry_mirror = Mirror(array)

    @property
    def colors(self) -> NDArray[np.int32]:
        """Packed colours (slots, 512) int32 in host memory."""
        return self.colors_mirror.host

    @colors.setter
    def colors(self, array: NDArray[np.int32]) -> None:
        self.colors_mirror = Mirror(array)

    def write(self, slots: NDArray[np.integer], geometry: NDArray[np.int32], colors: NDArray[np.int32]) -> None:
        """Replace the voxels (n, 512) of slots (n,)."""
        self.geometry[slots], self.colors[slots] = geometry, colors
        self.geometry_mirror.wrote(slots)
        self.colors_mirror.wrote(slots)

    def take_colors(self, slots: NDArray[np.integer], other: "VoxelBlocks") -> None:
        """Give slots (n,) the colours and intensities of another map; 0 for unknown blocks."""
        there = other.slots_at(self.slot_coords[slots].astype(np.int32))
        known = there >= 0
        intensities, colors = np.zeros((2, len(slots), BLOCK**3), dtype=np.int32)
        intensities[known] = other.geometry[there[known]] & INTENSITY
        colors[known] = other.colors[there[known]]
        self.write(slots, (self.geometry[slots] & ~INTENSITY) | intensities, colors)

    @property
    def num_voxel_blocks(self) -> int:
        """Number of blocks with voxels."""
        return self.num_slots - len(self._released)

    def num_free(self, observations: int) -> int:
        """Blocks without voxels with at least this many observations of emptiness."""
        n = self.num_entries
        return int(np.count_nonzero((self.free_count[:n] >= observations) & (self.slot_of[:n] < 0)))

    @property
    def num_bytes(self) -> int:
        """Memory of slots, entries and hash table, without spare capacity."""
        return self.num_slots * self.slot_bytes + self.num_entries * self._index_bytes + self.table.nbytes

    @property
    def slot_bytes(self) -> int:
        """Bytes of a slot."""
        slots = (self.slot_coords, self.entry_of, self.written, self.fused)
        return 2 * 4 * BLOCK**3 + sum(_row_bytes(array) for array in slots)

    @property
    def entry_bytes(self) -> float:
        """Bytes of a block without voxels, such as free space."""
        return self._index_bytes + self.table.nbytes / max(self.num_entries, 1)

    @property
    def _index_bytes(self) -> int:
        return sum(_row_bytes(array) for array in (self.coords, self.slot_of, self.free_count))

    @property
    def active_slots(self) -> NDArray[np.int32]:
        """Slots (n,) int32 with voxels, ascending."""
        return np.flatnonzero(self.entry_of[: self.num_slots] >= 0).astype(np.int32)

    def entries_at(self, coords: NDArray[np.int32], unknown: int) -> NDArray[np.int32]:
        """Entries (n,) int32 of blocks at coordinates (n, 3); at most ``unknown`` are new."""
        self.reserve_entries(self.num_entries + unknown)
        entries, self.num_entries = hashing.insert_all(self.table, self.coords, self.num_entries, coords)
        return entries

    def _fill_table(self) -> None:
        """Fill the empty table with all entries."""
        hashing.insert_all(self.table, self.coords, 0, self.coords[: self.num_entries])

    def reserve_entries(self, needed: int) -> None:
        """Grow the arrays to at least ``needed`` entries."""
        if needed > len(self.coords):
            capacity = max(needed, 2 * len(self.coords))
            self.coords = grown(self.coords, capacity, 0)
            self.slot_of = grown(self.slot_of, capacity, -1)
            self.free_count = grown(self.free_count, capacity, 0)
        if needed > MAX_LOAD * len(self.table):
            size = max(int(needed / MAX_LOAD), len(self.table)) * 3 // 2  # a search in a full table would not end
            self.table = np.full(size, hashing.EMPTY, dtype=np.int32)
            self._fill_table()

    def reserve_slots(self, needed: int) -> None:
        """Grow the arrays to at least ``needed`` slots."""
        if needed > len(self.entry_of):
            capacity = max(needed, len(self.entry_of) * 3 // 2)
            self.geometry_mirror.grow(capacity)
            self.colors_mirror.grow(capacity)
            self.entry_of = grown(self.entry_of, capacity, -1)
            self.slot_coords = grown(self.slot_coords, capacity, 0)
            self.written = grown(self.written, capacity, 0)
            self.fused = grown(self.fused, capacity, 0)

    def allocate(self, entries: NDArray[np.int32], frame_number: int) -> NDArray[np.int32]:
        """Allocate slots (n,) int32 for entries without a slot."""
        kept = max(len(self._released) - len(entries), 0)
        reused, self._released = self._released[kept:][::-1], self._released[:kept]
        needed = self.num_slots + len(entries) - len(reused)
        self.reserve_slots(needed)
        slots = np.concatenate([reused, np.arange(self.num_slots, needed, dtype=np.int32)])
        self.use_slots(needed)
        self.entry_of[slots] = entries
        self.slot_coords[slots] = self.coords[entries]
        self.written[slots] = frame_number
        self.fused[slots] = 0
        self.slot_of[entries] = slots
        return slots

    def use_slots(self, num_slots: int) -> None:
        """Mark all slots below a number as used."""
        self.num_slots = num_slots
        self.geometry_mirror.used = self.colors_mirror.used = num_slots

    def release(self, slots: NDArray[np.int32], observations: int) -> NDArray[np.int32]:
        """Empty slots; their entries (n,) int32 get at least this many observations of emptiness."""
        entries = self.entry_of[slots]
        self.slot_of[entries] = -1
        self.free_count[entries] = np.maximum(self.free_count[entries], observations)
        self.entry_of[slots] = -1
        self.geometry_mirror.fill(slots, 0)
        self.colors_mirror.fill(slots, 0)
        self._released = np.concatenate([self._released, slots[::-1]])
        return entries

    def entries_in(self, low: NDArray[np.integer], high: NDArray[np.integer]) -> NDArray[np.int64]:
        """Entries (n,) from ``low`` to ``high`` (3,) (exclusive), ascending."""
        coords = self.coords[: self.num_entries]
        return np.flatnonzero(np.all((coords >= low) & (coords < high), axis=1))

    def records(self, entries: NDArray[np.integer], *, by_slot: bool = False) -> BlockRecords:
        """Copies of entries (n,), with voxels in the order of entries or of slots."""
        slots = self.slot_of[entries]
        owners = np.flatnonzero(slots >= 0).astype(np.int32)
        if by_slot:
            owners = owners[np.argsort(slots[owners])]
        slots = slots[owners]
        return BlockRecords(
            self.coords[entries], self.free_count[entries], owners,
            self.geometry[slots], self.colors[slots], self.fused[slots],
        )  # fmt: skip

    def remove(self, entries: NDArray[np.integer], frame_number: int) -> None:
        """Remove entries (n,) and their voxels. Other entries are renumbered; slots are not."""
        n = self.num_entries
        slots = self.slot_of[entries]
        slots = np.sort(slots[slots >= 0])
        kept = np.ones(n, dtype=bool)
        kept[entries] = False
        self.entry_of[slots] = -1
        self.geometry_mirror.fill(slots, 0)
        self.colors_mirror.fill(slots, 0)
        self.written[slots] = frame_number
        self._released = np.concatenate([self._released, slots[::-1]])
        number = (np.cumsum(kept) - 1).astype(np.int32)
        owned = self.active_slots
        self.entry_of[owned] = number[self.entry_of[owned]]
        m = int(np.count_nonzero(kept))
        for array, unused in ((self.coords, 0), (self.slot_of, -1), (self.free_count, 0)):
            array[:m] = array[:n][kept]
            array[m:n] = unused
        self.num_entries = m
        self.table.fill(hashing.EMPTY)
        self._fill_table()

    def insert(self, records: BlockRecords, frame_number: int) -> NDArray[np.int32]:
        """Add unknown blocks; returns the slots (m,) int32 with voxels."""
        entries = self.entries_at(records.coords, len(records.coords))
        self.free_count[entries] = records.free_count
        slots = self.allocate(entries[records.owners], frame_number)
        self.write(slots, records.geometry, records.colors)
        self.fused[slots] = records.fused
        return slots

    def slots_at(self, coords: NDArray[np.int32]) -> NDArray[np.int32]:
        """Slots (n,) int32 at coordinates (n, 3) int32; -1 = no voxels."""
        entries = hashing.find_all(self.table, self.coords, coords)
        return np.where(entries >= 0, self.slot_of[entries], -1).astype(np.int32)

    def neighbourhood(self, slots: NDArray[np.int32]) -> NDArray[np.int32]:
        """Slots (n, 27) int32 of each block's ``NEIGHBOURHOOD``; -1 = none."""
        coords = self.slot_coords[slots][:, None] + NEIGHBOURHOOD
        return self.slots_at(coords.reshape(-1, 3).astype(np.int32)).reshape(-1, 27)

    @classmethod
    def restored(
        cls,
        coords: NDArray[np.int32],
        free_count: NDArray[np.uint8],
        entries: NDArray[np.int32],
        geometry: NDArray[np.int32],
        colors: NDArray[np.int32],
    ) -> "VoxelBlocks":
        """Blocks of a map file: all entries, and entry and voxels of each slot.

        Raises:
            ValueError: The arrays do not fit each other, or a block occurs twice.
        """
        _check_restored(coords, free_count, entries, geometry, colors)
        blocks = cls(len(entries))
        blocks.table = np.full(max(1 << 14, 2 * len(coords)), hashing.EMPTY, dtype=np.int32)
        fused = np.zeros(len(entries), np.uint8)
        blocks.insert(BlockRecords(coords, free_count, entries, geometry, colors, fused), frame_number=0)
        return blocks


def _check_restored(coords: NDArray, free_count: NDArray, entries: NDArray, geometry: NDArray, colors: NDArray) -> None:
    n, m = len(coords), len(entries)
    wanted = {
        "coords": (coords, np.int32, (n, 3)), "free_count": (free_count, np.uint8, (n,)),
        "entries": (entries, np.int32, (m,)), "geometry": (geometry, np.int32, (m, BLOCK**3)),
        "colors": (colors, np.int32, (m, BLOCK**3)),
    }  # fmt: skip
    for name, (array, kind, shape) in wanted.items():
        if array.dtype != kind or array.shape != shape:
            raise ValueError(f"{name} is {array.dtype} {array.shape}; expected {np.dtype(kind)} {shape}")
    if m and not (0 <= entries.min() and entries.max() < n and len(np.unique(entries)) == m):
        raise ValueError("a slot of voxels has no block, or two slots have the same block")
    if n and np.abs(coords.astype(np.int64)).max() > MAX_COORDINATE - 1:
        raise ValueError("a block coordinate is out of range")
    if len(np.unique(coords, axis=0)) != n:
        raise ValueError("a block occurs twice")


def _row_bytes(array: NDArray) -> int:
    return array.itemsize * int(np.prod(array.shape[1:], dtype=np.int64))


def blobs_of(records: BlockRecords) -> list[list[memoryview]]:
    """The arrays of records in stored form, in the order of ``COLUMNS``."""
    levels = [records, *records.finer]
    return [[np.ascontiguousarray(getattr(level, name)).data for name in COLUMNS] for level in levels]


def records_of(rows: Sequence[Sequence[bytes]]) -> BlockRecords:
    """The records of stored arrays, level by level.

    Raises:
        ValueError: The arrays do not fit each other.
    """
    levels = [_level_of(blobs) for blobs in rows]
    return replace(levels[0], finer=tuple(levels[1:]))


def _level_of(blobs: Sequence[bytes]) -> BlockRecords:
    arrays = {}
    for name, blob in zip(COLUMNS, blobs, strict=True):
        kind, width = _TYPES[name]
        array = np.frombuffer(blob, kind)
        arrays[name] = array.reshape(-1, width) if width > 1 else array
    records = BlockRecords(**arrays)
    n, m = len(records.coords), len(records.owners)
    sizes = {len(records.geometry), len(records.colors), len(records.fused)}
    if len(records.free_count) != n or sizes != {m} or np.any(records.owners < 0) or np.any(records.owners >= n):
        raise ValueError("the blocks of a region do not fit each other")
    return records
