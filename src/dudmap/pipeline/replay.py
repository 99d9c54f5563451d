"""Frames at the sensor's rate: the newest is taken, those there is no time for are dropped."""

import threading
import time
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")


class Arrival(NamedTuple, Generic[T]):
    """A frame that has arrived.

    Attributes:
        number: Its number in the stream.
        item: What was read.
        time: When it arrived, seconds of ``time.perf_counter``.
    """

    number: int
    item: T
    time: float


class Newest(Generic[T]):
    """Room for one thing between a sensor and its consumer: what is put replaces what was not taken.

    Nothing ever queues, so the consumer is never further behind than the one thing it works on.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._held: list[T] = []
        self._closed = False

    def put(self, item: T) -> None:
        """Offer a newer thing; never blocks."""
        with self._changed:
            self._held = [item]
            self._changed.notify()

    def take(self) -> T | None:
        """The newest thing; waits if there is none since the last call, None once closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._held or self._closed)
            return self._held.pop() if self._held else None

    def close(self) -> None:
        """Nothing more will come; what is there can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify()


def replay(
    timestamps: NDArray[np.float64],
    read: Callable[[int], T],
    put: Callable[[Arrival[T]], None],
    wait: Callable[[float], bool],
    now: Callable[[], float] = time.perf_counter,
) -> None:
    """Offer the frames of a recording when a sensor would: the first one now, the others as their times tell.

    Frames that arrive while an earlier one is still being read are dropped unread, except the newest of them.

    Args:
        timestamps: (N,) seconds, increasing.
        read: Gives frame number ``index``.
        put: Takes each frame.
        wait: Waits for so many seconds, or less; True ends the replay.
        now: The clock, seconds.
    """
    start = now() - timestamps[0]
    index = 0
    while index < len(timestamps):
        while (early := start + timestamps[index] - now()) > 0:
            if wait(early):
                return
        index = max(index, int(np.searchsorted(timestamps, now() - start, side="right")) - 1)
        put(Arrival(index, read(index), start + timestamps[index]))
        index += 1


def live(timestamps: NDArray[np.float64], read: Callable[[int], T]) -> Generator[Arrival[T]]:
    """The frames of a recording at the sensor's rate; each step gives the newest that has arrived.

    A frame that is not taken before the next one has been read is dropped: a gap in ``Arrival.number``. The last frame
    is always given.
    """
    newest: Newest[Arrival[T]] = Newest()
    stop = threading.Event()

    def sensor() -> None:
        try:
            replay(timestamps, read, newest.put, stop.wait)
        finally:
            newest.close()

    with ThreadPoolExecutor(1, thread_name_prefix="dudmap-sensor") as thread:
        future = thread.submit(sensor)
        try:
            while (arrival := newest.take()) is not None:
                yield arrival
            future.result()
        finally:
            stop.set()
