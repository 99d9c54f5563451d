"""The database of a run: one SQLite file, one transaction per checkpoint.

Tables: ``blocks`` (voxels by map and slot), ``regions`` (paged out), ``frames``, ``chunks`` (parts of arrays by
content), ``state`` (the tree), ``meta``. The write-ahead log makes a checkpoint atomic, and readable during writing.
"""

import hashlib
import json
import math
import sqlite3
import weakref
import zlib
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from dudmap.app.state.blocks import VOXELS, FrameSnapshot, MapSnapshot, Snapshot, StoredFrames, StoredMaps
from dudmap.core.map.block_pager import Region
from dudmap.core.map.voxel_blocks import COLUMNS, BlockRecords, blobs_of, records_of
from dudmap.core.places.frame_store import EncodedFrame
from dudmap.errors import StateError
from dudmap.input_files import (
    DAMAGE,
    LARGEST_FILE,
    LARGEST_RATIO,
    LARGEST_TREE,
    RATIO_FREE_BYTES,
    SAFE_KINDS,
    inflated,
    parse_json,
)  # fmt: skip
from dudmap.own_folder import OwnFolder

APPLICATION = 0x44554453
"""Application number of the file: DUDS."""
SCHEMA = 6
CHUNK = 1 << 16
STEPS, LIMIT = 10_000, 100_000
"""SQLite instructions between checks for ctrl-C, and checks until a statement is ended."""
ROWS = 4096
TABLES = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE state (id INTEGER PRIMARY KEY CHECK (id = 1), crc INTEGER NOT NULL, tree BLOB NOT NULL);
CREATE TABLE chunks (key BLOB PRIMARY KEY, content BLOB NOT NULL);
CREATE TABLE blocks (map INTEGER, slot INTEGER, x INTEGER NOT NULL, y INTEGER NOT NULL, z INTEGER NOT NULL,
                     crc INTEGER NOT NULL, voxels BLOB NOT NULL, PRIMARY KEY (map, slot));
CREATE TABLE regions (map INTEGER, x INTEGER, y INTEGER, z INTEGER, level INTEGER, crc INTEGER NOT NULL, coords BLOB,
                      free_count BLOB, owners BLOB, geometry BLOB, colors BLOB, fused BLOB,
                      PRIMARY KEY (map, x, y, z, level));
CREATE TABLE frames (store INTEGER, number INTEGER, depth BLOB NOT NULL, color BLOB NOT NULL, mask BLOB NOT NULL,
                     PRIMARY KEY (store, number));
