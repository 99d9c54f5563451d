"""Bags that were not closed: killed recorder, power failure, cut copy.

A new index of the complete chunks follows the file, as at its end. Damage raises a ``ValueError``.
"""

import io
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from dudmap.input_files import open_plain


class CompletedFile:
    """The first bytes of a file followed by bytes in memory, as a path for rosbags.

    Args:
        length: Bytes of the file.
        head: Replaces the first bytes.
    """

    def __init__(self, path: Path, length: int, tail: bytes, head: bytes = b"") -> None:
        self.path, self.length, self.tail, self.head = path, length, tail, head
        self.suffix = path.suffix

    def __str__(self) -> str:
        return str(self.path)

    def exists(self) -> bool:
        """Whether the file is there."""
        return self.path.exists()

    def is_dir(self) -> bool:
        """It is no folder."""
        return False

    def open(self, mode: str = "rb") -> IO[bytes]:
        """Open it for reading."""
        return io.BufferedReader(_Completed(self))


class _Completed(io.RawIOBase):
    def __init__(self, whole: CompletedFile) -> None:
        self._whole, self._file, self._position = whole, open_plain(whole.path), 0

    def close(self) -> None:
        self._file.close()
        super().close()

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        whole = self._whole
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._position}.get(whence, whole.length + len(whole.tail))
        if start + offset < 0:
            raise OSError("seek before the start of the file")
        self._position = start + offset
        return self._position

    def readinto(self, buffer: Any) -> int:  # noqa: ANN401 - any writable buffer
        whole, position, wanted = self._whole, self._position, len(buffer)
        if position < len(whole.head):
            data = whole.head[position : position + wanted]
        elif position < whole.length:
            self._file.seek(position)
            data = self._file.read(min(wanted, whole.length - position))
        else:
            data = whole.tail[position - whole.length :][:wanted]
        buffer[: len(data)] = data
        self._position += len(data)
        return len(data)


def completed(path: Path) -> CompletedFile | None:
    """An MCAP file or ROS 1 bag with a new index, None for others.

    Raises:
        ValueError: It holds no complete chunk, or is damaged.
    """
    with open_plain(path) as file:
        start = file.read(len(BAG))
        if start.startswith(MCAP):
            return _completed_mcap(path, file)
        return _completed_bag(path, file) if start == BAG else None


MCAP, BAG = b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n"
"""First bytes of an MCAP file (also its last), and of a ROS 1 bag."""
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX, DATA_END = 2, 3, 4, 5, 6, 7, 8, 15
"""Operation codes of MCAP records (MCAP specification, section Records)."""
LARGEST_CHUNK = 2**28
"""Largest unpacked chunk or message, bytes: recorders write 4 MB, a raw image has 200 MB."""


@dataclass
class _Chunk:
    """A chunk of an MCAP file: record, head, and indexes by channel."""

    start: int
    end: int
    head: bytes
    compression: str
    indexes: dict[int, int] = field(default_factory=dict)
    indexes_end: int = 0


def _completed_mcap(path: Path, file: IO[bytes]) -> CompletedFile:
    chunks: list[_Chunk] = []
    known: dict[tuple[int, int], bytes] = {}  # schemas and channels, by operation code and number
    end, messages = len(MCAP), 0
    for kind, start, length in _mcap_records(file, end):
        if kind in (SCHEMA, CHANNEL):
            known[kind, _number(file, start)] = _read(file, start, length)
        elif kind == CHUNK:
            chunk = _mcap_chunk(file, start, length)
            if not _fits(chunk, length):
                break
            chunks.append(chunk)
        elif kind == MESSAGE_INDEX and chunks:
            chunks[-1].indexes[_number(file, start)] = start - 9
            chunks[-1].indexes_end = start + length
        messages += kind == MESSAGE
        end = start + length
    if not chunks and not messages:
        raise ValueError("it was cut off before its first chunk was complete")
    tail = io.BytesIO()
    for number, chunk in enumerate(list(chunks)):
        new = not chunk.indexes or number == len(chunks) - 1  # which may lack some
        if new or any((CHANNEL, channel) not in known for channel in chunk.indexes):
            try:
                rows = _mcap_content(file, chunk, known)
            except Exception:  # of any decompressor
                if number == 0 or number < len(chunks) - 1:
                    raise
                chunks.pop()
                break
            if new:
                chunk.indexes = {}
                for channel, entries in rows.items():
                    chunk.indexes[channel] = end + tail.tell()
                    body = b"".join(struct.pack("<QQ", *entry) for entry in entries)
                    tail.write(_mcap_record(MESSAGE_INDEX, struct.pack("<HI", channel, len(body)) + body))
                chunk.indexes_end = end + tail.tell()
    if not chunks:
        return CompletedFile(path, end, _mcap_record(FOOTER, bytes(20)) + MCAP)
    summary = end + tail.tell()
    for (kind, _), content in sorted(known.items()):
        tail.write(_mcap_record(kind, content))
    for chunk in chunks:
        offsets = b"".join(struct.pack("<HQ", *entry) for entry in chunk.indexes.items())
        sizes = struct.unpack_from("<Q", chunk.head, 16)[0]
        tail.write(_mcap_record(CHUNK_INDEX, b"".join([
            chunk.head[:16], struct.pack("<QQI", chunk.start, chunk.end - chunk.start, len(offsets)), offsets,
            struct.pack("<Q", chunk.indexes_end - chunk.end if chunk.indexes else 0),
            struct.pack("<I", len(chunk.compression)), chunk.compression.encode(), chunk.head[-8:],
            struct.pack("<Q", sizes),
        ])))  # fmt: skip
    tail.write(_mcap_record(FOOTER, struct.pack("<QQI", summary, 0, 0)) + MCAP)
    return CompletedFile(path, end, tail.getvalue())


