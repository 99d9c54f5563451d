"""Paging of regions of 16x16x16 blocks to disk and back (Niessner et al. 2013, section 5)."""

from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.map import morton
from dudmap.core.map.fine_blocks import BlockTree
from dudmap.core.map.memory_limit import MemoryLimit
from dudmap.core.map.voxel_blocks import COLUMNS, BlockRecords, blobs_of, records_of
from dudmap.core.scratch_store import ScratchStore
from dudmap.core.state import Remembered, Stateful
from dudmap.errors import MapError

REGION_BITS = 4
REGION = 1 << REGION_BITS
"""Blocks along the edge of a region, and its base-2 logarithm."""
MARGIN = 4
"""Blocks around the view that stay in memory."""
ROOM = 0.85
"""Share of the allowed blocks that remains after paging out."""
RETRY_AFTER = 100
"""Window moves before a failed store is tried again."""
Region = tuple[int, int, int]


class Away(NamedTuple):
    """A region on disk: serial number, and numbers of blocks, of blocks with voxels, and of finer blocks."""

    serial: int
    blocks: int
    voxel_blocks: int
    finer: int


class BlockPager(Stateful):
    """Moves regions of a map between memory and disk, without a change of content.

    Attributes:
        max_blocks: Limit of blocks with voxels in memory, of all levels; blocks in view stay.
        failure: Why the last write failed; empty on success. The regions then stay in memory.
    """

    failure: Remembered[str] = ""
    _next_serial: Remembered[int] = 0
    _away: Remembered[dict[Region, Away]]
    _retry_in: Remembered[int]

    def __init__(self, max_blocks: int | MemoryLimit) -> None:
        self.max_blocks = max_blocks
        self._store: ScratchStore | None = None
        self.clear()

    def clear(self) -> None:
        """Forget all regions."""
        if self._store is not None:
            self._store.close()
        self._store = None
        self._away = {}
        self._returned: dict[Region, tuple[int, int]] = {}  # frame number and serial of regions with a valid copy
        self._archived: set[Region] = set()
        self._archive: Callable[[Region], BlockRecords] | None = None
        self._retry_in = 0

    @property
    def num_blocks(self) -> int:
        """Blocks with voxels in the store."""
        return sum(away.voxel_blocks for away in self._away.values())

    def is_away(self, coords: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Whether the region of each block (n, 3) is on disk."""
        if not self._away:
            return np.zeros(len(coords), dtype=bool)
        regions, which = np.unique(np.asarray(coords) >> REGION_BITS, axis=0, return_inverse=True)
        away = np.array([_key(region) in self._away for region in regions])
        return away[which.reshape(-1)]

    def away(self) -> dict[Region, Away]:
        """The regions on disk."""
        return self._away

    def records(self, region: Region) -> BlockRecords:
        """Content of a region on disk.

        Raises:
            MapError: It cannot be read.
        """
        if self._archive is not None and region in self._archived:
            return self._archive(region)
        parts = self._stored.read(str(region))
        return records_of([parts[n : n + len(COLUMNS)] for n in range(0, len(parts), len(COLUMNS))])

    def continue_from(self, archive: Callable[[Region], BlockRecords]) -> None:
        """Read regions from an archive until they return to memory."""
        self._archived, self._archive = set(self._away), archive

    def changed(self, first: NDArray[np.integer]) -> None:
        """Mark the region that begins at a block (3,) as changed other than by a frame."""
        self._returned.pop(_key(first >> REGION_BITS), None)

    def focus(self, tree: BlockTree, low: NDArray[np.integer], high: NDArray[np.integer], frame_number: int) -> None:
        """Load the box from ``low`` to ``high`` (3,) and ``MARGIN`` around it. The farthest regions leave if there are
        too many; entries are then renumbered."""
        first = (low.astype(np.int64) - MARGIN) >> REGION_BITS
        last = (high.astype(np.int64) + MARGIN - 1) >> REGION_BITS
        wanted = self._stored_in(first, last) if self._away else []
        self._make_room(tree, first, last, frame_number, wanted)
        for region in wanted:
            self._bring_back(tree, region, frame_number)

    def _stored_in(self, first: NDArray[np.integer], last: NDArray[np.integer]) -> list[Region]:
        if np.prod(last - first + 1) > len(self._away):
            (x0, y0, z0), (x1, y1, z1) = _key(first), _key(last)
            return [(x, y, z) for x, y, z in self._away if x0 <= x <= x1 and y0 <= y <= y1 and z0 <= z <= z1]
        ranges = (range(a, b + 1) for a, b in zip(_key(first), _key(last), strict=True))
        return [(x, y, z) for x, y, z in product(*ranges) if (x, y, z) in self._away]

    def _bring_back(self, tree: BlockTree, region: Region, frame_number: int) -> None:
        records = self.records(region)
        if region not in self._archived:
            self._returned[region] = frame_number, self._away[region].serial
        del self._away[region]
        self._archived.discard(region)
        tree.insert(records, frame_number + 1)  # stamped as the next frame, so that copies of the map pick them up

    def _make_room(
        self, tree: BlockTree, first: NDArray[np.integer], last: NDArray[np.integer], number: int, coming: list[Region]
    ) -> None:
        """Store the farthest regions until the blocks, with the incoming ones, fit."""
        self._retry_in = max(self._retry_in - 1, 0)
        allowed = self.max_blocks if isinstance(self.max_blocks, int) else self.max_blocks(tree)
        needed = tree.num_voxel_blocks + sum(self._away[one].voxel_blocks + self._away[one].finer for one in coming)
        if needed <= allowed or self._retry_in:
            return
        keys, region_of = _regions_of_entries(tree)
        owned = np.bincount(region_of, tree.owned_slots(), minlength=len(keys))
        outside = np.maximum(np.maximum(first - keys, keys - last), 0)
        distance = np.linalg.norm(outside, axis=1)
        leaving = np.zeros(len(keys), dtype=bool)
        for n in np.lexsort((np.arange(len(keys)), -distance)):
            if needed <= ROOM * allowed or distance[n] == 0:
                break
            leaving[n] = True
            needed -= owned[n]
        if leaving.any() and self._send_away(tree, keys, region_of, leaving, number):
            tree.remove(np.flatnonzero(leaving[region_of]), number + 1)

    def page_out(self, tree: BlockTree, frame_number: int) -> bool:
        """Move all regions to disk and return whether that succeeded. The caller then empties ``tree``."""
        keys, region_of = _regions_of_entries(tree)
        return self._send_away(tree, keys, region_of, np.ones(len(keys), dtype=bool), frame_number)

    def _send_away(
        self,
        tree: BlockTree,
        keys: NDArray[np.integer],
        region_of: NDArray[np.integer],
        leaving: NDArray[np.bool_],
        frame_number: int,
    ) -> bool:
        """Write the leaving regions; after a failure none has left."""
        order = np.argsort(region_of, kind="stable")
        ends = np.cumsum(np.bincount(region_of, minlength=len(keys)))
        voxel_blocks = np.bincount(region_of, tree.blocks.slot_of[: tree.blocks.num_entries] >= 0, minlength=len(keys))
        finer = np.bincount(region_of, tree.owned_slots(), minlength=len(keys)) - voxel_blocks
        away: dict[Region, Away] = {}
        try:
            for n in np.flatnonzero(leaving):
                region, entries = _key(keys[n]), order[ends[n - 1] if n else 0 : ends[n]]
                returned_in, serial = self._returned.get(region, (-1, 0))
                if returned_in != frame_number:  # no valid copy in the store
                    serial = self._next_serial = self._next_serial + 1
                    levels = blobs_of(tree.records(entries))
                    self._stored.write(str(region), [blob for level in levels for blob in level])
                away[region] = Away(serial, len(entries), int(voxel_blocks[n]), int(finer[n]))
        except MapError as error:
            self.failure, self._retry_in = str(error), RETRY_AFTER
            return False
        self.failure = ""
        self._away |= away
        for region in away:
            self._returned.pop(region, None)
        return True

    @property
    def _stored(self) -> ScratchStore:
        if self._store is None:
            self._store = ScratchStore("blocks of the map")
        return self._store


def regions_of(tree: BlockTree, pager: BlockPager | None) -> list[Region]:
    """All regions of a map in Morton order."""
    near, _ = _regions_of_entries(tree)
    stored = np.array(list(() if pager is None else pager.away()), np.int64).reshape(-1, 3)
    regions = np.unique(np.concatenate([near, stored]), axis=0)
    return [_key(region) for region in regions[np.argsort(morton.encode(regions))]]


def _regions_of_entries(tree: BlockTree) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    x, y, z = (tree.blocks.coords[: tree.blocks.num_entries].T.astype(np.int64) >> REGION_BITS) + (1 << 15)
    packed, region_of = np.unique((x << 32) | (y << 16) | z, return_inverse=True)
    parts = [(packed >> shift) & 0xFFFF for shift in (32, 16, 0)]
    return np.stack(parts, axis=1) - (1 << 15), region_of.reshape(-1)


def _key(region: NDArray[np.integer]) -> Region:
    x, y, z = region.tolist()
    return x, y, z