"""


class StateDatabase:
    """Writes checkpoints, from one thread at a time.

    Args:
        path: Created with its tables if missing.

    Raises:
        OSError: The file is no plain file.
        sqlite3.Error: It cannot be created or opened.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.maps, self.frames = StoredMaps(), StoredFrames()
        with OwnFolder(path.parent, linked=True) as folder:
            folder.check(path.name, alone=True)  # it is written in place
        self._constants: dict[int, tuple[weakref.ref[NDArray], list[str]]] = {}  # chunks of arrays that never change
        self._chunks: set[str] = set()
        self._connection = sqlite3.connect(path, isolation_level=None, check_same_thread=False, timeout=5)
        weakref.finalize(self, self._connection.close)
        self._execute("PRAGMA trusted_schema = OFF")
        self._execute("PRAGMA journal_mode = WAL")
        self._execute("PRAGMA synchronous = FULL")  # a commit is on the disk when it returns
        if not self._execute("SELECT 1 FROM sqlite_master").fetchone():
            self._connection.executescript(
                f"BEGIN; PRAGMA application_id = {APPLICATION}; PRAGMA user_version = {SCHEMA}; {TABLES} COMMIT;"
            )
        self._chunks = {row[0].hex() for row in self._execute("SELECT key FROM chunks")}

    def write_meta(self, values: dict[str, Any]) -> None:
        """Set values that describe the run, atomically.

        Raises:
            sqlite3.Error: They cannot be written.
        """
        rows = json.dumps({key: json.dumps(value) for key, value in values.items()})
        self._connection.execute("INSERT OR REPLACE INTO meta SELECT key, value FROM json_each(?)", [rows])

    def write(self, snapshot: Snapshot, meta: dict[str, Any]) -> None:
        """Store a snapshot as one transaction.

        Raises:
            sqlite3.Error: It failed; the previous checkpoint stays.
        """
        arrays = [self._described(array, n in snapshot.constant) for n, array in enumerate(snapshot.arrays)]
        described = {"tree": snapshot.tree, "arrays": [one for one, _ in arrays]}
        parts = {key: part for _, found in arrays for key, part in found.items()}
        used = {key for one, _ in arrays for key in one["chunks"]}
        tree = zlib.compress(json.dumps(described).encode(), 1)
        self._execute("BEGIN IMMEDIATE")
        try:
            self._write_maps(snapshot.maps)
            self._write_frames(snapshot.frames)
            new = ((bytes.fromhex(key), parts[key]) for key in used - self._chunks)
            self._connection.executemany("INSERT OR IGNORE INTO chunks VALUES (?, ?)", new)
            old = ((bytes.fromhex(key),) for key in self._chunks - used)
            self._connection.executemany("DELETE FROM chunks WHERE key = ?", old)
            self._execute("INSERT OR REPLACE INTO state VALUES (1, ?, ?)", zlib.crc32(tree), tree)
            self.write_meta(meta)
            self._execute("COMMIT")
        except BaseException:
            if self._connection.in_transaction:
                self._execute("ROLLBACK")
            raise
        self.maps.commit(snapshot.maps)
        self.frames.commit(snapshot.frames)
        self._chunks = used
        alive = {id(snapshot.arrays[n]) for n in snapshot.constant}
        self._constants = {key: value for key, value in self._constants.items() if key in alive}
        self._execute("PRAGMA busy_timeout = 0")  # do not wait for readers; their pages stay in the log
        self._execute("PRAGMA wal_checkpoint(TRUNCATE)")
        self._execute("PRAGMA busy_timeout = 5000")

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def _execute(self, statement: str, *values: object) -> sqlite3.Cursor:
        return self._connection.execute(statement, values)

    def _write_maps(self, maps: list[MapSnapshot]) -> None:
        run, known = self._connection.executemany, {stored.number: stored for stored in self.maps.by_id.values()}
        for number in known.keys() - {changed.number for changed in maps}:
            self._execute("DELETE FROM blocks WHERE map = ?", number)
            self._execute("DELETE FROM regions WHERE map = ?", number)
        for changed in maps:
            number, stored = changed.number, known.get(changed.number)
            if stored is not None:
                run("DELETE FROM blocks WHERE map = ? AND slot = ?", ((number, n) for n in changed.released.tolist()))
                self._execute("DELETE FROM blocks WHERE map = ? AND slot >= ?", number, changed.num_slots)
                back = ((number, *region) for region in stored.regions.keys() - changed.away.keys())
                run("DELETE FROM regions WHERE map = ? AND x = ? AND y = ? AND z = ?", back)
            for region, records in changed.regions:
                self._execute("DELETE FROM regions WHERE map = ? AND x = ? AND y = ? AND z = ?", number, *region)
                levels = ((n, _checksum(blobs), *blobs) for n, blobs in enumerate(blobs_of(records)))
                run(f"INSERT INTO regions VALUES ({', '.join('?' * 12)})", ((number, *region, *row) for row in levels))
            blocks = zip(changed.slots.tolist(), changed.coords.tolist(), changed.voxels, strict=True)
            rows = ((number, slot, *coords, zlib.crc32(voxels), voxels.tobytes()) for slot, coords, voxels in blocks)
            run("INSERT OR REPLACE INTO blocks VALUES (?, ?, ?, ?, ?, ?, ?)", rows)

    def _write_frames(self, frames: list[FrameSnapshot]) -> None:
        for changed in frames:
            gone = ((changed.number, serial) for serial in changed.gone)
            self._connection.executemany("DELETE FROM frames WHERE store = ? AND number = ?", gone)
            rows = ((changed.number, serial, *parts) for serial, parts in changed.frames.items())
            self._connection.executemany("INSERT INTO frames VALUES (?, ?, ?, ?, ?)", rows)

    def _described(self, array: NDArray | list[Any], constant: bool) -> tuple[dict[str, Any], dict[str, bytes]]:
        """Type, shape and chunk keys of an array, and chunks; plain lists as lines of JSON."""
        if isinstance(array, list):
            array = np.frombuffer("".join(json.dumps(record) + "\n" for record in array).encode(), np.uint8)
        transposed = array.ndim > 1 and array.flags.f_contiguous and not array.flags.c_contiguous
        about = {"dtype": array.dtype.str, "shape": array.shape, "transposed": transposed}
        known = self._constants.get(id(array))
        if constant and known is not None and known[0]() is array:
            return about | {"chunks": known[1]}, {}
        data = np.ascontiguousarray(array.T if transposed else array).reshape(-1).view(np.uint8).data
        pieces = [data[start : start + CHUNK] for start in range(0, len(data), CHUNK)]
        keys = [hashlib.blake2b(piece, digest_size=16).hexdigest() for piece in pieces]
        if constant:
            self._constants[id(array)] = weakref.ref(array), keys
        return about | {"chunks": keys}, {key: bytes(piece) for key, piece in zip(keys, pieces, strict=True)
                                          if key not in self._chunks}  # fmt: skip


