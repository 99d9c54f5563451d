"""Frames and masks on their way into the system, read ahead or as they arrive."""

import time
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import FrameError
from dudmap.frames.frame import Frame

if TYPE_CHECKING:
    from dudmap.sequences import Sequence
    from dudmap.sequences.masks import MaskFolder
    from dudmap.slam import Slam
    from dudmap.tracking.frame_view import FrameView

AHEAD = 4
"""Frames of a recording on disk that are read while an earlier one is processed."""


class Reading(NamedTuple):
    """What the reader found.

    Attributes:
        frame: The frame, or why there is none.
        mask: (H, W) its true dynamic mask, None if not known, or why it cannot be read.
        ms: Reading time of the frame.
        known: (H, W) what a mask from outside says moves, None if there is none, or why it cannot be read.
        prepared: The frame as the system takes it, where it was made ready ahead.
    """

    frame: Frame | FrameError
    mask: NDArray[np.bool_] | FrameError | None
    ms: float
    known: NDArray[np.bool_] | FrameError | None = None
    prepared: "FrameView | None" = None


class Turn(NamedTuple):
    """A frame whose turn it is.

    Attributes:
        number: Its number.
        reading: What was read.
        dropped: Frames that were dropped since the one before.
        arrival: When it arrived, seconds of ``time.perf_counter``; None where frames wait for the system.
    """

    number: int
    reading: Reading
    dropped: int = 0
    arrival: float | None = None


def read_ahead(
    sequence: "Sequence", count: int, ahead: int = AHEAD, known: "MaskFolder | None" = None, slam: "Slam | None" = None
) -> "Generator[Reading]":
    """The first ``count`` frames in order, read and made ready for ``slam`` by one thread up to ``ahead`` ahead."""
    reader = ThreadPoolExecutor(1, thread_name_prefix="dudmap-reader")
    pending: deque[Future[Reading]] = deque()
    try:
        for index in range(count + ahead):
            if index < count:
                pending.append(reader.submit(_read, sequence, index, known, slam))
            if index >= ahead:
                yield pending.popleft().result()
    finally:
        reader.shutdown(cancel_futures=True)


def in_order(
    sequence: "Sequence", count: int, ahead: int, known: "MaskFolder | None", slam: "Slam"
) -> "Generator[Turn]":
    """Frames that wait for the system."""
    for index, reading in enumerate(read_ahead(sequence, count, ahead, known, slam if ahead else None)):
        yield Turn(index, reading)


def as_they_come(sequence: "Sequence", count: int, known: "MaskFolder | None") -> "Generator[Turn]":
    """Frames that arrive as their times tell; of those that have, the newest."""
    from dudmap.pipeline.replay import live

    last = -1
    with closing(live(sequence.timestamps[:count], lambda index: _read(sequence, index, known))) as arrivals:
        for arrival in arrivals:
            yield Turn(arrival.number, arrival.item, arrival.number - last - 1, arrival.time)
            last = arrival.number


def load_kernels(slam: "Slam", sequence: "Sequence", count: int) -> None:
    """Run the first frames through a system that is thrown away: a sensor is switched on when all is compiled."""
    for index in range(min(count, 3)):
        frame = _read(sequence, index).frame
        if not isinstance(frame, FrameError):
            slam.process(frame)


def _read(sequence: "Sequence", index: int, masks: "MaskFolder | None" = None, slam: "Slam | None" = None) -> Reading:
    start = time.perf_counter()
    try:
        frame: Frame | FrameError = sequence[index]
    except FrameError as error:
        return Reading(error, None, 1000 * (time.perf_counter() - start))
    ms = 1000 * (time.perf_counter() - start)
    prepared = None if slam is None else slam.prepare(frame)
    return Reading(frame, _or_error(sequence.mask, index), ms, masks and _or_error(masks.__getitem__, index), prepared)


def _or_error(read: Callable[[int], NDArray[np.bool_] | None], index: int) -> NDArray[np.bool_] | FrameError | None:
    try:
        return read(index)
    except FrameError as error:
        return error
