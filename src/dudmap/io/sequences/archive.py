"""Unpack archived recordings once into a cache; other members raise an error."""

import bz2
import errno
import gzip
import hashlib
import lzma
import os
import shutil
import stat
import tarfile
import tempfile
import zipfile
from collections.abc import Callable, Generator
from contextlib import closing
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, cast

from dudmap.errors import DatasetError
from dudmap.input_files import DAMAGE, LARGEST_RATIO, RATIO_FREE_BYTES, damaged, open_plain, read_bytes

SUFFIXES = (".zip", ".tar", ".tgz", ".tar.gz", ".tar.bz2", ".tbz2", ".tar.xz", ".txz")
LARGEST_BYTES = 256 * 2**30
"""Largest unpacked size; a CoRBS scene has 30 GB."""
LARGEST_COUNT = 1_000_000
"""Members: 4.6 hours of files at 30 Hz."""
LARGEST_HEADER = 2**20
"""Header of a tar member, bytes: a long name has 10 kB."""
LARGEST_DICTIONARY = 2**27
"""Memory for unpacking xz, bytes; preset 9 needs 65 MB."""
CHUNK = 2**20
NAME_FOLDER = "name a folder that you can write in the environment variable DUDMAP_CACHE"
ORIGIN = "origin.txt"


Member = tuple[str, str, Callable[[], IO[bytes] | None]]


def is_archive(path: Path) -> bool:
    """Whether a file is an archive by its name."""
    return path.name.lower().endswith(SUFFIXES) and path.is_file()


def split(path: Path) -> tuple[Path, PurePosixPath] | None:
    """Archive and member of a path such as ``chess.zip/chess/seq-01``; None if no part of it is an archive."""
    for parent in (path, *path.parents):
        if is_archive(parent):
            return parent, PurePosixPath(*path.parts[len(parent.parts) :])
    return None


def cache_folder() -> Path:
    """Folder of unpacked archives: DUDMAP_CACHE, else XDG_CACHE_HOME/dudmap, else ~/.cache/dudmap.

    Raises:
        DatasetError: The user has no home folder.
    """
    given = os.environ.get("DUDMAP_CACHE")
    if given:
        return Path(given)
    base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if base.startswith("~"):
        raise DatasetError(f"this user has no home folder to unpack archives in; {NAME_FOLDER}")
    return Path(base) / "dudmap"


def unpack(path: Path) -> Path:
    """Folder with the content of an archive, unpacked once per version.

    Raises:
        DatasetError: The archive is damaged, encrypted or too large, holds links, devices or paths out of it, or the
            cache cannot be written.
    """
    with damaged(DatasetError, f"the archive {path}"):
        open_plain(path).close()
    status = path.stat()
    key = f"{path.resolve()} {status.st_size} {status.st_mtime_ns}"
    place = cache_folder() / f"{stem(path)}-{hashlib.sha256(key.encode()).hexdigest()[:12]}"
    folder = place / stem(path)
    if folder.is_dir():
        return folder
    try:
        cache_folder().mkdir(parents=True, exist_ok=True)
        writer = tempfile.TemporaryDirectory(dir=cache_folder(), prefix="unfinished-")
    except OSError as error:
        said = f"cannot unpack {path} into {cache_folder()} ({error.strerror})"
        raise DatasetError(f"{said}; {NAME_FOLDER}") from error
    try:
        with writer as unfinished:
            content = Path(unfinished) / "place" / stem(path)
            _unpack_into(path, content, status.st_size)
            (content.parent / ORIGIN).write_bytes(os.fsencode(path.resolve()))
            try:
                content.parent.rename(place)
            except OSError:
                if not place.is_dir():  # another process has unpacked it in the meantime
                    raise
    except (zipfile.BadZipFile, tarfile.TarError, RuntimeError, *DAMAGE) as error:
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
            raise OSError(error.errno, error.strerror, str(cache_folder())) from error
        raise DatasetError(f"cannot unpack {path}: {error}") from error
    return folder


def origin(path: Path) -> Path | None:
    """Archive that a folder was unpacked from; None if it was not."""
    for parent in path.resolve().parents:
        if (parent / ORIGIN).is_file() and cache_folder().resolve() == parent.parent:
            return Path(os.fsdecode(read_bytes(parent / ORIGIN)))
    return None


