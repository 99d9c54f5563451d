"""Times of the messages of a bag, from its index, and streamed access to single messages."""

import os
import sqlite3
import struct
from collections.abc import Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from io import BytesIO
from itertools import islice
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.sequences.bag_limits import sqlite_uri

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

SAMPLES = 30
"""Number of first messages from which the delay of recording is estimated where stamps cannot be read cheaply."""
JUMP = 2_000_000_000
"""A message that lies further ahead than this, nanoseconds, is searched for; a nearer one is waited for in the stream,
which costs less than opening a new one."""
CDR_STAMP = {0: struct.Struct(">4xiI"), 1: struct.Struct("<4xiI")}
"""Encapsulation, seconds and nanoseconds at the start of a ROS 2 message with a header, by byte order."""
ROS1_STAMP = struct.Struct("<4xII")
"""Sequence number, seconds and nanoseconds at the start of a ROS 1 message with a header."""
HEAD = 12
"""Bytes of either."""
MCAP_RECORD, MCAP_INDEX, MCAP_MESSAGE, MCAP_CHUNK = 9, 6, 31, 49
"""Bytes before the content of an MCAP record, before the entries in that of a message index, before the data of a
message, and before those of an uncompressed chunk (MCAP specification, sections Records, Message and Chunk)."""
ROS1_RECORD = 128
"""Bytes that hold the header of a ROS 1 message record, of about 50 bytes, and the start of the message."""
INDEX_RECORDS = 4096
"""Bytes that hold the index of most chunks: a page."""
AT_ONCE = 1024
"""Places of the index that are read before the bytes are dropped."""
REQUESTS = 16
"""Requests to the disk at a time. SSDs reach a multiple of their speed of single requests with that many."""


class MessageTimes(NamedTuple):
    """Times of the messages of a topic, in the order of recording.

    Attributes:
        recorded: (N,) int64 strictly increasing times of recording, nanoseconds; they identify a message.
        stamps: (N,) float64 times in the headers of the messages, seconds.
        exact: Whether ``stamps`` were read from the headers; otherwise they are the times of recording less the median
            delay of the first messages.
    """

    recorded: NDArray[np.int64]
    stamps: NDArray[np.float64]
    exact: bool


def message_times(reader: "AnyReader", connection: "Connection") -> MessageTimes:
    """Times of the messages of a connection.

    They come from the index of the bag, and the stamps from the first bytes of each message, so that images are not
    read. In compressed bags that would mean to decompress everything, so the stamps are estimated. Only an MCAP file
    without chunks is read through once.
    """
    rows = list(_entries(reader, connection))
    recorded, first = np.unique(np.array([time for time, _ in rows], dtype=np.int64), return_index=True)
    heads = [rows[k][1] for k in first]
    if all(head is not None for head in heads):
        stamps = np.array([head_stamp(head, ros2=reader.is2) for head in heads if head is not None], dtype=np.float64)
        return MessageTimes(recorded, stamps, True)
    with closing(reader.messages([connection])) as messages:
        delays = [1e-9 * time - head_stamp(raw, ros2=reader.is2) for _, time, raw in islice(messages, SAMPLES)]
    return MessageTimes(recorded, 1e-9 * recorded - np.median(delays), False)


def head_stamp(data: bytes, *, ros2: bool) -> float:
    """Time in seconds in the header of a serialised message."""
    form = CDR_STAMP[data[1] & 1] if ros2 else ROS1_STAMP
    seconds, nanoseconds = form.unpack_from(data)
    return seconds + 1e-9 * nanoseconds


class MessageStream:
    """Access to messages by connection and time of recording.

    Messages that are asked for in order are streamed through one pass over the bag, in which those of the other
    connections that are not asked for yet are kept until they lie behind; a jump opens a new pass at the wanted time.

    Args:
        reader: The open bag.

    Attributes:
        lock: Held while the bag is read, which may be by a thread of its own.
    """

    def __init__(self, reader: "AnyReader") -> None:
        self._reader = reader
        self._passing: Generator[tuple[Connection, int, bytes]] | None = None
        self._kept: dict[tuple[str, int], bytes] = {}
        self._position = -1
        self.lock = Lock()

    def read(self, wanted: "list[tuple[Connection, int]]") -> list[bytes]:
        """Serialised messages of these connections, which are the same in every call, and times of recording.

        Raises:
            KeyError: There is no such message.
        """
        keys = [(connection.topic, time) for connection, time in wanted]
        with self.lock:
            missing = {key for key in keys if key not in self._kept}
            first = min((time for _, time in missing), default=self._position)
            if missing and (self._passing is None or not 0 <= first - self._position <= JUMP):
                self._restart(first, [connection for connection, _ in wanted])
            while missing:
                missing.discard(self._advance())
            out = [self._kept[key] for key in keys]
            oldest = min(time for _, time in keys)
            self._kept = {key: data for key, data in self._kept.items() if key[1] >= oldest}
        return out

    def close(self) -> None:
        """End the pass."""
        if self._passing is not None:
            self._passing.close()
        self._passing = None
        self._kept.clear()

    def _restart(self, start: int, connections: "list[Connection]") -> None:
        self.close()
        self._passing = self._reader.messages(connections, start=start)

    def _advance(self) -> tuple[str, int]:
        """Keep the next message of the pass; returns its topic and time."""
        assert self._passing is not None
        try:
            connection, time, data = next(self._passing)
        except StopIteration:
            self._passing = None
            raise KeyError("there is no such message") from None
        self._position = time
        self._kept[connection.topic, time] = bytes(data)
        return connection.topic, time