class StateReader:
    """Reads one checkpoint, also during the run.

    Raises:
        StateError: The file is missing or foreign; all methods: damaged, or a row is missing.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.is_file():
            raise StateError(f"there is no state of a run at {path}")
        if path.with_name(f"{path.name}-journal").exists():  # SQLite would replay it, even into other files
            raise StateError(f"found a {path.name}-journal next to {path}; no run writes one: remove it")
        _check_size(path)
        self._left = 0
        try:
            self._connection = sqlite3.connect(f"file:{quote(str(path.resolve()))}?mode=ro", uri=True, timeout=5,
                                               isolation_level=None, check_same_thread=False)  # fmt: skip
            weakref.finalize(self, self._connection.close)
            self._connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST_FILE)
            self._connection.set_progress_handler(self._is_too_long, STEPS)
            for safety in ("trusted_schema = OFF", "cell_size_check = ON"):
                self._connection.execute(f"PRAGMA {safety}")
            self._connection.execute("BEGIN")  # all reads see one checkpoint
            found = [self._connection.execute(f"PRAGMA {name}").fetchone()[0] for name in _HEADER]
        except sqlite3.Error as error:
            raise StateError(f"{path} is not a readable state of a run: {error}") from error
        if found[0] != APPLICATION:
            raise StateError(f"{path} is not the state of a run")
        if found[1] != SCHEMA:
            raise StateError(f"{path} was written in version {found[1]} of the format; this version reads {SCHEMA}")
        if list(self._rows(_TABLES_OF)) != _own_tables() or list(self._rows("PRAGMA quick_check(1)")) != [("ok",)]:
            raise StateError(f"{path} is damaged or not of this program: it has other tables than a state")

    def meta(self) -> dict[str, Any]:
        """Description of the run, by name."""
        try:
            return {key: parse_json(value, exact=True) for key, value in self._rows("SELECT key, value FROM meta")}
        except (ValueError, TypeError, AttributeError) as error:
            raise self._damaged(error) from error

    def state(self) -> tuple[Any, list[NDArray]] | None:
        """Tree and arrays of the checkpoint; None if there is none yet."""
        rows = list(self._rows("SELECT crc, tree FROM state"))
        if not rows:
            return None
        crc, packed = rows[0]
        try:
            if zlib.crc32(packed) != crc:
                raise ValueError("its checksum is wrong")
            described = parse_json(inflated(packed, LARGEST_TREE), exact=True)
            chunks = {bytes.hex(key): content for key, content in self._rows("SELECT key, content FROM chunks")}
            parts = [key for one in described["arrays"] for key in one["chunks"]]
            total, held = sum(len(chunks[key]) for key in parts), sum(map(len, chunks.values()))
            if total > max(RATIO_FREE_BYTES, LARGEST_RATIO * held):  # a chunk may belong to many arrays
                raise ValueError(f"its arrays have {total} bytes, and {held} are stored")
            return described["tree"], [_array(about, chunks) for about in described["arrays"]]
        except (*DAMAGE, MemoryError) as error:
            raise self._damaged(error) from error

    def blocks(self, map_number: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int32]]:
        """Slots (n,), block coordinates (n, 3) and voxels (n, VOXELS) of a map, by slot."""
        select = "SELECT slot, x, y, z, crc, voxels FROM blocks WHERE map = ? ORDER BY slot"
        rows = list(self._rows(select, map_number))
        for *place, crc, content in rows:
            whole = all(isinstance(n, int) for n in place) and isinstance(content, bytes) and len(content) == 4 * VOXELS
            if not whole or zlib.crc32(content) != crc:
                raise self._damaged(f"block {place[0]} is not as it was written")
        voxels = np.empty((len(rows), VOXELS), np.int32)
        for n in range(0, len(rows), ROWS):
            part = b"".join(row[5] for row in rows[n : n + ROWS])
            voxels[n : n + ROWS] = np.frombuffer(part, np.int32).reshape(-1, VOXELS)
        places = np.array([row[:4] for row in rows], np.int64).reshape(-1, 4)
        return places[:, 0], places[:, 1:], voxels

    def region(self, map_number: int, region: Region) -> BlockRecords:
        """Blocks of a paged-out region."""
        columns, where = ", ".join(COLUMNS), "map = ? AND x = ? AND y = ? AND z = ?"
        select = f"SELECT level, crc, {columns} FROM regions WHERE {where} ORDER BY level"
        rows = list(self._rows(select, map_number, *region))
        try:
            if not rows or any(row[0] != n or _checksum(row[2:]) != row[1] for n, row in enumerate(rows)):
                raise ValueError("it is missing or not as it was written")
            return records_of([row[2:] for row in rows])
        except (ValueError, TypeError) as error:
            raise self._damaged(f"region {region}: {error}") from error

    def frame(self, store: int, serial: int) -> EncodedFrame:
        """A stored frame by serial: depth, colour and mask files."""
        select = "SELECT depth, color, mask FROM frames WHERE store = ? AND number = ?"
        rows = list(self._rows(select, store, serial))
        if not rows or not all(isinstance(content, bytes) for content in rows[0]):
            raise self._damaged(f"stored frame {serial} is missing")
        depth, color, mask = rows[0]
        return depth, color, mask

    def frames(self, store: int) -> list[int]:
        """Serials of the stored frames of a store, ascending."""
        return [row[0] for row in self._rows("SELECT number FROM frames WHERE store = ? ORDER BY number", store)]

    def release(self) -> None:
        """Release the checkpoint; later reads see the newest."""
        self._connection.execute("COMMIT")

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def _rows(self, statement: str, *values: object) -> Iterable[Sequence[Any]]:
        self._left = LIMIT
        try:
            yield from self._connection.execute(statement, values)
        except (sqlite3.Error, UnicodeDecodeError) as error:
            if "interrupted" in str(error) and self._left > 0:  # ctrl-C in the handler arrives as this error
                raise KeyboardInterrupt from None
            raise self._damaged(error) from error

    def _damaged(self, what: object) -> StateError:
        return StateError(f"the state of the run in {self.path} is damaged: {what}")

    def _is_too_long(self) -> bool:
        """Whether a statement must end; SQLite calls it, so that Python handles ctrl-C."""
        self._left -= 1
        return self._left <= 0


_HEADER = "application_id", "user_version"
_TABLES_OF = "SELECT type, name, tbl_name, sql FROM sqlite_master ORDER BY name"


def _own_tables() -> list[tuple[str, ...]]:
    with closing(sqlite3.connect(":memory:")) as connection:
        connection.executescript(TABLES)
        return list(connection.execute(_TABLES_OF))


def _check_size(path: Path) -> None:
    status = path.stat()
    stored = 512 * getattr(status, "st_blocks", status.st_size)
    if status.st_size > max(RATIO_FREE_BYTES, LARGEST_RATIO * stored):
        raise StateError(f"{path} is damaged or not of this program: {stored} of its {status.st_size} bytes are there")


def _checksum(blobs: Sequence[bytes | memoryview]) -> int:
    crc = 0
    for blob in blobs:
        crc = zlib.crc32(blob, crc)
    return crc


def _array(about: dict[str, Any], chunks: dict[str, bytes]) -> NDArray:
    dtype, shape = np.dtype(about["dtype"]), tuple(about["shape"])
    if dtype.kind not in SAFE_KINDS or any(type(length) is not int or length < 0 for length in shape) or len(shape) > 8:
        raise ValueError(f"found an array of {dtype} with the shape {shape}; expected numbers or text")
    if math.prod(shape) * dtype.itemsize != sum(len(chunks[key]) for key in about["chunks"]):
        raise ValueError(f"an array of {dtype} with the shape {shape} has not the size of its parts")
    data = b"".join(_checked(key, chunks[key]) for key in about["chunks"])
    stored = np.frombuffer(data, np.uint8).view(dtype) if data else np.empty(0, dtype)
    if about["transposed"]:
        return stored.reshape(shape[::-1]).T.copy(order="K")
    return stored.reshape(shape).copy()


def _checked(key: str, content: bytes) -> bytes:
    if hashlib.blake2b(content, digest_size=16).hexdigest() != key:
        raise ValueError("an array is not as it was written")
    return content