def stem(path: Path) -> str:
    """Name of an archive without its suffix."""
    suffix = max((suffix for suffix in SUFFIXES if path.name.lower().endswith(suffix)), key=len)
    return path.name[: -len(suffix)]


def _unpack_into(path: Path, folder: Path, packed: int) -> None:
    """Write all files of an archive into a new folder, limited in size."""
    folder.mkdir(parents=True)
    limit = min(LARGEST_BYTES, max(RATIO_FREE_BYTES, LARGEST_RATIO * packed), shutil.disk_usage(folder).free)
    written = 0
    with closing(_zip_members(path) if path.name.lower().endswith(".zip") else _tar_members(path)) as members:
        for count, (name, kind, opened) in enumerate(members, start=1):
            if count > LARGEST_COUNT:
                raise DatasetError(f"{path} has more than {LARGEST_COUNT} members; expected a recording")
            target = folder.joinpath(*_inside(path, name, kind).parts)
            if kind == "folder":
                target.mkdir(parents=True, exist_ok=True)
                continue
            target.parent.mkdir(parents=True, exist_ok=True)
            source = None if target.exists() else opened()
            if source is None:
                raise DatasetError(f"{path} holds {name} twice; expected every file once")
            with source, target.open("wb") as out:
                while chunk := source.read(CHUNK):
                    written += len(chunk)
                    if written > limit:
                        raise DatasetError(
                            f"{path} ({packed / 1e6:.1f} MB) unpacks to more than {limit / 1e6:.0f} MB, the least of "
                            f"{LARGEST_RATIO} times its size, {LARGEST_BYTES / 2**30:.0f} GiB and the free space of "
                            f"{cache_folder()}; unpack it by hand if you trust it, or name another folder with "
                            "DUDMAP_CACHE"
                        )
                    out.write(chunk)


def _inside(path: Path, member: str, kind: str) -> PurePosixPath:
    if kind not in ("file", "folder"):
        raise DatasetError(f"{path} holds {member}, a {kind}; an archive of a recording has files only")
    name = member.replace("\\", "/")
    parts = PurePosixPath(name)
    if parts.is_absolute() or ".." in parts.parts or ":" in name or "\0" in name:
        raise DatasetError(f"{path} holds {member!r}, a path that leads out of the archive; it was not unpacked")
    return parts


def _zip_members(path: Path) -> "Generator[Member]":
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            mode = stat.S_IFMT(info.external_attr >> 16)
            kind = "folder" if info.is_dir() else "file" if mode in (0, stat.S_IFREG) else "link or device"
            yield info.filename, kind, partial(archive.open, info)


def _tar_members(path: Path) -> "Generator[Member]":
    with open_plain(path) as file, _unpacked(file) as content:
        bounded = _Bounded(content)
        with tarfile.open(fileobj=cast("IO[bytes]", bounded), mode="r|") as archive:
            while (info := archive.next()) is not None:
                kind = "folder" if info.isdir() else "file" if info.isreg() else "link or device"
                bounded.left = info.size + LARGEST_HEADER
                yield info.name, kind, partial(archive.extractfile, info)
                bounded.left = LARGEST_HEADER


def _unpacked(file: IO[bytes]) -> "IO[bytes] | gzip.GzipFile | bz2.BZ2File | lzma.LZMAFile":
    start = file.read(6)
    file.seek(0)
    if start.startswith(b"\x1f\x8b"):
        return gzip.GzipFile(fileobj=file)
    if start.startswith(b"BZh"):
        return bz2.BZ2File(file)
    if start.startswith((b"\xfd7zXZ\0", b"]\0\0\x80", b"]\0\0\0")):
        # refuse a declared dictionary larger than any preset's before memory is allocated
        lzma.LZMADecompressor(memlimit=LARGEST_DICTIONARY).decompress(file.read(CHUNK), max_length=1)
        file.seek(0)
        return lzma.LZMAFile(file)
    return file


class _Bounded:
    """A stream that fails if the headers of one member exceed ``LARGEST_HEADER`` bytes."""

    def __init__(self, content: "IO[bytes] | gzip.GzipFile | bz2.BZ2File | lzma.LZMAFile") -> None:
        self._content, self.left = content, LARGEST_HEADER

    def read(self, size: int) -> bytes:
        data = self._content.read(size)
        self.left -= len(data)
        if self.left < 0:
            raise tarfile.ReadError(f"the headers of a member have more than {LARGEST_HEADER / 1e6:.0f} MB")
        return data
