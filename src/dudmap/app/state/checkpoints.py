"""Checkpoints of a run: a snapshot between two frames, written by a background thread."""

import os
import sqlite3
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from dudmap.app.state.database import StateDatabase
from dudmap.app.state.system import take_snapshot
from dudmap.app.state.tree import NotSettledError, Snapshot
from dudmap.atomic_file import bring_to_disk
from dudmap.errors import StateError

SHARE = 0.02
"""Largest share of the time so far that checkpoints take in processor time, snapshots and writing together, unless an
interval is given.

What the writing thread takes from the memory bandwidth and the caches of the frames is not measured; the rest of the
3 % that checkpoints may cost is left for it.
"""
FIRST = 5.0
"""Seconds before the first checkpoint: a run that is shorter is repeated as fast as it is continued."""


class Checkpoints:
    """Decides when a checkpoint is due, takes the snapshot, and has it written.

    A checkpoint that cannot be written, since the disk is full or fails or by a defect of this program, is announced
    once and tried again when the next one is due; what is in the database stays as it is.

    Args:
        database: The database, which only the writing thread uses from now on.
        every: Seconds from one checkpoint to the next; None chooses by what they cost.
        notice: Receives sentences on what cannot be written.
    """

    def __init__(self, database: StateDatabase, every: float | None, notice: Callable[[str], None]) -> None:
        self.database = database
        self.written = 0
        self._every, self._notice = every, notice
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="dudmap-state")
        self._running: Future[float] | None = None
        self._start = self._last = time.perf_counter()
        self._cost, self._last_cost = 0.0, 0.0  # seconds, of all checkpoints and of the last
        self._files: list[Path] = []
        self._failing = False

    @property
    def is_due(self) -> bool:
        """Whether it is time for a checkpoint and the last one is written."""
        if self._running is not None and not self._running.done():
            return False
        self._finish()
        now = time.perf_counter()
        if self._every is not None:
            return now - self._last >= self._every
        return now - self._last >= FIRST and self._cost + self._last_cost <= SHARE * (now - self._start)

    @property
    def is_short(self) -> bool:
        """Whether the run is so short that no checkpoint is worth its time."""
        return self._every is None and self.written == 0 and time.perf_counter() - self._start < FIRST

    def add_file(self, path: Path) -> None:
        """A file was written that the next checkpoint counts on: it is brought to the disk before."""
        self._files.append(path)

    def take(self, state: object, meta: dict[str, Any], *, wait: bool = False) -> None:
        """Take a snapshot of a state and have it written, with values that describe the run.

        It has no effect while something is computed in the background; ``wait`` waits for that, and until it is
        written.
        """
        if wait and self._running is not None:
            self._running.exception()  # waits
            self._finish()
        start, busy = time.perf_counter(), time.thread_time()  # a process that was stopped meanwhile has not been busy
        try:
            snapshot = take_snapshot(state, self.database, wait=wait)
        except NotSettledError:
            return
        except StateError as error:  # a defect of this program, which is no reason to end the run
            self._last = start
            self._warn(error)
            return
        files, self._files = self._files, []
        self._last_cost, self._last = time.thread_time() - busy, start
        self._cost += self._last_cost
        self._running = self._thread.submit(self._write, snapshot, meta, files)
        if wait:
            self._running.exception()
            self._finish()

    def close(self) -> None:
        """Wait for the thread, and close the database."""
        self._thread.shutdown()
        self._finish()
        self.database.close()

    def _write(self, snapshot: Snapshot, meta: dict[str, Any], files: list[Path]) -> float:
        """Seconds of processor time that writing took."""
        start = time.thread_time()
        for path in [*files, *{path.parent for path in files}] if os.name == "posix" else files:
            if path.exists():
                bring_to_disk(path)
        self.database.write(snapshot, meta)
        return time.thread_time() - start

    def _finish(self) -> None:
        """Take note of how the last checkpoint went."""
        running, self._running = self._running, None
        if running is None:
            return
        error = running.exception()
        if error is None:
            self._cost += running.result()
            self._last_cost += running.result()
            self.written += 1
            if self._failing:
                self._notice("checkpoints are written again")
            self._failing = False
        else:
            self._warn(error)

    def _warn(self, error: BaseException) -> None:
        """Say once that no checkpoints are written."""
        if not self._failing:
            self._failing = True
            of_disk = isinstance(error, OSError | sqlite3.Error)
            what = str(error) if of_disk or isinstance(error, StateError) else repr(error)
            hint = "; make room on the disk of the run folder" if of_disk else ""
            self._notice(f"the state of the run cannot be stored: {what}; it goes on in memory and tries again{hint}")
