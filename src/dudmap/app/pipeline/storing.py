"""The state of a run in its folder: what is stored, when, and what a continued run finds there."""

import re
import sqlite3
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dudmap.app.pipeline.environment import versions
from dudmap.app.pipeline.frame_source import AHEAD
from dudmap.app.pipeline.metrics import RunRecord
from dudmap.app.state.checkpoints import Checkpoints
from dudmap.app.state.database import StateDatabase, StateReader
from dudmap.app.state.system import (
    check_code,
    code_fingerprint,
    frame_fingerprint,
    images_fingerprint,
    recording_fingerprint,
    restore,
)
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


@dataclass(frozen=True)
class Storing:
    """How a run is stored while it goes on.

    Attributes:
        recording: Arguments of ``open_sequence``: path, and camera and options as texts.
        every: Seconds from one checkpoint to the next; None chooses by what they cost.
        report: Whether a report is made.
    """

    recording: dict[str, Any]
    every: float | None = None
    report: bool = False


class RunOptions(BaseModel):
    """What a run was ordered with, under the names of the arguments of ``run``, as it is stored."""

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


class StoredRun(BaseModel):
    """What the database of a run says of it.

    Attributes:
        options: What it was ordered with.
        recording: Fingerprint of the recording.
        number: Number of the pass that goes on, None before the first frame.
        next, frame: Number of the frame that comes next, and fingerprint of the one before.
    """

    options: RunOptions
    recording: str
    number: int | None = Field(default=None, alias="pass")
    next: int = 0
    frame: str = ""


@dataclass(eq=False)
class RunState:
    """Where a run stands.

    Attributes:
        slam, record: The system and the metrics of the pass that goes on.
        calibration: Of the camera, as given.
        number: Number of the pass, from 0.
        next: Number of the frame that comes next.
        first_slam, first_record: System and metrics of the first pass, during the second.
    """

    slam: "Slam"
    record: RunRecord
    calibration: "Calibration | None" = None
    number: int = 0
    next: int = 0
    first_slam: "Slam | None" = None
    first_record: RunRecord | None = None


class RunStore:
    """Stores the state of a run in its folder.

    Args:
        out: The run folder, locked by this process.
        every: Seconds from one checkpoint to the next; None chooses by what they cost.
        notice: Receives sentences on what cannot be stored.

    Raises:
        DudmapError: The database cannot be created.
    """

    def __init__(self, out: Path, every: float | None, notice: "Callable[[str], None]") -> None:
        try:
            self.database = StateDatabase(out / DATABASE)
        except (OSError, sqlite3.Error) as error:
            raise DudmapError(f"the state of the run cannot be stored in {out / DATABASE}: {error}") from error
        self.checkpoints = Checkpoints(self.database, every, notice)
        self._out, self._every, self._notice = out, every, notice

    def order(self, sequence: "Sequence", options: RunOptions) -> None:
        """Store what the run is, before anything that takes time."""
        about = {"options": options.model_dump(mode="json"), "recording": recording_fingerprint(sequence)}
        about |= {"code": code_fingerprint(), "versions": versions(), "begun": datetime.now().isoformat(" ", "seconds")}
        try:
            self.database.write_meta(about)
        except sqlite3.Error as error:
            raise DudmapError(f"the state of the run cannot be stored in {self.database.path}: {error}") from error

    def begin(self, state: RunState) -> None:
        """Store the state before the first frame."""
        self._take(state, "", wait=True)

    def frame(self, state: RunState, frame: "Frame | Exception") -> None:
        """A frame was processed; take a checkpoint if one is due."""
        if not isinstance(frame, Exception):
            self.checkpoints.add_file(self._out / "masks" / f"{frame.timestamp:.6f}.png")
        if self.checkpoints.is_due:
            self._take(state, images_fingerprint(frame))

    def end(self, state: RunState) -> None:
        """All frames are processed, and the results will be written: store the last state unless the run was short."""
        if not self.checkpoints.is_short:
            self._take(state, "", wait=True)

    def _take(self, state: RunState, frame: str, *, wait: bool = False) -> None:
        for record in filter(None, (state.record, state.first_record)):
            record.settle()
        updated = datetime.now().isoformat(" ", "seconds")
        place = {"pass": state.number, "next": state.next, "frame": frame, "updated": updated}
        self.checkpoints.take(state, place, wait=wait)

    def reopened(self) -> "RunStore":
        """The same after ``close``, to go on from what is stored."""
        return RunStore(self._out, self._every, self._notice)

    def close(self, *, finished: bool) -> None:
        """Close the database, and remove it where the run is finished, so that only its results remain."""
        self.checkpoints.close()
        if finished:
            remove_files(self._out, {"": "|".join(map(re.escape, FILES))})


def stored_options(out: Path) -> tuple[StateReader, StoredRun]:
    """The database of an unfinished run, and what it says of the run.

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
            f"{out / DATABASE} is damaged or not the state of a run; begin anew with dudmap run"
        ) from error


def check_recording(sequence: "Sequence", stored: StoredRun, out: Path) -> None:
    """Refuse a recording that is not the one that a stored run is of."""
    same = recording_fingerprint(sequence) == stored.recording
    if not same or (stored.frame and frame_fingerprint(sequence, stored.next - 1) != stored.frame):
        raise StateError(
            f"the recording {sequence.name} is not as it was when the run in {out} began; bring the old one back, or "
            "begin anew with dudmap run"
        )


def restored(reader: StateReader, store: RunStore, slam: "Slam", other: "Slam") -> RunState:
    """Where a stored run stands, made of two new systems of the same camera and configuration, one for each pass.

    Raises:
        StateError: The database is damaged.
    """
    current = RunState(slam, RunRecord(), first_slam=other, first_record=RunRecord())
    return restore(reader, current, store.database, slam.device)


def _why_nothing(out: Path) -> str:
    """Sentence on why a folder holds no run that can be continued."""
    try:
        metrics = read_json(out / "metrics.json")
        if metrics["complete"]:
            return f"the run in {out} is finished ({metrics['frames']} frames); there is nothing to resume"
    except DAMAGE:
        pass
    return f"{out} holds no state of a run ({DATABASE}); expected the folder of an interrupted dudmap run"
