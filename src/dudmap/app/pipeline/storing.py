"""Checkpoints of a run in its folder."""

import os
import re
import sqlite3
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dudmap.app.pipeline.background import Background
from dudmap.app.pipeline.environment import versions
from dudmap.app.pipeline.frame_source import AHEAD
from dudmap.app.pipeline.metrics import RunRecord
from dudmap.app.state.blocks import Snapshot
from dudmap.app.state.database import StateDatabase, StateReader
from dudmap.app.state.system import (
    check_code,
    code_fingerprint,
    frame_fingerprint,
    images_fingerprint,
    parts_of,
    read_system,
    recording_fingerprint,
    take_snapshot,
)
from dudmap.app.state.tree import NotSettledError, TreeReader
from dudmap.atomic_file import bring_to_disk
from dudmap.config import Config
from dudmap.errors import DudmapError, StateError
from dudmap.input_files import DAMAGE, read_json
from dudmap.own_folder import remove_files

if TYPE_CHECKING:
    from collections.abc import Callable

    from dudmap.core.frames.frame import Frame
    from dudmap.core.geometry.calibration import Calibration
    from dudmap.core.slam import Slam
    from dudmap.io.sequences import Sequence

DATABASE = "state.db"
FILES = DATABASE, f"{DATABASE}-wal", f"{DATABASE}-shm"
SHARE = 0.02
"""Processor time of checkpoints, share of elapsed time; bandwidth and caches take the rest of 3 %."""
FIRST = 5.0
"""Seconds before the first checkpoint."""


@dataclass(frozen=True)
class Storing:
    """How a run is stored.

    Attributes:
        every: Seconds between checkpoints; None: by cost.
    """

    recording: dict[str, Any]
    every: float | None = None
    report: bool = False


