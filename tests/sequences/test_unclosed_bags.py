"""Bags whose recorder was killed, and cut off copies: all that is complete is read, and one sentence says so."""

import struct

import numpy as np
import pytest
from rosbags.rosbag1.writer import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode

from bags import write_bag
from dudmap.app.pipeline.inspection import inspect
from dudmap.errors import DatasetError
from dudmap.io.sequences import open_sequence

FRAMES = 250
KINDS = {
    "mcap": ("mcap", {}),
    "mcap, zstd": ("mcap", {"set_compression": (CompressionMode.STORAGE, CompressionFormat.ZSTD)}),
    "bag": ("ros1", {}),
    "bag, bz2": ("ros1", {"set_compression": (Writer1.CompressionFormat.BZ2,)}),
    "bag, lz4": ("ros1", {"set_compression": (Writer1.CompressionFormat.LZ4,)}),
}


@pytest.fixture(params=KINDS)
def whole(request, tmp_path_factory):
    """A closed bag of some chunks: its file."""
    kind, options = KINDS[request.param]
    place = tmp_path_factory.mktemp("bag") / ("walk.bag" if kind == "ros1" else "walk")
    write_bag(place, kind, frames=FRAMES, **options)
    return place if kind == "ros1" else place / "walk.mcap"


def chunk_ends(data, ros1):
    """Places at which a chunk of a file ends, found by its own walk over the records."""
    ends, position = [], 13 if ros1 else 8
    while position < len(data):
        if ros1:
            header = struct.unpack_from("<I", data, position)[0]
            is_chunk = b"op=\x05" in data[position : position + 4 + header]
            content = struct.unpack_from("<I", data, position + 4 + header)[0]
            position += 8 + header + content
        else:
            kind, content = struct.unpack_from("<BQ", data, position)
            is_chunk = kind == 6
            position += 9 + content
            if kind == 2:
                break
        ends += [position] * is_chunk
    return ends


def unindexed(data):
    """A ROS 1 bag as its recorder leaves it before it is closed."""
    for name, size in (("index_pos", 8), ("conn_count", 4), ("chunk_count", 4)):
        data = data.replace(name.encode() + b"=" + data.split(name.encode() + b"=", 1)[1][:size],
                            name.encode() + b"=" + bytes(size), 1)  # fmt: skip
    return data


def check(path, full, least):
    """Compare the content of a file with the whole recording."""
    found = open_sequence(path)
    assert least <= len(found) < len(full)
    np.testing.assert_array_equal(found.timestamps, full.timestamps[: len(found)])
    assert found.camera == full.camera
    for index in (0, len(found) // 2, len(found) - 1):
        np.testing.assert_array_equal(found[index].depth, full[index].depth)
        np.testing.assert_array_equal(found[index].color, full[index].color)
    return found


def test_a_file_that_is_cut_off_anywhere_is_read_up_to_its_last_complete_chunk(whole, tmp_path):
    data, full = whole.read_bytes(), open_sequence(whole)
    ros1, rng = whole.suffix == ".bag", np.random.default_rng(0)
    ends = chunk_ends(data, ros1)
    assert len(ends) >= 2
    path = tmp_path / ("cut.bag.active" if ros1 else "cut.mcap")
    complete = 0
    for number, end in enumerate(ends):
        for cut in (end, *(end + rng.integers(1, 2000, 4)), *(end - rng.integers(1, 200, 2))):
            path.write_bytes((unindexed(data) if ros1 else data)[:cut])
            if number == 0 and cut < end:
                with pytest.raises(DatasetError, match="cut off before its first chunk was complete"):
                    open_sequence(path)
                continue
            if number == len(ends) - 1 and cut >= end:
                continue  # nothing is missing
            complete = max(complete, len(check(path, full, complete if cut >= end else 1)))
    assert complete >= 0.4 * len(full)


def test_that_the_file_was_not_closed_is_said_once(whole, tmp_path):
    data = whole.read_bytes()
    path = tmp_path / whole.name
    path.write_bytes(data[: chunk_ends(data, whole.suffix == ".bag")[0]])
    found = open_sequence(path)
    (said,) = (warning for warning in inspect(found).warnings if "closed" in warning)
    assert f"{len(found)} frames" in said
    assert not [warning for warning in inspect(open_sequence(whole)).warnings if "closed" in warning]


def test_zeros_at_the_end_of_a_file_are_no_data(whole, tmp_path):
    """A file system may have given the file its length before its content, when the power failed."""
    data, path = whole.read_bytes(), tmp_path / whole.name
    ros1 = whole.suffix == ".bag"
    end = chunk_ends(data, ros1)[0]
    path.write_bytes((unindexed(data) if ros1 else data)[:end] + bytes(100_000))
    check(path, open_sequence(whole), 10)


def test_a_chunk_that_its_recorder_has_not_closed_is_read(tmp_path):
    """A ROS 1 recorder writes the size of a chunk when it closes it, and its messages before that."""
    place = write_bag(tmp_path / "walk.bag", "ros1", frames=FRAMES)
    full, data = open_sequence(place), unindexed(place.read_bytes())
    first, second = chunk_ends(data, True)[:2]
    begin = data.index(b"compression=", first)
    while not chunk_at(data, begin):
        begin -= 1
    length = struct.unpack_from("<I", data, begin)[0]
    opened = bytearray(data[: second - 5000])
    opened[begin + 4 + length : begin + 8 + length] = bytes(4)
    path = tmp_path / "walk.bag.active"
    path.write_bytes(opened)
    chunk = open_sequence(cut(tmp_path / "first.bag", data[:first]))
    check(path, full, len(chunk) + 10)


def chunk_at(data, position):
    """Whether the record of a chunk begins here: the length of a header and of its first field."""
    length, field = struct.unpack_from("<II", data, position)
    return length < 100 and field < 30 and b"op=\x05" in data[position : position + 4 + length]


def cut(path, data):
    path.write_bytes(data)
    return path


def test_messages_outside_of_chunks_are_read(tmp_path):
    """MCAP files may have no chunks."""
    write_bag(tmp_path / "walk", "mcap", frames=30)
    file = tmp_path / "walk" / "walk.mcap"
    data, records, position = file.read_bytes(), b"", 8
    while position < len(data):
        kind, length = struct.unpack_from("<BQ", data, position)
        body = data[position + 9 : position + 9 + length]
        if kind == 6:
            records += body[40:]
        elif kind == 1:
            records = data[: position + 9 + length]
        elif kind == 15:
            break
        position += 9 + length
    path = cut(tmp_path / "plain.mcap", records[:-1000])
    check(path, open_sequence(file), 28)


def test_a_file_of_something_else_keeps_its_sentence(tmp_path):
    with pytest.raises(DatasetError, match="cannot open the bag"):
        open_sequence(cut(tmp_path / "a.mcap", b"\x89MCAP0\r\n" + bytes(100)))
    with pytest.raises(DatasetError, match="cannot open the bag"):
        open_sequence(cut(tmp_path / "a.bag", b"#ROSBAG V2.0\n" + b"\x00\x01\x02" * 50))
