"""Read files of unknown origin: plain files of limited size and nesting, without objects.

Recordings, maps and configurations may come from anybody. A pipe does not block, a device does not fill the memory, and
declared sizes are checked before allocation.

Unreadable, special and too large files raise ``OSError``. Damaged, too deeply nested or oversized content raises
``ValueError`` or an error of zipfile and zlib (``DAMAGE``).
"""

import codecs
import errno
import json
import lzma
import math
import os
import stat
import struct
import sys
import tokenize
import tomllib
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import DudmapError

LARGEST_TEXT = 2**28
"""Bytes of a text file: poses of 100 hours at 30 Hz have 1 GB."""
LARGEST_TREE = 2**26
"""Bytes of a JSON file; transforms.json with 10 000 frames has 5 MB."""
LARGEST_TOML = 2**20
"""Bytes of a TOML file: all parameters have 30 kB; this takes 1 s to parse."""
LARGEST_COUNT = 2**23
"""Values of a JSON text, less than 1 GB; transforms.json with 10 000 frames has 200 000."""
DEEPEST = 64
"""Levels of a JSON or TOML tree; known formats have at most 8."""
LARGEST_FILE = 2**28
"""Bytes of a file read as a whole: an uncompressed image of ``LARGEST_PIXELS``."""
LARGEST_ARCHIVE = 2**36
"""Content of a NumPy archive, bytes; a map of 16 million blocks has 64 GiB."""
LARGEST_RATIO = 100
"""Unpacked over packed size of an archive: maps reach 10, deflate 1000."""
RATIO_FREE_BYTES = 2**26
"""Unpacked size below which the ratio does not matter."""
GIT_LFS = b"version https://git-lfs.github.com/spec/"
"""First bytes of a pointer file, which replaces a large file in a clone without Git LFS."""
LARGEST_POINTER = 1024
"""Bytes of such a pointer (specification of Git LFS)."""
SAFE_KINDS = "biufUS"
"""Kinds of NumPy types without objects."""
DAMAGE = (
    ValueError, TypeError, LookupError, ArithmeticError, AttributeError, EOFError, RecursionError, struct.error,
    zlib.error, lzma.LZMAError, zipfile.BadZipFile, zipfile.LargeZipFile, NotImplementedError, OSError,
)  # fmt: skip
"""Errors of the standard library and NumPy for damaged content."""


def open_plain(path: str | Path, *, pointers: bool = False) -> IO[bytes]:
    """Open a plain file for reading; links are followed.

    Args:
        pointers: Whether a Git LFS pointer is opened like any text.
    """
    try:
        _check_plain(os.stat(path).st_mode, path)
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
        number = os.open(path, flags)
    except ValueError as error:  # a zero byte or half a surrogate pair in the name
        raise OSError(errno.ENOENT, f"there can be no file of this name ({error})", str(path)) from None
    try:
        _check_plain(os.fstat(number).st_mode, path)  # it may have been replaced in the meantime
        if not pointers and os.fstat(number).st_size < LARGEST_POINTER:
            if os.read(number, len(GIT_LFS)) == GIT_LFS:
                raise OSError(errno.EINVAL, "it is a Git LFS pointer, not the file itself; run git lfs pull", str(path))
            os.lseek(number, 0, os.SEEK_SET)
    except OSError:
        os.close(number)
        raise
    return open(path, "rb", opener=lambda *_: number)  # so that its name is the path


