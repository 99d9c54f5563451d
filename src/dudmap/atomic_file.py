"""Write files completely or not at all. An ``OSError`` names the file."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING

from dudmap.errors import DudmapError
from dudmap.own_folder import OwnFolder

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = [
    "UNFINISHED",
    "atomic_file",
    "atomic_path",
    "bring_to_disk",
    "put_in_place",
    "write_bytes",
    "write_text",
    "writing",
]

UNFINISHED = r"\..+\.\d+\.part(\.\w+)?"
"""Temporary names that a killed process leaves."""


@contextmanager
def atomic_file(path: str | Path, *, sync: bool = True, own: bool = False) -> Iterator[IO[bytes]]:
    """Open a binary file that replaces ``path`` when the block ends without an error.

    A killed process leaves the old file, a power cut the old or the new one. A link at ``path`` is replaced.

    Args:
        sync: Wait until file and name are on the disk. Without it a power cut may lose both files.
        own: The folder was made by dudmap and must be no link.
    """
    with _unfinished(Path(path), sync, own) as (_, number), open(number, "wb") as file:
        yield file


@contextmanager
def atomic_path(path: str | Path, *, sync: bool = True) -> Iterator[Path]:
    """Temporary path with the suffix of ``path``, for writers that need a name; see ``atomic_file``."""
    with _unfinished(Path(path), sync, own=False) as (temporary, number):
        os.close(number)
        yield temporary


@contextmanager
def _unfinished(path: Path, sync: bool, own: bool) -> Iterator[tuple[Path, int]]:
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        with OwnFolder(path.parent, linked=not own) as folder:
            number = folder.create(temporary.name)
        yield temporary, number
        put_in_place(temporary, path, sync=sync)
    except OSError as error:
        if isinstance(error.filename, str):
            raise
        raise OSError(error.errno or errno.EIO, error.strerror or str(error), str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def put_in_place(temporary: Path, path: Path, *, sync: bool = True) -> None:
    """Rename a complete file on the same disk, as ``atomic_file`` does."""
    if sync:
        bring_to_disk(temporary)
    temporary.replace(path)
    if sync and os.name == "posix":  # a folder is no file elsewhere
        bring_to_disk(path.parent)


@contextmanager
def writing(what: object) -> Iterator[None]:
    """Turn an error of the operating system into one sentence on the target that cannot be written.

    Raises:
        DudmapError: Instead of that error.
    """
    try:
        yield
    except OSError as error:
        raise DudmapError(f"cannot write {what}: {error.strerror or error}") from error


def write_bytes(path: str | Path, content: bytes, *, sync: bool = True, own: bool = False) -> None:
    """Write a file as ``atomic_file`` does."""
    with atomic_file(path, sync=sync, own=own) as file:
        file.write(content)


def write_image(path: str | Path, image: "NDArray", *, sync: bool = True, own: bool = False) -> None:
    """Write a PNG file of a grey or RGB image, or of a mask (True = 255)."""
    import cv2
    import numpy as np

    pixels = image[..., ::-1] if image.ndim == 3 else image.astype(np.uint8) * 255 if image.dtype == bool else image
    write_bytes(path, cv2.imencode(".png", pixels)[1].tobytes(), sync=sync, own=own)


def write_text(path: str | Path, text: str) -> None:
    """Write a UTF-8 text file as ``atomic_file`` does; other characters are escaped."""
    write_bytes(path, text.encode("utf-8", "backslashreplace"))


def bring_to_disk(path: Path) -> None:
    """Wait until a file's content, or a folder's names, are on the disk."""
    handle = os.open(path, os.O_RDONLY if os.name == "posix" else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
