"""Read a bag with rosbags: topics, message times, and single messages.

rosbags trusts its input. This module limits decompression, accepts plain SQLite tables only, and decodes by the
published ROS definitions, which rosbags would otherwise turn into Python code.
"""

import os
import sqlite3
import struct
from bz2 import BZ2Decompressor
from collections.abc import Callable, Generator, Iterable
from contextlib import closing, contextmanager
from itertools import islice
from pathlib import Path
from threading import Lock
from typing import IO, TYPE_CHECKING, Any, NamedTuple, cast
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import DatasetError
from dudmap.extras import extra
from dudmap.input_files import LARGEST_RATIO, RATIO_FREE_BYTES, open_plain, read_text
from dudmap.io.sequences.unclosed import LARGEST_CHUNK, CompletedFile, completed

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

LARGEST_METADATA = 2**19
"""Bytes of metadata.yaml: 60 kB with 100 topics; parsing takes 20 seconds per megabyte."""
SAMPLES = 30
CDR_STAMP = {0: struct.Struct(">4xiI"), 1: struct.Struct("<4xiI")}
"""Encapsulation, seconds and nanoseconds of a ROS 2 message, by byte order."""
ROS1_STAMP = struct.Struct("<4xII")
"""Sequence number, seconds and nanoseconds of a ROS 1 message."""
HEAD = 12
MCAP_RECORD, MCAP_INDEX, MCAP_MESSAGE, MCAP_CHUNK = 9, 6, 31, 49
"""Bytes before MCAP content: record, index entries, message, uncompressed chunk (MCAP specification, sections Records,
Message and Chunk)."""
TF = "tf2_msgs/msg/TFMessage"
OLD_TF = "tf/msg/tfMessage"


class MessageTimes(NamedTuple):
    """Times of the messages of a topic, as recorded.

    Attributes:
        recorded: (N,) int64 strictly increasing recording times, nanoseconds; they identify a message.
        stamps: (N,) float64 header times, seconds.
        exact: Whether ``stamps`` are from headers; else recording times minus a median delay.
    """

    recorded: NDArray[np.int64]
    stamps: NDArray[np.float64]
    exact: bool


class BagFile:
    """An open bag.

    Args:
        path: As of ``RosBag``.

    Attributes:
        connections: Topics with type and count.
        unclosed: Whether the end may be missing.

    Raises:
        MissingExtraError: The package rosbags is missing.
        DatasetError: The bag is damaged.
    """

    def __init__(self, path: Path) -> None:
        with extra("ros-bags", f"the ROS bag {path}"):
            from rosbags import rosbag1, rosbag2
            from rosbags.typesys import Stores, get_typestore
        self._ros1, self.unclosed = path.suffix in (".bag", ".active"), False
        try:
            _check(path)
            limit_rosbags()
            with without_definitions():
                make: Any = (rosbag1 if self._ros1 else rosbag2).Reader
                self._reader, self.unclosed = _opened(make, path)
        except Exception as error:  # errors of rosbags and its decompressors for damaged data have no common base
            raise DatasetError(f"cannot open the bag {path}: {error}") from error
        self.connections: list[Connection] = self._reader.connections
        self._types = get_typestore(Stores.ROS1_NOETIC if self._ros1 else Stores.ROS2_HUMBLE)
        if self._ros1:
            tf = get_typestore(Stores.ROS2_HUMBLE).fielddefs[TF]
            self._types.register({TF: tf, OLD_TF: tf})
        self._stream = MessageStream(self._passing)

    def close(self) -> None:
        """Close the file."""
        self._stream.close()
        self._reader.close()

    def messages(self, connections: "list[Connection]", count: int | None = None) -> Generator[tuple[int, Any]]:
        """Recording times and content of the first ``count`` messages of some topics, None for all."""
        with self._stream.lock, closing(self._reader.messages(connections)) as found:
            self._stream.close()  # without chunks, two passes would move one place in the file
            for connection, time, raw in islice(found, count):
                yield time, self._decoded(raw, connection)

    def first(self, connection: "Connection | None") -> Any:  # noqa: ANN401 - the type is made from its definition
        """First message of a topic, None without one."""
        for _, message in self.messages([connection], 1) if connection else ():
            return message
        return None

    def times(self, connection: "Connection") -> MessageTimes:
        """Header times of the messages of a topic, from the index and the first bytes. Times of compressed bags are
        estimated."""
        rows = list(self._ros1_entries(connection) if self._ros1 else self._ros2_entries(connection))
        recorded, first = np.unique(np.array([time for time, _ in rows], dtype=np.int64), return_index=True)
        heads = [head for _, head in rows if head is not None]
        if len(heads) == len(rows):
            return MessageTimes(recorded, np.array([self._stamp(heads[k]) for k in first], np.float64), True)
        with closing(self._reader.messages([connection])) as messages:
            delays = [1e-9 * time - self._stamp(raw) for _, time, raw in islice(messages, SAMPLES)]
        return MessageTimes(recorded, 1e-9 * recorded - np.median(delays), False)

    def read(self, wanted: "list[tuple[Connection, int]]") -> list[Any]:
        """Messages at these recording times, of the same topics in every call.

        Raises:
            KeyError: There is no such message.
        """
        raw = self._stream.read([(connection.topic, time) for connection, time in wanted])
        return [self._decoded(data, connection) for data, (connection, _) in zip(raw, wanted, strict=True)]

    def _passing(self, topics: list[str], start: int) -> Generator[tuple[str, int, bytes]]:
        chosen = [connection for connection in self.connections if connection.topic in topics]
        with closing(self._reader.messages(chosen, start=start)) as messages:
            yield from ((connection.topic, time, bytes(data)) for connection, time, data in messages)

    def _decoded(self, raw: bytes, connection: "Connection") -> Any:  # noqa: ANN401
        decode = self._types.deserialize_ros1 if self._ros1 else self._types.deserialize_cdr
        return decode(raw, connection.msgtype)

    def _stamp(self, data: bytes) -> float:
        seconds, nanoseconds = (ROS1_STAMP if self._ros1 else CDR_STAMP[data[1] & 1]).unpack_from(data)
        return seconds + 1e-9 * nanoseconds

    def _ros1_entries(self, connection: "Connection") -> Generator[tuple[int, bytes | None]]:
        """Time of recording and first bytes of every message; None for compressed ones."""
        from rosbags.rosbag1.reader import Header, RecordType, decompressors, read_uint32

        with _open(self._reader.path) as file:
            for entry in self._reader.indexes[connection.id]:
                chunk = self._reader.chunks[entry.chunk_pos]
                if chunk.decompressor is not decompressors["none"]:
                    yield entry.time, None
                    continue
                file.seek(chunk.datapos + entry.offset)
                while Header.read(cast("Any", file)).get_uint8("op") == RecordType.CONNECTION:
                    file.seek(read_uint32(cast("Any", file)), os.SEEK_CUR)
                file.seek(4, os.SEEK_CUR)
                yield entry.time, file.read(HEAD)

    def _ros2_entries(self, connection: "Connection") -> Generator[tuple[int, bytes | None]]:
        storage = self._reader.storage
        packed = storage.metadata.compression_mode == "message"
        for part in getattr(storage, "storages", [storage]):  # a folder with metadata.yaml has one or several files
            for own in (other for other in part.connections if other.topic == connection.topic):
                for time, head in (_sqlite_entries if hasattr(part, "dbconn") else _mcap_entries)(part, own):
                    yield time, None if packed else head