def _entries(reader: "AnyReader", connection: "Connection") -> "Iterable[tuple[int, bytes | None]]":
    """Time of recording and first bytes of every message; None for bytes that would have to be decompressed."""
    bag: Any = reader.readers[0]
    if not reader.is2:
        return _ros1_entries(bag, connection)
    if hasattr(bag.storage, "storages"):  # a folder with metadata.yaml and one or several files
        parts, packed = bag.storage.storages, bag.storage.metadata.compression_mode == "message"
    else:
        parts, packed = [bag.storage], False
    rows: list[tuple[int, bytes | None]] = []
    for part in parts:
        for own in (other for other in part.connections if other.topic == connection.topic):
            rows += _sqlite_entries(part, own) if hasattr(part, "dbconn") else _mcap_entries(part, own)
    return [(time, None) for time, _ in rows] if packed else rows


def _ros1_entries(bag: Any, connection: "Connection") -> Generator[tuple[int, bytes | None]]:  # noqa: ANN401
    from rosbags.rosbag1.reader import decompressors

    plain = decompressors["none"]
    entries = bag.indexes[connection.id]
    chunks = [bag.chunks[entry.chunk_pos] for entry in entries]
    if not all(chunk.decompressor is plain for chunk in chunks):
        yield from ((entry.time, None) for entry in entries)
        return
    places = [chunk.datapos + entry.offset for chunk, entry in zip(chunks, entries, strict=True)]
    for entry, place, start in zip(entries, places, read_many(bag.path, places, ROS1_RECORD), strict=True):
        yield entry.time, _ros1_head(bag.bio, place, start)


def _ros1_head(file: BinaryIO, place: int, start: bytes) -> bytes:
    """First bytes of the data of a message record, which a connection record may precede."""
    from rosbags.rosbag1.reader import Header, RecordType, read_uint32

    (header_size,) = struct.unpack_from("<I", start)
    if header_size + 8 + HEAD <= len(start) and Header.read(BytesIO(start)).get_uint8("op") == RecordType.MSGDATA:
        return start[header_size + 8 :][:HEAD]
    file.seek(place)
    while Header.read(file).get_uint8("op") == RecordType.CONNECTION:
        file.seek(read_uint32(file), os.SEEK_CUR)
    file.seek(4, os.SEEK_CUR)
    return file.read(HEAD)


def warm_index(path: Path) -> None:
    """Read the parts of a ROS 1 bag that rosbags reads one after the other when it opens it, many at a time.

    The index of a bag is spread over the file: a record after each chunk. A disk answers many requests at a time faster
    than one by one, and keeps what was read in memory. Damaged bags are left to rosbags to report.
    """
    from rosbags.rosbag1.reader import Header, ReaderError, read_uint32

    try:
        with path.open("rb") as file:
            file.readline()
            header = Header.read(file)
            file.seek(header.get_uint64("index_pos"))
            places = []
            for _ in range(header.get_uint32("conn_count") + header.get_uint32("chunk_count")):
                record = Header.read(file)
                file.seek(read_uint32(file), os.SEEK_CUR)
                if "chunk_pos" in record:
                    places.append(max(0, record.get_uint64("chunk_pos") - INDEX_RECORDS))
    except (ReaderError, OSError):
        return
    for k in range(0, len(places), AT_ONCE):  # what is read is kept by the operating system, not here
        read_many(path, places[k : k + AT_ONCE], 2 * INDEX_RECORDS)


def read_many(path: Path, places: list[int], size: int) -> list[bytes]:
    """``size`` bytes at each of many places of a file, fewer at its end; some requests at a time."""

    def read(part: list[int]) -> list[bytes]:
        with path.open("rb", buffering=0) as file:
            return [file.read(size) for place in part if file.seek(place) >= 0]

    if len(places) < REQUESTS:
        return read(places)
    part = -(-len(places) // REQUESTS)
    with ThreadPoolExecutor(REQUESTS, thread_name_prefix="dudmap-index") as pool:
        found = pool.map(read, [places[k : k + part] for k in range(0, len(places), part)])
        return [data for each in found for data in each]


def _sqlite_entries(part: Any, connection: "Connection") -> list[tuple[int, bytes | None]]:  # noqa: ANN401
    with closing(sqlite3.connect(sqlite_uri(part.path), uri=True)) as database:
        rows = database.execute("SELECT id, timestamp FROM messages WHERE topic_id = ?", (connection.id,)).fetchall()
        out: list[tuple[int, bytes | None]] = []
        for row, time in rows:
            with database.blobopen("messages", "data", row, readonly=True) as blob:
                out.append((time, blob.read(HEAD)))
    return out


def _mcap_entries(part: Any, connection: "Connection") -> Generator[tuple[int, bytes | None]]:  # noqa: ANN401
    if not part.chunks:
        for _, time, data in part.messages([connection]):
            yield time, bytes(data[:HEAD])
        return
    chunks = [chunk for chunk in part.chunks if connection.id in chunk.message_index_offsets]
    places = [chunk.message_index_offsets[connection.id] for chunk in chunks]
    times, heads = [], []
    for chunk, place, start in zip(chunks, places, read_many(part.path, places, INDEX_RECORDS), strict=True):
        size = MCAP_RECORD + struct.unpack_from("<Q", start, 1)[0]
        if size > len(start):
            (start,) = read_many(part.path, [place], size)
        first = chunk.chunk_start_offset + MCAP_CHUNK + MCAP_MESSAGE
        for time, offset in struct.iter_unpack("<QQ", start[MCAP_RECORD + MCAP_INDEX : size]):
            times.append(time)
            heads.append(None if chunk.compression else first + offset)
    if None in heads:
        yield from ((time, None) for time in times)
    else:
        yield from zip(times, read_many(part.path, heads, HEAD), strict=True)
