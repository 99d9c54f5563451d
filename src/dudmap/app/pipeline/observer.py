"""Observers of a run: base class, log of events, crash report."""

import json
import platform
import re
import shlex
import sys
import time
import traceback
from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from dudmap.atomic_file import write_bytes, writing
from dudmap.errors import InternalError

if TYPE_CHECKING:
    from dudmap.app.pipeline.frame_source import FrameRead
    from dudmap.core.result import FrameResult
    from dudmap.core.slam import Slam

RECENT = 50
"""Events kept in memory: a second or two."""


class RunObserver:
    """Observer of a run that does nothing; its methods run between frames, in the run's thread.

    Attributes:
        in_background: Whether another thread may call ``frame``, in order and without access to the map.
    """

    in_background = False

    def start(self, slam: "Slam", out: Path, count: int | None) -> None:
        """A pass over ``count`` frames (None: unknown) begins; its run folder is empty."""

    def resume(self, slam: "Slam", out: Path, count: int | None, first: int) -> None:
        """An interrupted pass continues at frame ``first``."""
        self.start(slam, out, count)

    def frame(self, index: int, read: "FrameRead", result: "FrameResult", ms: float) -> None:
        """Frame ``index`` was processed in ``ms`` milliseconds."""

    def event(self, name: str, **values: Any) -> None:  # noqa: ANN401 - any JSON value
        """Another event, such as an unreadable frame."""

    def finish(self, out: Path) -> None:
        """The run is over, possibly by an error, and its folder is written."""


class EventLog(RunObserver):
    """Writes one line of JSON per event, before the next frame.

    Objects have ``time`` (seconds since 1970) and ``event``; docs/reliability.md lists them.

    Args:
        path: Replaced file; None keeps the last events only.

    Attributes:
        recent: The last ``RECENT`` events.
        out: The run folder, None before a run.

    Raises:
        DudmapError: The file cannot be written.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.recent: deque[dict[str, Any]] = deque(maxlen=RECENT)
        self.out: Path | None = None
        self._file: TextIO | None = None
        if path is not None:
            with writing(f"the log {path}"):
                self._file = path.open("w", encoding="utf-8", buffering=1)
        self._slam: Slam | None = None
        self._was_lost = False

    def start(self, slam: "Slam", out: Path, count: int | None) -> None:
        """Write the start event of a pass."""
        self._slam, self.out, self._was_lost = slam, out, False
        self.event("start", folder=str(out), frames=count)

    def frame(self, index: int, read: "FrameRead", result: "FrameResult", ms: float) -> None:
        """Write events of the frame's state and special events."""
        assert self._slam is not None
        place: dict[str, Any] = {"frame": index, "timestamp": result.timestamp}
        figures = {"ms": round(ms, 2), "dynamic_share": round(float(result.dynamic_share), 4), "submap": result.submap}
        if result.T_world_camera is None:
            self.event("lost", **place, **figures, reason=result.verdict.reason, first=not self._was_lost)
        else:
            position = [round(float(x), 4) for x in result.T_world_camera[:3, 3]]
            self.event(result.status, **place, **figures, fused=result.fused, position=position)
        if "relocalized" in result.events:
            self.event("relocalized", **place, submap=result.submap)
        if "corrected" in result.events:
            self.event("loop", **place, submap=result.submap)
        if "calibrated" in result.events:
            self.event("calibration", **place, estimated=list(self._slam.calibration.estimated))
        for kind, sentence in (("uncertain", result.uncertain), ("blind", "no contrast" if result.blind else "")):
            if sentence:
                self.event("warning", **place, kind=kind, reason=sentence)
        self._was_lost = result.T_world_camera is None

    def event(self, name: str, **values: Any) -> None:  # noqa: ANN401 - any JSON value
        """Write an event."""
        row = {"time": round(time.time(), 3), "event": name} | values
        self.recent.append(row)
        if self._file is not None:
            self._file.write(json.dumps(row) + "\n")

    def finish(self, out: Path) -> None:
        """Write the finish event."""
        self.event("finish", folder=str(out))

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()


def report_crash(error: BaseException, folder: Path, events: Iterable[dict[str, Any]] = ()) -> InternalError:
    """Write ``crash-<date>.txt`` with the last events; return the error that names it."""
    path = folder / f"crash-{time.strftime('%Y%m%d-%H%M%S')}.txt"
    what = f"{type(error).__name__}: {error}"
    try:
        write_bytes(path, report_text(error, events).encode("utf-8", "backslashreplace"))
        where = f"{path} says where; please report it with this file"
    except OSError as problem:
        where = f"no report could be written ({problem}); please repeat it with another folder and report it"
    return InternalError(f"this is a defect of dudmap, not of your data or settings ({what}); {where}")


def report_text(error: BaseException, events: Iterable[dict[str, Any]]) -> str:
    """Content of the report."""
    parts = [
        f"dudmap stopped by a defect of its own, {time.strftime('%Y-%m-%d %H:%M:%S %z')}",
        f"command: {command_line()}",
        f"versions: {json.dumps(_versions())}",
        "".join(traceback.format_exception(error)),
        "last events of the run, newest at the end:",
        *(json.dumps(event) for event in events),
    ]
    return "\n".join(parts) + "\n"


def command_line() -> str:
    """This process' command line without the secret of ``--token``."""
    program, *arguments = sys.argv
    program = "dudmap" if Path(program).name == "__main__.py" else Path(program).name
    return re.sub(r"(--token[= ])\S+", r"\1...", shlex.join([program, *arguments]))


def _versions() -> dict[str, Any]:
    from dudmap.app.pipeline.environment import machine, versions

    try:
        return versions() | machine()
    except (ImportError, OSError) as error:
        return {"python": platform.python_version(), "os": platform.platform(), "missing": str(error)}