def _sqlite_entries(part: Any, connection: "Connection") -> Generator[tuple[int, bytes | None]]:  # noqa: ANN401
    with closing(sqlite3.connect(_sqlite_uri(part.path), uri=True)) as database:
        rows = database.execute("SELECT id, timestamp FROM messages WHERE topic_id = ?", (connection.id,)).fetchall()
        for row, time in rows:
            with database.blobopen("messages", "data", row, readonly=True) as blob:
                yield time, blob.read(HEAD)


def _mcap_entries(part: Any, connection: "Connection") -> Iterable[tuple[int, bytes | None]]:  # noqa: ANN401
    if not part.chunks:
        yield from ((time, bytes(data[:HEAD])) for _, time, data in part.messages([connection]))
        return
    with _open(part.path) as file:
        for chunk in (chunk for chunk in part.chunks if connection.id in chunk.message_index_offsets):
            file.seek(chunk.message_index_offsets[connection.id])
            index = file.read(struct.unpack_from("<Q", file.read(MCAP_RECORD), 1)[0])
            for time, offset in struct.iter_unpack("<QQ", index[MCAP_INDEX:]):
                if chunk.compression:
                    yield time, None
                    continue
                file.seek(chunk.chunk_start_offset + MCAP_CHUNK + offset + MCAP_MESSAGE)
                yield time, file.read(HEAD)


def _opened(make: Callable[[Any], Any], path: Path) -> tuple[Any, bool]:
    reader = make(path)
    try:
        reader.open()
    except Exception as error:  # see above
        whole = completed(path) if path.is_file() else None
        if whole is None:
            raise
        reader = make(whole)
        try:
            reader.open()
        except Exception:
            raise error from None
        return reader, True
    return reader, False


def _open(path: Any) -> IO[bytes]:  # noqa: ANN401 - a path, or a file that stands for one
    return path.open() if isinstance(path, CompletedFile) else open_plain(path)


def _check(path: Path) -> None:
    """Accept plain files and SQLite tables only: a view would be a program."""
    if path.is_dir():
        read_text(path / "metadata.yaml", LARGEST_METADATA)
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if file.suffix in (".db3", ".mcap", ".bag", ".active"):
            open_plain(file).close()
        if file.suffix == ".db3":
            with closing(sqlite3.connect(_sqlite_uri(file), uri=True)) as database:
                found = database.execute("SELECT type, name, sql FROM sqlite_master").fetchall()
            for kind, name, sql in found:
                if kind not in ("table", "index") or "VIRTUAL" in str(sql).upper() or "GENERATED" in str(sql).upper():
                    raise ValueError(f"it holds {name!r}, which is neither a plain table nor an index")


