"""Folders that dudmap writes, possibly of unknown origin.

Files are opened, made and deleted only as plain files or folders inside them: links are not followed, and only names
that dudmap gives are deleted. Everything else raises an ``OSError`` that names it.
"""

import errno
import os
import re
import stat
from collections.abc import Mapping
from pathlib import Path

from dudmap.errors import DudmapError

_HAS_RELATIVE_NAMES = os.name == "posix"
NO_LINK = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


class OwnFolder:
    """An open folder; names are single ones, without a separator.

    Args:
        linked: The folder itself may be a link; its content may not.

    Raises:
        OSError: There is no such folder.
    """

    def __init__(self, path: Path, *, linked: bool = False) -> None:
        self.path = path
        if not linked and not stat.S_ISDIR(os.lstat(path).st_mode):
            raise _refused(path, "is a link or no folder; expected a folder of its own")
        flags = os.O_RDONLY | getattr(os, "O_DIRECTORY", 0) | (0 if linked else NO_LINK)
        self._at = os.open(path, flags) if _HAS_RELATIVE_NAMES else None

    def close(self) -> None:
        """Close the folder."""
        if self._at is not None:
            os.close(self._at)

    def __enter__(self) -> "OwnFolder":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def status(self, name: str) -> os.stat_result | None:
        """Status of a file without following links; None if it does not exist."""
        try:
            return os.stat(self._place(name), dir_fd=self._at, follow_symlinks=False)
        except FileNotFoundError:
            return None

    def open(self, name: str, flags: int) -> int:
        """Open a plain file without other hard links."""
        self.check(name, alone=True)
        number = os.open(self._place(name), flags | NO_LINK, 0o644, dir_fd=self._at)
        if not stat.S_ISREG(os.fstat(number).st_mode):  # it may have been replaced in the meantime
            os.close(number)
            raise _refused(self.path / name, "is no plain file")
        return number

    def create(self, name: str) -> int:
        """Create a file for writing; replaces an old file or link."""
        self.remove(name)
        return os.open(self._place(name), os.O_RDWR | os.O_CREAT | os.O_EXCL | NO_LINK, 0o666, dir_fd=self._at)

    def check(self, name: str, *, alone: bool = False) -> None:
        """Check that a name is free or a plain file; ``alone``: without other hard links."""
        status = self.status(name)
        if status is not None and not (stat.S_ISREG(status.st_mode) and (status.st_nlink == 1 or not alone)):
            raise _refused(self.path / name, "is a link or no plain file")

    def files(self, form: str) -> list[str]:
        """Names of the plain files that a regular expression matches fully."""
        names = os.listdir(self.path if self._at is None else self._at)
        found = sorted(name for name in names if re.fullmatch(form, name))
        for name in found:
            self.check(name)
        return found

    def remove(self, name: str) -> None:
        """Delete a file, if there is one."""
        try:
            os.unlink(self._place(name), dir_fd=self._at)
        except FileNotFoundError:
            pass

    def _place(self, name: str) -> str | Path:
        return self.path / name if self._at is None else name


def check_outside(path: Path, recording: object, option: str = "--out") -> None:
    """Check that an output path lies outside of a recording, whose ``path`` is its folder or file.

    Raises:
        DudmapError: It lies inside, directly or through links.
    """
    place = getattr(recording, "path", None)
    if place is not None and path.resolve().is_relative_to(place.resolve()):
        raise DudmapError(f"{path} lies in the recording {place}, which is only read; name a place outside ({option})")


def make_folder(path: Path) -> None:
    """Make a folder inside dudmap's folders, unless it exists."""
    path.mkdir(exist_ok=True)
    OwnFolder(path).close()


def remove_files(folder: Path, written: Mapping[str, str]) -> None:
    """Delete the files of a folder that match ``written``: a pattern per sub-folder, ``""`` for the folder itself.

    Nothing is deleted if a sub-folder is a link, or something else has such a name.
    """
    there = {name: form for name, form in written.items() if not name or os.path.lexists(folder / name)}
    found = {}
    for name, form in there.items():
        with OwnFolder(folder / name, linked=not name) as place:
            found[name] = place.files(form)
    for name, files in found.items():
        with OwnFolder(folder / name, linked=not name) as place:
            for file in files:
                place.remove(file)


def _refused(path: Path, why: str) -> OSError:
    return OSError(errno.EINVAL, f"{path.name} {why}; remove it, or name another folder", str(path))
