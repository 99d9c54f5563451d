"""What watches a run without taking part in it: viewers, logs, pictures."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dudmap.app.pipeline.frame_source import FrameRead
    from dudmap.core.result import FrameResult
    from dudmap.core.slam import Slam


class RunObserver:
    """Observer of a run; this one does nothing.

    All methods are called in the thread of the run, between two frames, when nothing changes the map.
    """

    def start(self, slam: "Slam", out: Path, count: int | None) -> None:
        """A pass over ``count`` frames (None: unknown) begins with this system; its run folder exists and is empty."""

    def resume(self, slam: "Slam", out: Path, count: int | None, first: int) -> None:
        """A pass that was interrupted goes on at frame number ``first``; by default as if it began."""
        self.start(slam, out, count)

    def frame(self, index: int, read: "FrameRead", result: "FrameResult", ms: float) -> None:
        """Frame number ``index`` was read and processed in ``ms`` milliseconds."""

    def event(self, name: str, **values: Any) -> None:  # noqa: ANN401 - any JSON value
        """Something else happened, such as an unreadable frame, with its figures."""

    def finish(self, out: Path) -> None:
        """The run is over, also by an error or an interrupt, and its run folder is written."""