def _sqlite_uri(path: Path) -> str:
    return f"file:{quote(str(path))}?mode=ro&immutable=1"


def limit_rosbags() -> None:
    """Limit the unpacked sizes in rosbags."""
    import lz4.frame
    from rosbags.rosbag1 import reader as rosbag1
    from rosbags.rosbag2 import reader as rosbag2
    from rosbags.rosbag2 import storage_mcap

    zstd = cast("Any", storage_mcap).zstd
    unzstd, unlz4 = bounded(zstd.ZstdDecompressor), bounded(lz4.frame.LZ4FrameDecompressor)
    rosbag1.decompressors.update(bz2=bounded(BZ2Decompressor), lz4=unlz4)
    storage_mcap.DECOMPRESSORS.update(lz4=lambda data, _: unlz4(data), zstd=lambda data, _: unzstd(data))
    cast("Any", rosbag2).zstd = _BoundedZstd(zstd, unzstd)


@contextmanager
def without_definitions() -> Generator[None]:
    """Make rosbags ignore message definitions in MCAP files."""
    from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
    from rosbags.rosbag2 import storage_mcap

    theirs = storage_mcap.get_msgdef
    storage_mcap.get_msgdef = lambda schema: MessageDefinition(MessageDefinitionFormat.NONE, "")
    try:
        yield
    finally:
        storage_mcap.get_msgdef = theirs


def bounded(make: Callable[[], Any]) -> Callable[[bytes], bytes]:
    """Limit a decompressor to ``LARGEST_CHUNK`` bytes."""

    def decompress(data: bytes) -> bytes:
        out = make().decompress(bytes(data), LARGEST_CHUNK + 1)
        if len(out) > LARGEST_CHUNK:
            raise ValueError(f"a chunk unpacks to more than {LARGEST_CHUNK / 1e6:.0f} MB")
        return out

    return decompress


class _BoundedZstd:
    """Replaces zstd in rosbags, limited in size."""

    def __init__(self, zstd: Any, decompress: Callable[[bytes], bytes]) -> None:  # noqa: ANN401
        self._zstd, self.decompress = zstd, decompress

    @contextmanager
    def open(self, file: IO[bytes], mode: str) -> Generator["_BoundedFile"]:
        size = os.fstat(file.fileno()).st_size
        with self._zstd.open(file, mode) as unpacked:
            yield _BoundedFile(unpacked, max(RATIO_FREE_BYTES, LARGEST_RATIO * size))


class _BoundedFile:
    """A file unpacked while read, limited in size."""

    def __init__(self, file: IO[bytes], left: int) -> None:
        self._file, self._left = file, left

    def read(self, size: int) -> bytes:
        data = self._file.read(size)
        self._left -= len(data)
        if self._left < 0:
            raise ValueError(f"one of its files unpacks to more than {LARGEST_RATIO} times its size")
        return data


JUMP = 2_000_000_000
"""Distance, nanoseconds, from which a new stream is cheaper."""


class MessageStream:
    """Access to messages by topic and recording time in nanoseconds.

    One pass serves requests in order and keeps messages of other topics until it is beyond them; a jump opens a new
    pass.

    Args:
        start: Opens a pass over topics from a time: topic, time and content of each.

    Attributes:
        lock: Held while the file is read.
    """

    def __init__(self, start: Callable[[list[str], int], Generator[tuple[str, int, bytes]]]) -> None:
        self.lock = Lock()
        self._start = start
        self._passing: Generator[tuple[str, int, bytes]] | None = None
        self._kept: dict[tuple[str, int], bytes] = {}
        self._position = -1

    def read(self, wanted: list[tuple[str, int]]) -> list[bytes]:
        """Messages at these times, of the same topics in every call.

        Raises:
            KeyError: There is no such message.
        """
        with self.lock:
            missing = {key for key in wanted if key not in self._kept}
            first = min((time for _, time in missing), default=self._position)
            if missing and (self._passing is None or not 0 <= first - self._position <= JUMP):
                self.close()
                self._passing = self._start([topic for topic, _ in wanted], first)
            while missing:
                topic, time, data = next(self._passing or iter(()), ("", -1, b""))
                if time < 0:
                    self._passing = None
                    raise KeyError("there is no such message")
                self._position = time
                self._kept[topic, time] = data
                missing.discard((topic, time))
            out = [self._kept[key] for key in wanted]
            oldest = min(time for _, time in wanted)
            self._kept = {key: data for key, data in self._kept.items() if key[1] >= oldest}
        return out

    def close(self) -> None:
        """End the pass."""
        if self._passing is not None:
            self._passing.close()
        self._passing = None
        self._kept.clear()
