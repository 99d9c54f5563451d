"""Temporary file that holds blocks which have left the memory."""

import sqlite3
import tempfile
import threading
import weakref
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from dudmap.core.map.voxel_blocks import BLOCK, BlockRecords
from dudmap.errors import MapError

COLUMNS = tuple(field.name for field in fields(BlockRecords) if field.name != "finer")
"""Arrays of a row: of the blocks of one level of a region, 0 is the coarsest."""
_TYPES = {
    "coords": (np.int32, 3), "free_count": (np.uint8, 1), "owners": (np.int32, 1), "geometry": (np.int32, BLOCK**3),
    "colors": (np.int32, BLOCK**3), "fused": (np.uint8, 1),
}  # fmt: skip


class RegionStore:
    """Regions of blocks in a temporary SQLite database, which is removed with the last reference to it.

    Methods may be called by any thread.
    """

    def __init__(self) -> None:
        folder = tempfile.TemporaryDirectory(prefix="dudmap-map-")
        self._lock = threading.Lock()
        self._connection = connection = sqlite3.connect(Path(folder.name) / "regions.db", check_same_thread=False)
        connection.execute("PRAGMA journal_mode = MEMORY")  # a scratch file: nothing is read from it after a crash
        connection.execute("PRAGMA synchronous = OFF")
        columns = ", ".join(f"{name} BLOB" for name in COLUMNS)
        key = "x INTEGER, y INTEGER, z INTEGER, level INTEGER"
        connection.execute(f"CREATE TABLE regions ({key}, {columns}, PRIMARY KEY (x, y, z, level))")
        self.close = weakref.finalize(self, _remove, connection, self._lock, folder)

    def write(self, region: tuple[int, int, int], records: BlockRecords) -> None:
        """Store a region, in place of what was stored of it.

        Raises:
            MapError: The file cannot be written.
        """
        rows = [(*region, level, *blobs) for level, blobs in enumerate(blobs_of(records))]
        marks = ", ".join("?" * (4 + len(COLUMNS)))
        try:
            with self._lock, self._connection:
                self._connection.execute("DELETE FROM regions WHERE x = ? AND y = ? AND z = ?", region)
                self._connection.executemany(f"INSERT INTO regions VALUES ({marks})", rows)
        except sqlite3.Error as error:
            raise MapError(
                f"blocks of the map cannot be stored in {tempfile.gettempdir()}: {error}; make room there, or name "
                "another folder in the environment variable TMPDIR"
            ) from error

    def read(self, region: tuple[int, int, int]) -> BlockRecords:
        """A region that was stored.

        Raises:
            MapError: The file cannot be read, or does not hold the region.
        """
        query = f"SELECT {', '.join(COLUMNS)} FROM regions WHERE x = ? AND y = ? AND z = ? ORDER BY level"
        try:
            with self._lock:
                rows = self._connection.execute(query, region).fetchall()
        except sqlite3.Error as error:
            raise MapError(f"blocks of the map cannot be read from {tempfile.gettempdir()}: {error}") from error
        if not rows:
            raise MapError(f"region {region} of the map is missing in {tempfile.gettempdir()}")
        return records_of(rows)


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


def _remove(connection: sqlite3.Connection, lock: threading.Lock, folder: tempfile.TemporaryDirectory) -> None:
    with lock:  # a connection that is closed while another thread uses it ends the process
        connection.close()
    folder.cleanup()