class RunOptions(BaseModel):
    """Arguments of ``run`` as they are stored."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    config: Config
    max_frames: int | None
    save_masks: bool = False
    save_map: bool = True
    masks: Path | None = None
    ahead: int = AHEAD
    passes: int = 1
    saved_map: Path | None = None
    localize: bool = False
    max_memory: int | None = None
    storing: Storing | None = None
    ignore: Path | None = None
    poses: Literal["given", "refined"] | None = None


class StoredRun(BaseModel):
    """Description of a run in its database."""

    options: RunOptions
    recording: str
    number: int | None = Field(default=None, alias="pass")
    next: int = 0
    frame: str = ""


@dataclass(eq=False)
class RunState:
    """State of a run.

    Attributes:
        number: Of the pass, from 0.
    """

    slam: "Slam"
    record: RunRecord
    calibration: "Calibration | None" = None
    number: int = 0
    next: int = 0
    first_record: RunRecord | None = None

    def parts(self) -> dict[str, object]:
        """Parts of the stored state."""
        figures = {"record": self.record, "calibration": self.calibration, "first record": self.first_record}
        return parts_of(self.slam) | figures

    @classmethod
    def read(cls, tree: TreeReader, stored: "StoredRun", device: str | None) -> "RunState":
        """Read the state with these parts."""
        from dudmap.core.geometry.calibration import Calibration

        slam, record = read_system(tree, device), tree.part("record", RunRecord)
        assert stored.number is not None
        return cls(
            slam, record, tree.part("calibration", Calibration | None), stored.number, stored.next,
            tree.part("first record", RunRecord | None),
        )  # fmt: skip


class RunStore:
    """Stores checkpoints between frames in a background thread.

    A failed checkpoint is reported once; the database keeps its content until the next.

    Args:
        every: Seconds between checkpoints; None: by cost.
        notice: Receives messages on failures.

    Raises:
        DudmapError: The database cannot be created.
    """

    def __init__(self, out: Path, every: float | None, notice: "Callable[[str], None]") -> None:
        try:
            self.database = StateDatabase(out / DATABASE)  # used by the writing thread only
        except (OSError, sqlite3.Error) as error:
            raise DudmapError(f"the state of the run cannot be stored in {out / DATABASE}: {error}") from error
        self.written = 0
        self._out, self._every, self._notice = out, every, notice
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="dudmap-state")
        self._running: Future[float] | None = None
        self._start = self._last = time.perf_counter()
        self._cost, self._last_cost = 0.0, 0.0  # processor seconds of all checkpoints and of the last
        self._files: list[Path] = []  # masks that must reach the disk before the next checkpoint
        self._failing = False

    def order(self, sequence: "Sequence", options: RunOptions) -> None:
        """Store the arguments of the run."""
        about = {"options": options.model_dump(mode="json"), "recording": recording_fingerprint(sequence)}
        about |= {"code": code_fingerprint(), "versions": versions(), "begun": datetime.now().isoformat(" ", "seconds")}
        try:
            self.database.write_meta(about)
        except sqlite3.Error as error:
            raise DudmapError(f"the state of the run cannot be stored in {self.database.path}: {error}") from error

    def frame(self, state: RunState, frame: "Frame | Exception", background: Background) -> None:
        """Take a due checkpoint once all background jobs are done."""
        if not isinstance(frame, Exception):
            self._files.append(self._out / "masks" / f"{frame.timestamp:.6f}.png")
        if self.is_due:
            background.wait()
            self.take(state, images_fingerprint(frame))

    def end(self, state: RunState) -> None:
        """Store the last state, unless the run was short."""
        if self._every is not None or self.written or time.perf_counter() - self._start >= FIRST:
            self.take(state, wait=True)

    @property
    def is_due(self) -> bool:
        """Whether a checkpoint is due and the last is written."""
        if self._running is not None and not self._running.done():
            return False
        self._finish()
        now = time.perf_counter()
        if self._every is not None:
            return now - self._last >= self._every
        return now - self._last >= FIRST and self._cost + self._last_cost <= SHARE * (now - self._start)

    def take(self, state: RunState, frame: str = "", *, wait: bool = False) -> None:
        """Have a snapshot of the state written; with ``wait`` after background computations, else not during them.
        ``frame``: fingerprint of the last frame."""
        if wait:
            self._finish()
        start, busy = time.perf_counter(), time.thread_time()
        for record in filter(None, (state.record, state.first_record)):
            record.settle()
        updated = datetime.now().isoformat(" ", "seconds")
        place = {"pass": state.number, "next": state.next, "frame": frame, "updated": updated}
        try:
            snapshot = take_snapshot(state.parts(), self.database, wait=wait)
        except NotSettledError:
            return
        except StateError as error:  # a defect of this program does not end the run
            self._last = start
            self._warn(error)
            return
        files, self._files = self._files, []
        self._last_cost, self._last = time.thread_time() - busy, start
        self._cost += self._last_cost
        self._running = self._thread.submit(self._write, snapshot, place, files)
        if wait:
            self._finish()

    def reopened(self) -> "RunStore":
        """Reopen the store after ``close``."""
        return RunStore(self._out, self._every, self._notice)

    def close(self, *, finished: bool) -> None:
        """Close the database; remove it if the run is finished."""
        self._thread.shutdown()
        self._finish()
        self.database.close()
        if finished:
            remove_files(self._out, {"": "|".join(map(re.escape, FILES))})

    def _write(self, snapshot: Snapshot, meta: dict[str, Any], files: list[Path]) -> float:
        start = time.thread_time()
        for path in [*files, *{path.parent for path in files}] if os.name == "posix" else files:
            if path.exists():
                bring_to_disk(path)
        self.database.write(snapshot, meta)
        return time.thread_time() - start

    def _finish(self) -> None:
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
        if not self._failing:
            self._failing = True
            of_disk = isinstance(error, OSError | sqlite3.Error)
            what = str(error) if of_disk or isinstance(error, StateError) else repr(error)
            hint = "; make room on the disk of the run folder" if of_disk else ""
            self._notice(f"the state of the run cannot be stored: {what}; it goes on in memory and tries again{hint}")


def stored_options(out: Path) -> tuple[StateReader, StoredRun]:
    """Open the database of an unfinished run, with the run's description.

    Raises:
        StateError: There is none, the run is finished, or another version wrote it.
    """
    if not (out / DATABASE).is_file():
        raise StateError(_why_nothing(out))
    reader = StateReader(out / DATABASE)
    meta = reader.meta()
    if not meta:
        raise StateError(f"the run in {out} ended before its first frame; begin it again with dudmap run")
    check_code(meta, out / DATABASE)
    try:
        return reader, StoredRun.model_validate(meta)
    except ValidationError as error:
        raise StateError(
            f"{out / DATABASE} is damaged or not the state of a run; begin again with dudmap run"
        ) from error


def check_recording(sequence: "Sequence", stored: StoredRun, out: Path) -> None:
    """Check the recording of a stored run."""
    same = recording_fingerprint(sequence) == stored.recording
    if not same or (stored.frame and frame_fingerprint(sequence, stored.next - 1) != stored.frame):
        raise StateError(
            f"the recording {sequence.name} has changed since the run in {out} began; restore the old one, or "
            "begin again with dudmap run"
        )


def _why_nothing(out: Path) -> str:
    try:
        metrics = read_json(out / "metrics.json")
        if metrics["complete"]:
            return f"the run in {out} is finished ({metrics['frames']} frames); there is nothing to resume"
    except DAMAGE:
        pass
    return f"{out} holds no state of a run ({DATABASE}); expected the folder of an interrupted dudmap run"