def _mcap_records(file: IO[bytes], position: int) -> Iterator[tuple[int, int, int]]:
    size = file.seek(0, os.SEEK_END)
    while position + 9 <= size:
        file.seek(position)
        kind, length = struct.unpack("<BQ", file.read(9))
        if kind in (0, DATA_END, FOOTER) or position + 9 + length > size:  # a power failure leaves zeros
            return
        yield kind, position + 9, length
        position += 9 + length


def _mcap_chunk(file: IO[bytes], start: int, length: int) -> _Chunk:
    file.seek(start)
    head = file.read(32)
    name = file.read(min(struct.unpack_from("<I", head, 28)[0], 16)) if len(head) == 32 else b""
    return _Chunk(start - 9, start + length, head + name + file.read(8), name.decode("ascii", "replace"))


def _fits(chunk: _Chunk, length: int) -> bool:
    head = len(chunk.head)
    return head >= 40 and head + struct.unpack("<Q", chunk.head[-8:])[0] == length


def _mcap_content(
    file: IO[bytes], chunk: _Chunk, known: dict[tuple[int, int], bytes]
) -> dict[int, list[tuple[int, int]]]:
    from rosbags.rosbag2 import storage_mcap

    start = chunk.start + 9 + len(chunk.head)
    size, crc = struct.unpack_from("<QI", chunk.head, 16)
    content = storage_mcap.decompress(_read(file, start, chunk.end - start), chunk.compression, size, crc)
    position, found = 0, {}
    while position < len(content):
        kind, length = struct.unpack_from("<BQ", content, position)
        body = content[position + 9 : position + 9 + length]
        if len(body) < max(length, 2):
            raise ValueError("a record of a chunk is cut off")
        if kind in (SCHEMA, CHANNEL):
            known[kind, struct.unpack_from("<H", body)[0]] = body
        elif kind == MESSAGE:
            channel, _, time = struct.unpack_from("<HIQ", body)
            found.setdefault(channel, []).append((time, position))
        position += 9 + length
    return found


def _mcap_record(kind: int, content: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(content)) + content


def _number(file: IO[bytes], start: int) -> int:
    return struct.unpack("<H", _read(file, start, 2))[0]


def _read(file: IO[bytes], start: int, length: int) -> bytes:
    file.seek(start)
    data = file.read(length)
    if len(data) != length:
        raise ValueError("a record is cut off")
    return data


Fields = dict[str, bytes]
Entry = tuple[int, int, int]


@dataclass
class _BagChunk:
    """A chunk of a ROS 1 bag: record, content, indexes by topic."""

    start: int
    fields: Fields
    content: int
    length: int
    indexes: dict[int, list[Entry]] = field(default_factory=dict)


