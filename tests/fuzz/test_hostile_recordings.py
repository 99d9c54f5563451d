"""Recordings in one file and archives that were made to do harm."""

import io
import os
import sqlite3
import struct
import tarfile

import numpy as np
import pytest
from hostile import refused
from recording_loaders import CAMERA

from dudmap.errors import DatasetError
from dudmap.io.sequences import open_sequence


@pytest.mark.parametrize("suffix", [".klg", ".sens", ".r3d", ".bag", ".db3", ".mcap", ".zip", ".tar", ".tgz"])
def test_a_pipe_in_the_place_of_a_recording(suffix, tmp_path):
    os.mkfifo(tmp_path / f"a{suffix}")
    refused(lambda: open_sequence(tmp_path / f"a{suffix}", CAMERA))


def test_a_billion_declared_frames(tmp_path):
    (tmp_path / "a.klg").write_bytes(struct.pack("<i", 10**9) + struct.pack("<qii", 0, 0, 0) * 3)
    refused(lambda: open_sequence(tmp_path / "a.klg", CAMERA), match="says 1000000000 frames and holds 3")
    header = struct.pack("<IQ", 4, 0) + struct.pack("<64f", *np.tile(np.eye(4).ravel(), 4))
    header += struct.pack("<2i", 1, 1) + struct.pack("<4I", 64, 48, 64, 48) + struct.pack("<fQ", 1000.0, 10**9)
    (tmp_path / "a.sens").write_bytes(header)
    refused(lambda: open_sequence(tmp_path / "a.sens"), match="cut off")


def test_a_program_in_the_place_of_a_table(tmp_path):
    pytest.importorskip("rosbags")
    path = tmp_path / "a.db3"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE topics (id INTEGER, name TEXT, type TEXT, serialization_format TEXT)")
        database.execute(
            "CREATE VIEW messages AS WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT x FROM n"
        )
    database.close()
    refused(lambda: open_sequence(path), DatasetError, "neither a plain table nor an index")


def test_bombs_in_bags(monkeypatch):
    pytest.importorskip("rosbags")
    import bz2

    import lz4.frame
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import storage_mcap

    from dudmap.io.sequences import bag_file

    monkeypatch.setattr(bag_file, "LARGEST_CHUNK", 2**20)
    bag_file.limit_rosbags()
    zeros = {n: bytes(n) for n in (2**20, 2**20 + 1)}
    packers = {
        "bz2": (bz2.compress, ros1.decompressors["bz2"]), "lz4": (lz4.frame.compress, ros1.decompressors["lz4"]),
        "zstd": (storage_mcap.zstd.compress, lambda data: storage_mcap.DECOMPRESSORS["zstd"](data, 0)),
    }  # fmt: skip
    for pack, unpack in packers.values():
        assert unpack(pack(zeros[2**20])) == zeros[2**20]
        with pytest.raises(ValueError, match="unpacks to more than"):
            unpack(pack(zeros[2**20 + 1]))


def test_a_bomb_in_a_phone_recording():
    lzfse = pytest.importorskip("lzfse")
    from dudmap.io.sequences.image_logs import largest_unpacked

    for data in (b"", b"a", np.linspace(0, 1, 20_000, dtype=np.float32).tobytes(), bytes(100_000), os.urandom(30_000)):
        assert largest_unpacked(lzfse.compress(data)) >= len(data)
    block = struct.pack("<4sI3Q", b"bvx2", 10, 10_000 << 40, 0, 32)
    assert largest_unpacked(block * 10 + b"bvx$") == 10 * 10_000 * 2674
    with pytest.raises(ValueError, match="cut off"):
        largest_unpacked(block)
    with pytest.raises(ValueError, match="no block"):
        largest_unpacked(b"bvx1" + bytes(100))


def test_a_tar_that_says_it_is_larger(tmp_path, monkeypatch):
    monkeypatch.setenv("DUDMAP_CACHE", str(tmp_path / "cache"))
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as archive:
        member = tarfile.TarInfo("rgb.txt")
        member.size = 0
        archive.addfile(member, io.BytesIO())
    data = bytearray(out.getvalue())
    data[124:136] = b"77777777777\0"
    data[148:156] = b"%06o\0 " % (sum(data[:148]) + 8 * 32 + sum(data[156:512]))
    (tmp_path / "a.tar").write_bytes(data)
    refused(lambda: open_sequence(tmp_path / "a.tar"))
