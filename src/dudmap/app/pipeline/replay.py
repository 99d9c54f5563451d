"""Frames of a sensor or of a replay at its rate; frames are dropped where processing is too slow."""

import threading
import time
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from dudmap.app.pipeline.frame_source import FrameRead, SourceFrame

MAX_WAIT = 0.1
"""Time for which a frame may wait for its processing, seconds: at 30 Hz one that takes three times as long as usual
delays the next ones and drops none, and nothing is processed that is much older."""


class FrameQueue:
    """Thread-safe queue between a sensor and its consumer: of the newest item and those at most ``MAX_WAIT`` older."""

    def __init__(self) -> None:
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
            self._held = [held for held in self._held if item.arrival - held.arrival <= MAX_WAIT] + [item]
            self._changed.notify()

    def take(self) -> SourceFrame | None:
        """Oldest item; waits for one that was not taken yet. None once the queue is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._held or self._closed)
            return self._held.pop(0) if self._held else None

    def close(self) -> None:
        """Declare the end of the stream; stored items can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify()


def replay(
    timestamps: NDArray[np.float64],
    read: Callable[[int], FrameRead],
    put: Callable[[SourceFrame], None],
    wait: Callable[[float], bool],
    now: Callable[[], float] = time.perf_counter,
) -> None:
    """Deliver the frames of a recording in real time: the first one now, the others at their timestamps.

    Of the frames that become due while an earlier one is read, the latest and those due since ``MAX_WAIT`` are read;
    the others are dropped.

    Args:
        timestamps: (N,) increasing timestamps, seconds.
        read: Reads the frame of the given number.
        put: Receives each frame.
        wait: Waits for at most the given number of seconds; returns True to stop the replay.
        now: Clock, seconds.
    """
    start = now() - timestamps[0]
    index = 0
    while index < len(timestamps):
        while (early := start + timestamps[index] - now()) > 0:
            if wait(early):
                return
        elapsed = now() - start
        latest = int(np.searchsorted(timestamps, elapsed, side="right")) - 1
        index = max(index, min(latest, int(np.searchsorted(timestamps, elapsed - MAX_WAIT))))
        put(SourceFrame(index, read(index), arrival=start + timestamps[index]))
        index += 1


def in_real_time(
    timestamps: NDArray[np.float64], read: Callable[[int], FrameRead], idle: Callable[[], bool] = lambda: False
) -> Generator[SourceFrame]:
    """Replay a recording in real time; each step yields the next frame that has arrived.

    Frames for which the consumer leaves no room are dropped and counted in ``SourceFrame.dropped``. The last frame is
    always yielded. For ``idle`` see ``arrivals``.
    """
    return arrivals(lambda put, wait: replay(timestamps, read, put, wait), idle=idle)


def arrivals(
    deliver: Callable[[Callable[[SourceFrame], None], Callable[[float], bool]], None],
    stop: Callable[[], None] | None = None,
    idle: Callable[[], bool] = lambda: False,
) -> Generator[SourceFrame]:
    """Items that a sensor delivers; those for which the consumer leaves no room (``FrameQueue``) are dropped.

    Args:
        deliver: Runs in a thread of its own and passes every item to its first argument. Its second argument waits for
            at most the given number of seconds and returns True to stop.
        stop: Called when the consumer stops, so that ``deliver`` does not wait for another item.
        idle: Called while no item waits; does a few milliseconds of other work and returns True, or has none.
    """
    queue: FrameQueue = FrameQueue()
    stopping, last = threading.Event(), -1

    def sensor() -> None:
        try:
            deliver(queue.put, stopping.wait)
        finally:
            queue.close()

    with ThreadPoolExecutor(1, thread_name_prefix="dudmap-sensor") as thread:
        future = thread.submit(sensor)
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
            if stop is not None:
                stop()
