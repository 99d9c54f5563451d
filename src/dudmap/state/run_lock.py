"""Lock of a run folder: one process at a time writes into it."""

import json
import os
import socket
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import IO

from dudmap.errors import DudmapError

NAME = ".lock"
BYTE = 1 << 20
"""Place of the locked byte on Windows, behind the text, which others must be able to read."""


class RunLock:
    """Holds the lock of a folder while it is open; the operating system gives it up when the process ends, however.

    Args:
        folder: The run folder, which exists.

    Raises:
        DudmapError: Another process, or another run of this one, holds the lock; the sentence says which.
        OSError: The file cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / NAME
        while True:
            self._file: IO[bytes] = os.fdopen(os.open(self.path, os.O_RDWR | os.O_CREAT, 0o644), "r+b")
            try:
                _lock(self._file)
            except OSError:
                holder = self._file.read(1000).decode(errors="replace")
                self._file.close()
                raise DudmapError(
                    f"{folder} is in use by {_described(holder)}; wait for it, end it, or name another folder"
                ) from None
            if self.path.exists() and os.path.samestat(os.fstat(self._file.fileno()), self.path.stat()):
                break
            self._file.close()  # whoever held it has removed this file in between
        about = {"pid": os.getpid(), "host": socket.gethostname(), "since": datetime.now().isoformat(" ", "seconds")}
        self._file.truncate(0)
        self._file.write(json.dumps(about).encode())
        self._file.flush()

    def close(self) -> None:
        """Give the lock up and remove its file."""
        if os.name == "posix":
            self.path.unlink(missing_ok=True)
        self._file.close()

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
