"""Blocks of a region as byte strings, as they wait on disk and are stored in a database."""

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np

from dudmap.core.map.voxel_blocks import BLOCK, BlockRecords

COLUMNS = tuple(field.name for field in fields(BlockRecords) if field.name != "finer")
"""Arrays of a row: of the blocks of one level of a region, 0 is the coarsest."""
_TYPES = {
    "coords": (np.int32, 3), "free_count": (np.uint8, 1), "owners": (np.int32, 1), "geometry": (np.int32, BLOCK**3),
    "colors": (np.int32, BLOCK**3), "fused": (np.uint8, 1),
}  # fmt: skip


def blobs_of(records: BlockRecords) -> list[list[memoryview]]:
    """The arrays of records as they are stored, in the order of ``COLUMNS``, level by level."""
    levels = [records, *records.finer]
    return [[np.ascontiguousarray(getattr(level, name)).data for name in COLUMNS] for level in levels]


def records_of(rows: Sequence[Sequence[bytes]]) -> BlockRecords:
    """The records of stored arrays, level by level.

    Raises:
        ValueError: They do not fit each other.
    """
    levels = [_level_of(blobs) for blobs in rows]
    return replace(levels[0], finer=tuple(levels[1:]))


def _level_of(blobs: Sequence[bytes]) -> BlockRecords:
    """The blocks of one level; see ``records_of``."""
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