def _completed_bag(path: Path, file: IO[bytes]) -> CompletedFile:
    """A ROS 1 bag with a new index; the last chunk is rewritten."""
    records = _bag_records(file, len(BAG))
    _, header, _, _ = next(records, (0, Fields(), 0, 0))
    chunks: list[_BagChunk] = []
    form: Fields = dict.fromkeys(("op", "ver", "conn", "count"), b"")
    for start, fields, content, length in records:
        if fields.get("op") == b"\5":
            chunks.append(_BagChunk(start, fields, content, length))
            if not length:
                chunks[-1].length = min(file.seek(0, os.SEEK_END) - content, LARGEST_CHUNK)
                if fields.get("compression") != b"none":
                    chunks.pop()
                break
        elif fields.get("op") == b"\4" and chunks:
            rows = _read(file, content, length)
            chunks[-1].indexes[_unsigned(fields["conn"])] = list(struct.iter_unpack("<III", rows))
            form = fields
        else:
            break
    connections: dict[int, bytes] = {}
    infos: list[bytes] = []
    for chunk in chunks[:-1]:
        if not chunk.indexes.keys() <= connections.keys():
            _bag_content(file, chunk, connections)
        infos.append(_chunk_info(chunk.start, chunk.indexes))
    if not chunks or not {"index_pos", "conn_count", "chunk_count"} <= header.keys():
        raise ValueError("it was cut off before its first chunk was complete")
    last, tail = chunks[-1], b""
    last.indexes, content = _bag_content(file, last, connections)
    if last.indexes:
        infos.append(_chunk_info(last.start, last.indexes))
        tail = _bag_record(last.fields, content)
        for conn, entries in last.indexes.items():
            given = {"op": b"\4", "ver": _packed(1), "conn": _packed(conn), "count": _packed(len(entries))}
            tail += _bag_record(form | given, b"".join(struct.pack("<III", *entry) for entry in entries))
    if not infos:
        raise ValueError("it was cut off before its first chunk was complete")
    found = {"conn_count": _packed(len(connections)), "chunk_count": _packed(len(infos))}
    header |= found | {"index_pos": struct.pack("<Q", last.start + len(tail))}
    tail += b"".join([*connections.values(), *infos])
    return CompletedFile(path, last.start, tail, BAG + _bag_record(header, b"")[:-4])


def _bag_records(file: IO[bytes], position: int) -> Iterator[tuple[int, Fields, int, int]]:
    size = file.seek(0, os.SEEK_END)
    while position + 8 <= size:
        length = _unsigned(_read(file, position, 4))
        content = position + 8 + length
        if content > size:
            return
        fields = _bag_fields(_read(file, position + 4, length))
        data = _unsigned(_read(file, content - 4, 4))
        if not fields or content + data > size:
            return
        yield position, fields, content, data
        position = content + data


def _bag_fields(data: bytes) -> Fields:
    fields, position = Fields(), 0
    while position + 4 <= len(data):
        length = _unsigned(data[position : position + 4])
        name, _, value = data[position + 4 : position + 4 + length].partition(b"=")
        fields[name.decode("ascii", "replace")] = value
        position += 4 + length
    return fields


def _bag_content(
    file: IO[bytes], chunk: _BagChunk, connections: dict[int, bytes]
) -> tuple[dict[int, list[Entry]], bytes]:
    from rosbags.rosbag1.reader import decompressors

    packed, name = _read(file, chunk.content, chunk.length), chunk.fields["compression"].decode("ascii", "replace")
    content = bytes(decompressors[name](packed))
    end, indexes = 0, {}
    for start, fields, data, length in _bag_records(io.BytesIO(content), 0):
        conn, end = _unsigned(fields["conn"]), data + length
        if fields["op"] == b"\7":
            connections[conn] = content[start:end]
        else:
            indexes.setdefault(conn, []).append((*struct.unpack("<II", fields["time"]), start))
    return indexes, content[:end] if name == "none" else packed


def _chunk_info(start: int, indexes: dict[int, list[Entry]]) -> bytes:
    times = sorted(entry[:2] for entries in indexes.values() for entry in entries)
    fields = {"op": b"\6", "ver": _packed(1), "chunk_pos": struct.pack("<Q", start), "count": _packed(len(indexes))}
    if times:
        fields |= {"start_time": struct.pack("<II", *times[0]), "end_time": struct.pack("<II", *times[-1])}
    counts = b"".join(struct.pack("<II", conn, len(entries)) for conn, entries in indexes.items())
    return _bag_record(fields, counts)


def _bag_record(fields: Fields, content: bytes) -> bytes:
    parts = [name.encode() + b"=" + value for name, value in fields.items()]
    header = b"".join(_packed(len(part)) + part for part in parts)
    return _packed(len(header)) + header + _packed(len(content)) + content


def _packed(number: int) -> bytes:
    return struct.pack("<I", number)


def _unsigned(data: bytes) -> int:
    return int.from_bytes(data[:4], "little")
