"""Small images of evenly spaced frames, kept in the run folder for the report."""

from pathlib import Path
from typing import TYPE_CHECKING

from dudmap.errors import FrameError
from dudmap.pipeline.observer import RunObserver
from dudmap.viewing.snapshot import FrameImages, jpeg

if TYPE_CHECKING:
    from dudmap.pipeline.frame_source import FrameRead
    from dudmap.result import FrameResult
    from dudmap.slam import Slam

FOLDER = "thumbnails"
NUMBER = 36
"""Number of frames that are kept: about 1.5 MB of JPEG files, and a strip that can still be looked through."""


class Thumbnails(RunObserver):
    """Writes ``thumbnails/<timestamp>.<kind>.jpg`` for up to ``NUMBER`` evenly spaced frames."""

    def __init__(self) -> None:
        self._out, self._count, self._next = Path(), 1, 0

    def start(self, slam: "Slam", out: Path, count: int) -> None:
        """Remember where the images go and how many frames come."""
        self._out, self._count, self._next = out / FOLDER, count, 0
        self._out.mkdir(exist_ok=True)
        for path in self._out.glob("*.jpg"):  # of the first pass, whose timestamps may differ in a live run
            path.unlink()

    def frame(self, index: int, read: "FrameRead", result: "FrameResult", ms: float) -> None:
        """Write the images of the frame if it is the first one of the next of ``NUMBER`` equal parts."""
        if index * NUMBER < self._next * self._count or isinstance(read.frame, FrameError):
            return
        self._next = index * NUMBER // self._count + 1
        for kind, image in FrameImages.of(read.frame, result).pictures().items():
            (self._out / f"{result.timestamp:.6f}.{kind}.jpg").write_bytes(jpeg(image))
