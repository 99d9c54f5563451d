"""Frames and masks of a recording, read ahead, or of a camera as they arrive."""

import threading
import time
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.frame import Frame
from dudmap.errors import ConfigError, FrameError
from dudmap.io.cameras import MAX_WAIT
from dudmap.io.sequences import read_frame
from dudmap.io.sequences.masks import MaskFolder

if TYPE_CHECKING:
    from dudmap.core.slam import Slam
    from dudmap.core.tracking.frame_view import FrameView
    from dudmap.io.cameras import LiveCamera
    from dudmap.io.cameras.recorder import Recorder
    from dudmap.io.sequences import Sequence

AHEAD = 4
"""Frames read ahead."""
MAX_DELAY = 1.0
"""Longest time for which frames of a camera wait at the start and after a long frame, seconds: the first frames of a
map take longest, and a gap of this length loses the camera."""
CATCH_UP = 0.05
"""Decrease of this time, seconds per second: it drops at most every twentieth frame."""


class FrameRead(NamedTuple):
    """Result of reading one frame; an unreadable image is replaced by its error.

    Attributes:
        true_mask: (H, W) true dynamic mask, None if unknown.
        ms: Reading time of the frame, milliseconds; 0 for a camera.
        given_mask: (H, W) external dynamic mask, or None.
    """

    frame: Frame | FrameError
    true_mask: NDArray[np.bool_] | FrameError | None
    ms: float
    given_mask: NDArray[np.bool_] | FrameError | None = None
    prepared: "FrameView | None" = None


class SourceFrame(NamedTuple):
    """Next frame to process.

    Attributes:
        number: Number of the frame in the recording.
        arrival: In a live run, seconds of ``time.perf_counter``; else 0.
    """

    number: int
    read: FrameRead
    dropped: int = 0
    arrival: float = 0.0


def read_ahead(
    sequence: "Sequence",
    count: int,
    ahead: int = AHEAD,
    masks: "MaskFolder | None" = None,
    slam: "Slam | None" = None,
    start: int = 0,
) -> Generator[SourceFrame]:
    """Yield frames ``start`` to ``count`` - 1 in order. One thread reads, and with ``slam`` prepares, up to ``ahead``
    frames ahead."""

    def read(index: int) -> SourceFrame:
        begin = time.perf_counter()
        try:
            frame: Frame | FrameError = read_frame(sequence, index)
        except FrameError as error:
            frame = error
        ms = 1000 * (time.perf_counter() - begin)
        return SourceFrame(index, _with_masks(frame, index, sequence, masks, slam if ahead else None, ms))

    reader = ThreadPoolExecutor(1, thread_name_prefix="dudmap-reader")
    pending: deque[Future[SourceFrame]] = deque()
    try:
        for index in range(start, count + ahead):
            if index < count:
                pending.append(reader.submit(read, index))
            if index >= start + ahead:
                yield pending.popleft().result()
    finally:
        reader.shutdown(cancel_futures=True)


class FrameQueue:
    """Thread-safe queue between a camera and its consumer: the newest item, and items at most some time older.

    The time is ``MAX_WAIT``. It is ``MAX_DELAY`` at the start, and rises to the time between two ``take`` if the frame
    in between took longer; then it falls by ``CATCH_UP`` per second. So a single long frame drops none.
    """

    def __init__(self) -> None:
        self._peak, self._since, self._taken = MAX_DELAY, time.perf_counter(), np.inf
        self._changed = threading.Condition()
        self._held: list[SourceFrame] = []
        self._closed = False

    @property
    def is_empty(self) -> bool:
        """Whether no item waits."""
        return not self._held

    def put(self, item: SourceFrame) -> None:
        """Store a newer item; never blocks."""
        with self._changed:
            longest, _ = self._longest_wait()
            self._held = [held for held in self._held if item.arrival - held.arrival <= longest] + [item]
            self._changed.notify()

    def take(self) -> SourceFrame | None:
        """Take the oldest item, or wait for one. None once the queue is closed and empty."""
        with self._changed:
            self._peak, self._since = self._longest_wait()
            self._changed.wait_for(lambda: self._held or self._closed)
            self._taken = time.perf_counter()
            return self._held.pop(0) if self._held else None

    def _longest_wait(self) -> tuple[float, float]:
        """Longest time that an item waits now, and the present time, seconds."""
        now = time.perf_counter()
        return max(MAX_WAIT, self._peak - CATCH_UP * (now - self._since), min(now - self._taken, MAX_DELAY)), now

    def close(self) -> None:
        """Declare the end of the stream."""
        with self._changed:
            self._closed = True
            self._changed.notify()


def arriving(
    camera: "LiveCamera",
    slam: "Slam | None" = None,
    masks: "MaskFolder | None" = None,
    recorder: "Recorder | None" = None,
    idle: Callable[[], bool] = lambda: False,
) -> Generator[SourceFrame]:
    """Yield frames of a camera, taken and prepared in a thread; close the camera at the end.

    The ``recorder`` receives all frames; the queue drops and counts frames without room. ``idle`` is called while no
    frame waits: a few milliseconds of work and True, or none.

    Raises:
        CameraError: The camera stopped to deliver frames.
    """
    queue, stopping, last = FrameQueue(), threading.Event(), -1

    def deliver() -> None:
        first, latest = None, -np.inf
        try:
            while not stopping.is_set() and (arrived := camera.read()) is not None:
                first = arrived.number if first is None else first
                if isinstance(arrived.frame, Frame):
                    if arrived.frame.timestamp <= latest:  # a driver may deliver a depth image twice
                        continue
                    latest = arrived.frame.timestamp
                    frame = arrived.frame.copy()  # a driver may fill the same images again
                    arrived = arrived._replace(frame=frame)
                    if recorder is not None:
                        recorder.put(frame)
                read = _with_masks(arrived.frame, arrived.number, camera, masks, slam)
                queue.put(SourceFrame(arrived.number - first, read, arrival=arrived.time))
        finally:
            queue.close()

    with ThreadPoolExecutor(1, thread_name_prefix="dudmap-camera") as thread:
        future = thread.submit(deliver)
        try:
            while True:
                while queue.is_empty and idle():
                    pass
                if (frame := queue.take()) is None:
                    break
                yield frame._replace(dropped=frame.number - last - 1)
                last = frame.number
            future.result()
        finally:
            stopping.set()
            camera.close()


def open_masks(folder: str | Path | None, sequence: "Sequence | LiveCamera") -> "MaskFolder | None":
    """The external masks of a run, if there are any."""
    if folder is None:
        return None
    times = getattr(sequence, "timestamps", None)
    if times is None:
        raise ConfigError("masks belong to the frames of a recording; a camera has none")
    return MaskFolder(folder, times, sequence.camera, getattr(sequence, "image_files", ()))


def _with_masks(
    frame: Frame | FrameError,
    index: int,
    source: "Sequence | LiveCamera",
    masks: "MaskFolder | None",
    slam: "Slam | None",
    ms: float = 0.0,
) -> FrameRead:
    try:
        view = None if slam is None or isinstance(frame, FrameError) else slam.prepare(frame)
    except FrameError as error:
        frame, view = error, None
    if isinstance(frame, FrameError):
        return FrameRead(frame, None, ms)
    given = masks and _or_error(masks.__getitem__, index)
    return FrameRead(frame, _or_error(source.mask, index), ms, given, view)


def _or_error(read: Callable[[int], NDArray[np.bool_] | None], index: int) -> NDArray[np.bool_] | FrameError | None:
    try:
        mask = read(index)
        return None if mask is None else mask.copy()
    except FrameError as error:
        return error
