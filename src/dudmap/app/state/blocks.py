"""Changed map blocks and stored frames between memory and database."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SensorConfig, VolumeConfig
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.block_pager import Region
from dudmap.core.map.memory_limit import MemoryLimit
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.map.voxel_blocks import BLOCK, BlockRecords
from dudmap.core.places.frame_store import EncodedFrame, FrameStore

VOXELS = 2 * BLOCK**3
"""32-bit words of a block: geometry, then colours."""


class MapSettings(NamedTuple):
    """Arguments of ``TsdfVolume`` that recreate a map."""

    camera: Camera
    config: VolumeConfig
    sensor: SensorConfig
    depth_max: float
    max_blocks: int | MemoryLimit | None

    @classmethod
    def of(cls, volume: TsdfVolume) -> "MapSettings":
        """Settings of a map."""
        limit = None if volume.pager is None else volume.pager.max_blocks
        return cls(volume.camera, volume.config, volume.sensor, volume.depth_max, limit)


@dataclass(frozen=True, eq=False)
class MapSnapshot:
    """Changes of a map since the last checkpoint: ``slots``, ``coords``, ``voxels`` (n,), (n, 3), (n, VOXELS) int32.

    Attributes:
        slots, coords, voxels: (n,), (n, 3), (n, VOXELS) int32 of the changed blocks.
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
    """A map in the database: number, frame count and content numbers of its regions at the last storing."""

    number: int
    frame: int
    regions: dict[Region, int]


class StoredMaps:
    """Blocks that the database holds in their present state.

    Attributes:
        by_id: The maps in the database by ``TsdfVolume.map_id``.
    """

    def __init__(self) -> None:
        self.by_id: dict[int, StoredMap] = {}
        self._next = 0  # number of the next new map

    def snapshot(self, volume: TsdfVolume) -> MapSnapshot:
        """Copy the blocks that the database lacks or holds in an earlier state."""
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
        return MapSnapshot(
            number, volume.map_id, volume.num_integrated, slots, blocks.slot_coords[slots], voxels, released,
            blocks.num_slots, serials, regions,
        )  # fmt: skip

    def commit(self, maps: list[MapSnapshot]) -> None:
        """Record that the database holds these maps only."""
        self.by_id = {changed.map_id: StoredMap(changed.number, changed.frame, changed.away) for changed in maps}

    def add(self, volume: TsdfVolume, number: int) -> None:
        """Record a map that was read from the database."""
        regions = {} if volume.pager is None else {r: serial for r, (serial, *_) in volume.pager.away().items()}
        self.by_id[volume.map_id] = StoredMap(number, volume.num_integrated, regions)
        self._next = max(self._next, number + 1)


@dataclass(frozen=True, eq=False)
class FrameSnapshot:
    """Changes of a frame store since the last checkpoint."""

    number: int
    frames: dict[int, EncodedFrame]
    gone: list[int]
    kept: set[int]
    store: FrameStore


class StoredFrames:
    """Tracks which frames the database holds."""

    def __init__(self) -> None:
        self._stores: list[tuple[FrameStore, set[int]]] = []  # indexed by store number

    def snapshot(self, store: FrameStore) -> FrameSnapshot:
        """Frames that the database lacks, once encoded, and frames that it no longer needs."""
        number = next((n for n, (one, _) in enumerate(self._stores) if one is store), len(self._stores))
        if number == len(self._stores):
            self._stores.append((store, set()))
        stored, kept = self._stores[number][1], set(store.kept)
        frames = {n: store.encoded(n) for n in store.kept if n not in stored}
        return FrameSnapshot(number, frames, sorted(stored - kept), kept, store)

    def commit(self, frames: list[FrameSnapshot]) -> None:
        """Record that the database now holds these frames."""
        for changed in frames:
            self._stores[changed.number] = changed.store, changed.kept

    def add(self, store: FrameStore, number: int) -> None:
        """Record a store whose frames were read from the database."""
        while len(self._stores) <= number:
            self._stores.append((store, set()))
        self._stores[number] = store, set(store.kept)


Node = Any


@dataclass(eq=False)
class Snapshot:
    """Immutable state of a system at one moment.

    Attributes:
        arrays: Copies, constant arrays themselves, or lists of plain values.
    """

    tree: dict[str, Node] = field(default_factory=dict)
    arrays: list[NDArray | list[Any]] = field(default_factory=list)
    constant: set[int] = field(default_factory=set)
    maps: list[MapSnapshot] = field(default_factory=list)
    frames: list[FrameSnapshot] = field(default_factory=list)
