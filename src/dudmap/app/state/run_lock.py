"""Lock of a run folder: one process at a time writes into it."""

import json
import os
import socket
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import IO

from dudmap.errors import DudmapError
from dudmap.own_folder import OwnFolder

NAME = ".lock"
BYTE = 1 << 20
"""Place of the locked byte on Windows, behind the text, which others must be able to read."""


class RunLock:
    """Holds the lock of a folder while it is open; the operating system gives it up when the process ends, however.

    Args:
        folder: The run folder, which exists.

    Raises:
        DudmapError: Another process, or another run of this one, holds the lock; the sentence says which.
        OSError: The file cannot be written, or is a link or anything but a plain file.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = OwnFolder(folder, linked=True)
        try:
            self._file = self._locked(folder)
        except BaseException:
            self._folder.close()
            raise
        about = {"pid": os.getpid(), "host": socket.gethostname(), "since": datetime.now().isoformat(" ", "seconds")}
        self._file.truncate(0)
        self._file.write(json.dumps(about).encode())
        self._file.flush()

    def _locked(self, folder: Path) -> IO[bytes]:
        while True:
            file = os.fdopen(self._folder.open(NAME, os.O_RDWR | os.O_CREAT), "r+b")
            try:
                _lock(file)
            except OSError:
                holder = file.read(1000).decode(errors="replace")
                file.close()
                raise DudmapError(
                    f"{folder} is in use by {_described(holder)}; wait for it, end it, or name another folder"
                ) from None
            there = self._folder.status(NAME)
            if there is not None and os.path.samestat(os.fstat(file.fileno()), there):
                return file
            file.close()  # whoever held it has removed this file in between

    def close(self) -> None:
        """Give the lock up and remove its file."""
        if os.name == "posix":
            self._folder.remove(NAME)
        self._file.close()
        self._folder.close()

    def __enter__(self) -> "RunLock":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def _lock(file: IO[bytes]) -> None:
    """Lock a file for this process.

    Raises:
        OSError: It is locked.
    """
    if os.name == "nt":
        import msvcrt

        file.seek(BYTE)
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]
        file.seek(0)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _described(holder: str) -> str:
    """Who holds a lock, from its file."""
    try:
        about = json.loads(holder)
        return f"process {int(about['pid'])} on {about['host']} since {about['since']}"
    except (ValueError, KeyError, TypeError):
        return "another process"
