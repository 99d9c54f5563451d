"""Recordings behind a URL: fetched once per machine, for all workers on it."""

import hashlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dudmap.errors import ConfigError, DatasetError
from dudmap.extras import need
from dudmap.lab.benchmark.suites import Entry

if TYPE_CHECKING:
    from dudmap.core.geometry.mesh import Mesh
    from dudmap.io.sequences import Sequence


def name_of(url: str) -> str:
    """Name of the file or folder at a URL."""
    return url.partition("?")[0].rstrip("/").rpartition("/")[2]


@dataclass(frozen=True)
class RemoteEntry(Entry):
    """Recording behind a URL of any file system that fsspec knows; every machine fetches it when it first needs it."""

    url: str = ""

    def open(self) -> "Sequence":
        """Fetch the recording unless this machine has it, and open it.

        Raises:
            DatasetError: It cannot be fetched, or is no recording.
        """
        from dudmap.io.sequences import open_sequence

        with fetched(self.url) as path:  # an archive is unpacked by one process as well
            return open_sequence(path)

    def surfaces(self, sequence: "Sequence") -> "tuple[Mesh, Mesh] | None":
        """See ``Entry``."""
        with fetched(self.url) as path:
            return Entry(self.name, path).surfaces(sequence)


@contextmanager
def fetched(url: str) -> Iterator[Path]:
    """Copy of a file or folder on this machine, which no other process opens or fetches meanwhile.

    It is kept in the cache of dudmap (``dudmap.io.sequences.archive.cache_folder``) and appears under its name in one
    step. Processes of one machine wait for the first of them to fetch it; the lock ends with the process that holds
    it, so that one that was killed while fetching holds up nobody.

    Raises:
        MissingExtraError: fsspec is not installed.
        ConfigError: The package that fsspec needs for this kind of URL is not installed.
        DatasetError: The URL cannot be read.
    """
    from filelock import FileLock

    from dudmap.io.sequences.archive import cache_folder

    folder = cache_folder().absolute() / "fetched" / hashlib.sha256(url.encode()).hexdigest()[:20]
    folder.mkdir(parents=True, exist_ok=True)
    copy = folder / name_of(url)
    with FileLock(folder / ".lock"):
        if not copy.exists():
            part = folder / ".part"
            _remove(part)  # of a process that was killed
            try:
                _download(url, part)
            except BaseException:
                _remove(part)
                raise
            os.replace(part, copy)
        yield copy


def _download(url: str, to: Path) -> None:
    need("cluster", f"the recording {url}", ("fsspec",))
    fsspec: Any = import_module("fsspec")
    try:
        system, place = fsspec.core.url_to_fs(url)
    except ImportError as error:
        raise ConfigError(f"{url} cannot be read: {error}") from None
    except ValueError as error:
        raise DatasetError(f"{url} is not a URL that fsspec can read: {error}") from None
    try:
        if system.isdir(place):
            system.get(place.rstrip("/") + "/", str(to), recursive=True)
        else:
            system.get_file(place, str(to))
    except FileNotFoundError:
        raise DatasetError(f"there is nothing at {url}") from None
    except Exception as error:  # every file system has its own errors
        raise DatasetError(f"{url} cannot be fetched: {type(error).__name__}: {error}") from error


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
