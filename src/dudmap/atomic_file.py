"""Files that are either written completely or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

__all__ = ["UNFINISHED", "atomic_file", "atomic_path", "bring_to_disk", "put_in_place", "write_bytes", "write_text"]

UNFINISHED = ".*.[0-9]*.part*"
"""Pattern of the temporary names, under which a process that is killed leaves what it was writing."""


@contextmanager
def atomic_file(path: str | Path, *, sync: bool = True) -> Iterator[IO[bytes]]:
    """Open a binary file that takes the place of ``path`` when the block ends without an error.

    It is written beside ``path`` under a temporary name, flushed to the disk and renamed, so that a process that is
    killed leaves the old file, and a power cut leaves the old or the new one.

    Args:
        path: The file.
        sync: Wait until the file and its name are on the disk. Without it a power cut may lose the file, also the old.

    Raises:
        OSError: The file cannot be written.
    """
    with atomic_path(path, sync=sync) as temporary, temporary.open("wb") as file:
        yield file


@contextmanager
def atomic_path(path: str | Path, *, sync: bool = True) -> Iterator[Path]:
    """A temporary path with the ending of ``path``, for writers that want a name; see ``atomic_file``.

    Raises:
        OSError: The file cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        yield temporary
        put_in_place(temporary, path, sync=sync)
    finally:
        temporary.unlink(missing_ok=True)


def put_in_place(temporary: Path, path: Path, *, sync: bool = True) -> None:
    """Give a complete file on the same disk its name, as ``atomic_file`` does.

    Raises:
        OSError: It cannot be brought to the disk or renamed.
    """
    if sync:
        bring_to_disk(temporary)
    temporary.replace(path)
    if sync and os.name == "posix":  # a folder is no file elsewhere
        bring_to_disk(path.parent)


def write_bytes(path: str | Path, content: bytes, *, sync: bool = True) -> None:
    """Write a file as ``atomic_file`` does."""
    with atomic_file(path, sync=sync) as file:
        file.write(content)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in UTF-8 as ``atomic_file`` does."""
    write_bytes(path, text.encode())


def bring_to_disk(path: Path) -> None:
    """Wait until the content of a file, or the names in a folder, are on the disk.

    Raises:
        OSError: They cannot be brought there.
    """
    handle = os.open(path, os.O_RDONLY if os.name == "posix" else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
