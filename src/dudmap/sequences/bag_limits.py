"""Limits for the package rosbags, which trusts the bags that it reads."""

import sqlite3
from bz2 import BZ2Decompressor
from collections.abc import Callable
from contextlib import closing
from importlib import import_module
from pathlib import Path
from typing import Any, cast
from urllib.parse import quote

from dudmap.input_files import open_plain, read_text

LARGEST_CHUNK = 2**28
"""Largest chunk or message of a bag after decompression, bytes; recorders write chunks of up to 4 MB, and one raw image
of ``LARGEST_PIXELS`` has 200 MB."""
LARGEST_METADATA = 2**19
"""Largest metadata.yaml, bytes; one with 100 topics has 60 kB, and its parser takes 20 seconds for a megabyte."""


def check_bag(path: Path) -> None:
    """Check that a bag has plain files only, and that an SQLite file is nothing but tables.

    A view in the place of a table would be a program that runs when the bag is read.

    Raises:
        OSError: A file is none, or larger than files of its kind.
        ValueError: An SQLite file holds something else than tables and indexes.
        sqlite3.Error: It is damaged.
    """
    if path.is_dir():
        read_text(path / "metadata.yaml", LARGEST_METADATA)
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    for file in files:
        if file.suffix in (".db3", ".mcap", ".bag"):
            open_plain(file).close()
        if file.suffix == ".db3":
            _check_tables(file)


def _check_tables(path: Path) -> None:
    with closing(sqlite3.connect(sqlite_uri(path), uri=True)) as database:
        found = database.execute("SELECT type, name, sql FROM sqlite_master").fetchall()
    for kind, name, sql in found:
        if kind not in ("table", "index") or "VIRTUAL" in str(sql).upper() or "GENERATED" in str(sql).upper():
            raise ValueError(f"it holds {name!r}, which is neither a plain table nor an index")


def sqlite_uri(path: Path) -> str:
    """Address under which SQLite opens a file for reading, whatever characters its name has."""
    return f"file:{quote(str(path))}?mode=ro&immutable=1"


def limit_decompression() -> None:
    """Make rosbags give up where a chunk or message unpacks to more than ``LARGEST_CHUNK``."""
    import lz4.frame

    names = "rosbags.rosbag1.reader", "rosbags.rosbag2.reader", "rosbags.rosbag2.storage_mcap"
    ros1, ros2, storage_mcap = (cast("Any", import_module(name)) for name in names)
    unzstd = bounded(storage_mcap.zstd.ZstdDecompressor)
    unlz4 = bounded(lz4.frame.LZ4FrameDecompressor)
    ros1.decompressors.update(bz2=bounded(BZ2Decompressor), lz4=unlz4)
    storage_mcap.DECOMPRESSORS.update(lz4=lambda data, _: unlz4(data), zstd=lambda data, _: unzstd(data))
    if not isinstance(ros2.zstd, _Bounded):
        ros2.zstd = _Bounded(unzstd)


class _Bounded:
    """Stands for the module zstd in the reader of bags whose messages are compressed one by one."""

    def __init__(self, decompress: Callable[[bytes], bytes]) -> None:
        self.decompress = decompress


def bounded(make: Callable[[], Any]) -> Callable[[bytes], bytes]:
    """Decompression with a decompressor of the standard library's interface, of ``LARGEST_CHUNK`` bytes or less."""

    def decompress(data: bytes) -> bytes:
        out = make().decompress(bytes(data), LARGEST_CHUNK + 1)
        if len(out) > LARGEST_CHUNK:
            raise ValueError(f"a chunk unpacks to more than {LARGEST_CHUNK / 1e6:.0f} MB")
        return out

    return decompress
