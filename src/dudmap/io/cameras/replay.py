"""A recording as if it were a live camera."""

import time
from threading import Event
from typing import TYPE_CHECKING

import numpy as np

from dudmap.errors import FrameError
from dudmap.io.cameras import MAX_WAIT, CameraFrame, LiveCamera

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from dudmap.core.frames.frame import Frame
    from dudmap.io.sequences import Sequence


class ReplayCamera(LiveCamera):
    """Delivers the frames of a recording at their times from the first ``read``.

    Frames due for longer than ``MAX_WAIT`` are lost.

    Args:
        recording: Path, or the opened sequence.

    Raises:
        DatasetError: The recording cannot be opened.
    """

    def __init__(self, recording: "str | Sequence") -> None:
        from dudmap.io.sequences import is_timed, open_sequence

        self._sequence = open_sequence(recording) if isinstance(recording, str) else recording
        self.name = self._sequence.name
        self.camera, self.calibration = self._sequence.camera, self._sequence.calibration
        self.ground_truth, self.length = self._sequence.ground_truth, len(self._sequence)
        self.path = getattr(self._sequence, "path", None)
        self.opened = getattr(self._sequence, "opened", None)
        self.sources: dict[str, str] = getattr(self._sequence, "sources", {})
        self.timed = is_timed(self._sequence)
        self.timestamps = self._sequence.timestamps
        self._times = self.timestamps - self.timestamps[0]
        self._start: float | None = None
        self._next = 0
        self._closed = Event()

    def read(self) -> CameraFrame | None:
        """Next frame when due, None at the end."""
        if self._start is None:
            self._start = time.perf_counter()
        if self._next >= len(self._times):
            return None
        early = self._start + self._times[self._next] - time.perf_counter()
        if self._closed.wait(max(0.0, early)):
            return None
        elapsed = time.perf_counter() - self._start
        latest = int(np.searchsorted(self._times, elapsed, side="right")) - 1
        number = max(self._next, min(latest, int(np.searchsorted(self._times, elapsed - MAX_WAIT))))
        self._next = number + 1
        return CameraFrame(number, self._frame(number), self._start + float(self._times[number]))

    def preview(self, count: int) -> "list[Frame]":
        """First frames; the replay begins later."""
        frames = [self._frame(number) for number in range(min(count, len(self._times)))]
        return [frame for frame in frames if not isinstance(frame, FrameError)]

    def mask(self, index: int) -> "NDArray[np.bool_] | None":
        """True dynamic mask (H, W) of a frame if the recording has it."""
        return self._sequence.mask(index)

    def close(self) -> None:
        """End the replay."""
        self._closed.set()

    def _frame(self, number: int) -> "Frame | FrameError":
        try:
            return self._sequence[number]
        except FrameError as error:
            return error
