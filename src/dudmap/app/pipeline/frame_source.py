"""Frames and masks of a recording, read ahead in order."""

import time
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.frame import Frame
from dudmap.errors import FrameError

if TYPE_CHECKING:
    from dudmap.core.slam import Slam
    from dudmap.core.tracking.frame_view import FrameView
    from dudmap.io.sequences import Sequence
    from dudmap.io.sequences.images import MaskFolder

AHEAD = 4
"""Number of frames of a recording on disk that are read ahead of the processed one."""


class FrameRead(NamedTuple):
    """Result of reading one frame; an image that cannot be read is replaced by its error.

    Attributes:
        frame: The frame.
        true_mask: (H, W) true dynamic mask, None if unknown.
        ms: Reading time of the frame, milliseconds.
        given_mask: (H, W) external dynamic mask, None if there is none.
        prepared: The preprocessed frame, None unless the reader prepares frames.
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
        read: Result of reading it.
        dropped: Number of frames dropped since the previous one.
        arrival: Time of arrival in a live run, seconds of ``time.perf_counter``; 0 otherwise.
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
) -> "Generator[FrameRead]":
    """Frames ``start`` to ``count`` - 1 in order; one thread reads and prepares them, up to ``ahead`` frames ahead."""
    reader = ThreadPoolExecutor(1, thread_name_prefix="dudmap-reader")
    pending: deque[Future[FrameRead]] = deque()
    try:
        for index in range(start, count + ahead):
            if index < count:
                pending.append(reader.submit(read_frame, sequence, index, masks, slam))
            if index >= start + ahead:
                yield pending.popleft().result()
    finally:
        reader.shutdown(cancel_futures=True)


def in_order(
    sequence: "Sequence", count: int, ahead: int, masks: "MaskFolder | None", slam: "Slam", start: int = 0
) -> "Generator[SourceFrame]":
    """Frames of a recording in order, from number ``start`` on; none is dropped."""
    frames = read_ahead(sequence, count, ahead, masks, slam if ahead else None, start)
    for index, read in enumerate(frames, start):
        yield SourceFrame(index, read)


def load_kernels(slam: "Slam", sequence: "Sequence", count: int) -> None:
    """Compile or load all kernels by processing the first frames with a system that is discarded afterwards."""
    for index in range(min(count, 3)):
        frame = read_frame(sequence, index).frame
        if not isinstance(frame, FrameError):
            slam.process(frame)


def prepared(frame: Frame | FrameError, slam: "Slam | None", ms: float = 0.0) -> FrameRead:
    """A frame that took ``ms`` milliseconds to read, prepared for processing where there is a system."""
    try:
        view = None if slam is None or isinstance(frame, FrameError) else slam.prepare(frame)
    except FrameError as error:
        return FrameRead(error, None, ms)
    return FrameRead(frame, None, ms, prepared=view)


def read_frame(
    sequence: "Sequence", index: int, masks: "MaskFolder | None" = None, slam: "Slam | None" = None
) -> FrameRead:
    """A frame of a recording with its masks, prepared for processing where there is a system."""
    start = time.perf_counter()
    try:
        frame: Frame | FrameError = sequence[index]
    except FrameError as error:
        return FrameRead(error, None, 1000 * (time.perf_counter() - start))
    read = prepared(frame, slam, 1000 * (time.perf_counter() - start))
    return read._replace(
        true_mask=_or_error(sequence.mask, index), given_mask=masks and _or_error(masks.__getitem__, index)
    )


def _or_error(read: Callable[[int], NDArray[np.bool_] | None], index: int) -> NDArray[np.bool_] | FrameError | None:
    try:
        return read(index)
    except FrameError as error:
        return error