def _check_plain(mode: int, path: str | Path) -> None:
    if not stat.S_ISREG(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "a pipe, socket or device"
        raise OSError(errno.EINVAL, f"it is {kind}; expected a plain file", str(path))


def read_bytes(path: str | Path, largest: int = LARGEST_FILE) -> bytes:
    """Content of a plain file of at most ``largest`` bytes."""
    with open_plain(path) as file:
        data = file.read(min(os.fstat(file.fileno()).st_size, largest) + 1)
    if len(data) > largest:
        raise OSError(errno.EFBIG, f"it has more than {largest / 1e6:.0f} MB, the largest size of its kind", str(path))
    return data


def read_text(path: str | Path, largest: int = LARGEST_TEXT) -> str:
    """Content of a UTF-8 or UTF-16 text file of at most ``largest`` bytes, with line ends ``\\n``."""
    return decode_text(read_bytes(path, largest)).replace("\r\n", "\n").replace("\r", "\n")


def decode_text(data: bytes) -> str:
    """Decode UTF-8, or UTF-16 by its byte order mark, which is removed, or by a zero byte in the first character."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16")
    zeros = data[0:1] == b"\0", data[1:2] == b"\0"
    return data.decode("utf-8-sig" if zeros[0] == zeros[1] else "utf-16-be" if zeros[0] else "utf-16-le")


def read_json(path: str | Path) -> Any:  # noqa: ANN401 - any JSON value
    """Value of a JSON file; whole numbers beyond 64 bit become floats."""
    return parse_json(read_text(path, LARGEST_TREE))


def parse_json(text: str | bytes, *, exact: bool = False) -> Any:  # noqa: ANN401 - any JSON value
    """Value of a JSON text; whole numbers beyond 64 bit become floats unless ``exact``."""
    raw = text if isinstance(text, bytes) else text.encode("utf-8", "surrogatepass")
    if sum(map(raw.count, (b",", b"[", b"{"))) > LARGEST_COUNT:
        raise ValueError(f"it has more than {LARGEST_COUNT} values")
    try:
        return _shallow(json.loads(text, parse_int=int if exact else _number))
    except RecursionError:
        raise ValueError(TOO_DEEP) from None


TOO_DEEP = f"it is nested too deeply, by more than {DEEPEST} levels"


def _shallow(tree: Any) -> Any:  # noqa: ANN401 - any JSON value
    """Return the tree if its nesting is safe for recursion."""
    level = [tree]
    for _ in range(DEEPEST):
        parts = (one.values() if isinstance(one, dict) else one for one in level)
        level = [one for part in parts if not isinstance(part, _PLAIN) for one in part if isinstance(one, dict | list)]
        if not level:
            return tree
    raise ValueError(TOO_DEEP)


_PLAIN = str | int | float | None


def _number(text: str) -> int | float:
    return int(text) if len(text) <= 18 else float(text)


def read_toml(path: str | Path) -> dict[str, Any]:
    """Content of a TOML file."""
    return parse_toml(read_text(path, LARGEST_TOML))


def parse_toml(text: str) -> dict[str, Any]:
    """Content of a TOML text."""
    try:
        return _shallow(tomllib.loads(text))
    except RecursionError:
        raise tomllib.TOMLDecodeError(TOO_DEEP) from None
    except (ValueError, OverflowError) as error:  # a date or number that Python cannot hold
        raise tomllib.TOMLDecodeError(str(error)) from None


def inflated(packed: bytes, largest: int) -> bytes:
    """Content of a zlib stream of at most ``largest`` bytes."""
    unpacker = zlib.decompressobj()
    data = unpacker.decompress(packed, largest)
    if not unpacker.eof:
        raise ValueError(f"{len(packed)} bytes unpack to more than {largest}, or are cut off")
    return data


@contextmanager
def damaged(kind: type[DudmapError], what: object, errors: tuple[type[Exception], ...] | None = None) -> Iterator[None]:
    """Turn parser errors into one sentence of class ``kind`` about ``what``.

    ``errors``: classes that mean damage, by default ``DAMAGE`` and the errors of OpenCV; errors of dudmap pass
    unchanged.
    """
    import cv2

    caught = errors or (*DAMAGE, cv2.error)
    try:
        yield
    except DudmapError:
        raise
    except caught as error:
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
            raise
        raise kind(f"cannot read {what}, it is damaged or not as its format says: {describe(error)}") from error


def foreign(kind: type[DudmapError], what: object) -> AbstractContextManager[None]:
    """Like ``damaged``, for packages without a common base of their exceptions: rosbags, trimesh."""
    return damaged(kind, what, (Exception,))


def describe(error: BaseException) -> str:
    """Text of a library's exception."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    if isinstance(error, KeyError):
        return f"it lacks {error}"
    return str(error) or type(error).__name__


@contextmanager
def open_arrays(path: str | Path) -> "Iterator[Mapping[str, NDArray[Any]]]":
    """Open a NumPy archive (``.npz``) as a mapping of names to arrays, read on access."""
    with open_plain(path) as file, zipfile.ZipFile(file) as archive:
        check_unpacked(archive, os.fstat(file.fileno()).st_size)
        yield _Arrays(archive)


def check_unpacked(archive: zipfile.ZipFile, packed: int) -> None:
    """Check the declared unpacked size of a ZIP file of ``packed`` bytes; no more is ever read."""
    limit = min(LARGEST_ARCHIVE, max(RATIO_FREE_BYTES, LARGEST_RATIO * packed))
    total = sum(info.file_size for info in archive.infolist())
    if total > limit:
        raise ValueError(f"its {packed} bytes unpack to {total}; expected {limit} or less")


class _Arrays(Mapping[str, NDArray[Any]]):
    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive

    def __getitem__(self, name: str) -> NDArray[Any]:
        info = self._archive.getinfo(f"{name}.npy")
        try:
            with self._archive.open(info) as member:
                return read_array(member, info.file_size, name)
        except (RuntimeError, NotImplementedError) as error:  # encrypted, or an unknown compression
            raise ValueError(f"{name} cannot be unpacked: {error}") from None

    def __iter__(self) -> Iterator[str]:
        return (name.removesuffix(".npy") for name in self._archive.namelist())

    def __len__(self) -> int:
        return len(self._archive.namelist())


def read_array(file: IO[bytes], size: int, name: str) -> NDArray[Any]:
    """Array of a stream of ``size`` bytes in NumPy's format; ``name`` is for messages."""
    version = np.lib.format.read_magic(file)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if read is None:
        raise ValueError(f"{name} has version {version} of NumPy's format; expected 1.0 or 2.0")
    try:
        shape, by_columns, kind = read(file)
    except (SyntaxError, TypeError, RecursionError, tokenize.TokenError) as error:  # the header is a literal
        raise ValueError(f"the header of {name} is damaged: {error}") from None
    if kind.kind not in SAFE_KINDS or kind.hasobject or not kind.itemsize:
        raise ValueError(f"{name} holds {kind}; expected numbers or text")
    if any(type(length) is not int or length < 0 for length in shape) or len(shape) > 8:
        raise ValueError(f"{name} has the shape {shape}; expected up to 8 whole numbers")
    expected = math.prod(shape) * kind.itemsize
    if expected > size:
        raise ValueError(f"{name} declares {expected} bytes and holds {size}")
    data = file.read(expected)
    if len(data) != expected:
        raise ValueError(f"{name} is cut off: it holds {len(data)} of {expected} bytes")
    codes = np.frombuffer(data, np.dtype("u4").newbyteorder(kind.byteorder)) if kind.kind == "U" else np.empty(0)
    if codes.max(initial=0) > sys.maxunicode:
        raise ValueError(f"{name} holds text with characters that do not exist")
    return np.frombuffer(bytearray(data), kind).reshape(shape, order="F" if by_columns else "C")


def load_array(path: str | Path) -> NDArray[Any]:
    """Array of a ``.npy`` file."""
    with open_plain(path) as file:
        return read_array(file, os.fstat(file.fileno()).st_size, str(path))
