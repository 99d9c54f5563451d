"""Folder of a study: the result of every run in a folder of its own, each run claimed by one process at a time.

A result appears under its final name in one step (``os.replace`` of a finished folder), so there are whole results and
none else. A claim is a lock of the operating system on a file, which ends with the process that holds it, however that
ends; a process number written into a file would survive it and may be given to another process.
"""

import json
import os
import shutil
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dudmap.errors import DudmapError


class StudyFolder:
    """Results of a study on disk, shared by all processes that work on it.

    ``runs/<key>/result.json`` holds the result of a run, ``journal-<host>.jsonl`` one line for each run that a process
    of the host began or finished, with process and time, ``locks/`` the claims.

    Attributes:
        root: The folder.
    """

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root)

    def create(self) -> None:
        """Make the folder if it does not exist."""
        for name in ("runs", "locks"):
            (self.root / name).mkdir(parents=True, exist_ok=True)

    def result(self, key: str) -> dict[str, Any] | None:
        """Result of a run, None if it has none.

        Raises:
            DudmapError: The file was changed by something else and cannot be read.
        """
        path = self.root / "runs" / key / "result.json"
        try:
            return json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except ValueError as error:
            raise DudmapError(f"{path} is not valid JSON: {error}; remove its folder to run it again") from error

    @contextmanager
    def claim(self, key: str) -> Iterator[bool]:
        """Whether this process now has the run for itself; the claim ends with the block or the process."""
        from filelock import FileLock, Timeout

        lock = FileLock(self.root / "locks" / f"{key}.lock")
        try:
            lock.acquire(timeout=0)
        except Timeout:
            yield False
            return
        try:
            yield True
        finally:
            lock.release()

    @contextmanager
    def unfinished(self, key: str) -> Iterator[Path]:
        """Empty folder for a claimed run, which becomes its result at the end of the block, unless that raises."""
        folder = self.root / "runs" / f".{key}"  # the claim makes it ours
        if folder.exists():  # of a process that died
            shutil.rmtree(folder)
        folder.mkdir()
        self.note("begun", key)
        try:
            yield folder
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        os.replace(folder, self.root / "runs" / key)
        self.note("finished", key)

    def note(self, event: str, key: str) -> None:
        """Append a line to the journal of this host.

        Lines of several processes of a host do not mix, as each is one write. Those of several hosts would, on a
        network file system, whose clients find the end of a file each for itself.
        """
        host = socket.gethostname()
        line = {"event": event, "run": key, "pid": os.getpid(), "host": host, "time": time.time()}
        with (self.root / f"journal-{host}.jsonl").open("ab", buffering=0) as file:
            file.write((json.dumps(line) + "\n").encode())

    def journal(self) -> list[dict[str, Any]]:
        """All lines of the journals in the order of time; a line cut off by a full disk is left out."""
        lines = [line for path in self.root.glob("journal*.jsonl")
                 for line in path.read_text(encoding="utf-8").splitlines()]  # fmt: skip
        return sorted((json.loads(line) for line in lines if line.endswith("}")), key=lambda line: line["time"])
