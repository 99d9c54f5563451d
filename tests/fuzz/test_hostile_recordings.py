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
from dudmap.sequences import open_sequence


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

    from dudmap.sequences import bag_limits

    monkeypatch.setattr(bag_limits, "LARGEST_CHUNK", 2**20)
    bag_limits.limit_decompression()
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
    from dudmap.sequences.record3d import largest_unpacked

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


IDL = "module a {{ module msg {{ {0} struct B {{ {1} }}; }}; }};"
SEPARATOR = "=" * 80 + "\n"


@pytest.mark.parametrize(
    ("definition", "match"),
    [
        (IDL.format("", "int8 a[((((1))))];"), "outside of texts"),  # tried in 2^40 ways by the grammar
        (IDL.format("", "int8 a[1 << 80000000000];"), "outside of texts"),
        (IDL.format("const int64 C = 9 * 9;", "int8 a;"), "outside of texts"),
        (IDL.format("", '@a(text="x\\") int8 a[((((1))))];'), "outside of texts"),
        (IDL.format("/* (", "int8 a[((((1))))];"), "Could not parse"),
        (IDL.format("", "sequence<" * 30 + "int8" + ">" * 30 + " a;"), "more deeply"),
        ("int8 a\n" * 20_000, "has 140000 characters"),
        ("string[100000000] a", "has 100000001 fields"),  # a line of code each
        ("B a", "contains itself"),
        (
            "".join(f"C{k} x\nC{k} y\n{SEPARATOR}MSG: a/C{k}\n" for k in range(60)) + "int8[0] x",
            "has 24575 fields",
        ),
    ],
)
def test_definitions_of_messages_that_never_end(definition, match):
    pytest.importorskip("rosbags")
    from rosbags.highlevel import anyreader
    from rosbags.typesys import Stores

    from dudmap.sequences.bag_definitions import limit_definitions

    limit_definitions()

    def read():
        parse = anyreader.get_types_from_idl if "module" in definition else anyreader.get_types_from_msg
        try:
            types = parse(definition) if "module" in definition else parse(definition, "a/msg/B")
            anyreader.get_typestore(Stores.EMPTY).register(types)
        except Exception as error:
            raise DatasetError(str(error)[:200]) from error

    refused(read, DatasetError, match)


def test_definitions_that_recorders_write():
    pytest.importorskip("rosbags")
    from rosbags.highlevel import anyreader
    from rosbags.typesys import Stores, get_typestore

    from dudmap.sequences.bag_definitions import check_types, limit_definitions

    limit_definitions()
    for store in Stores:
        check_types(get_typestore(store).fielddefs)
    text = IDL.format(
        "module B_Constants { const int8 C = -1; };",
        '@verbatim (language="comment", text="a (b) * c << d" "e \\" (f)") // (g)\n sequence<string<10>, 5> a;',
    )
    assert set(anyreader.get_types_from_idl(text)) == {"a/msg/B"}
