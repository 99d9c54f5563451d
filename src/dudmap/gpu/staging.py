"""Ways of images between the host and a device, and arrays on the device that are used again."""

# Warp's annotations name float where any type of number is meant
# pyright: reportArgumentType=false, reportReturnType=false

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from dudmap.gpu.streams import Queue

BUFFERS = 2
"""Buffers of the host for one kind of image: one that the device reads, one that the host fills meanwhile."""
KINDS = 32
"""Kinds of images, by direction, shape and type, that have buffers."""
WARP_TYPES = {
    np.dtype(np.float32): wp.float32, np.dtype(np.float64): wp.float64, np.dtype(np.int32): wp.int32,
    np.dtype(np.int64): wp.int64, np.dtype(np.int16): wp.int16, np.dtype(np.uint8): wp.uint8,
}  # fmt: skip
NUMPY_TYPES = {one: other for other, one in WARP_TYPES.items()}


@dataclass
class _Buffer:
    """An array of the host, pinned for a GPU, and the mark after its last copy."""

    array: Any
    words: NDArray
    copied: Any = None


class Staging:
    """Copies of images between the host and a device, through pinned buffers, so that they run beside the program.

    A buffer is used again when its last copy is done, and the buffers of the kind that was not used for longest are
    given up for those of a new one beyond ``KINDS``. Not for concurrent calls.

    Args:
        queue: Where the copies are made.
    """

    def __init__(self, queue: Queue) -> None:
        self._queue = queue
        self._rings: dict[tuple[Any, ...], deque[_Buffer]] = {}

    def upload(self, array: NDArray, target: Any) -> None:  # noqa: ANN401 - an array of Warp
        """Copy an array to the device; it may be changed when this returns."""
        buffer = self._next("up", array.shape, array.dtype)
        buffer.words[...] = array
        self._queue.copy(target, buffer.array)
        buffer.copied = self._queue.record(buffer.copied)

    def download(self, source: Any) -> NDArray:  # noqa: ANN401 - an array of Warp
        """A copy of an array of the device, which is waited for."""
        return self.download_all([source])[0]

    def download_all(self, sources: Sequence[Any]) -> list[NDArray]:
        """Copies of arrays of the device, which are waited for together; at most BUFFERS of one kind."""
        buffers: list[_Buffer] = []
        for source in sources:
            buffer = self._next("down", source.shape, NUMPY_TYPES[source.dtype])
            if any(other is buffer for other in buffers):
                raise ValueError(f"there are more than {BUFFERS} arrays of one kind to download at once")
            self._queue.copy(buffer.array, source)
            buffer.copied = self._queue.record(buffer.copied)
            buffers.append(buffer)
        for buffer in buffers:
            self._finish(buffer)
        return [buffer.words.copy() for buffer in buffers]

    def _next(self, way: str, shape: tuple[int, ...], dtype: np.dtype) -> _Buffer:
        """The next buffer of a kind, whose last copy is done."""
        key = way, shape, dtype
        ring = self._rings.pop(key, None) or deque(self._buffer(shape, dtype) for _ in range(BUFFERS))
        self._rings[key] = ring
        if len(self._rings) > KINDS:
            for given_up in self._rings.pop(next(iter(self._rings))):
                self._finish(given_up)
        ring.rotate()
        self._finish(ring[0])
        return ring[0]

    def _finish(self, buffer: _Buffer) -> None:
        if buffer.copied is not None:
            self._queue.finish(buffer.copied)

    def _buffer(self, shape: tuple[int, ...], dtype: np.dtype) -> _Buffer:
        array = wp.empty(shape, dtype=WARP_TYPES[dtype], device="cpu", pinned=self._queue.is_pinned)
        return _Buffer(array, array.numpy())


class ImagePool:
    """Arrays on a device for images of a queue of its own, given back when nothing refers to an image any more.

    Memory that Warp allocates may still be in use by the main queue; a queue of its own must wait for that one before
    it writes to it. An array that was given back is written to again when the main queue has done all that it had to do
    when that was noticed, which is long past when the longest unused one is taken.

    Args:
        queue: The queue that writes the images.
        main: The main queue, which reads them.
    """

    def __init__(self, queue: Queue, main: Queue) -> None:
        self._queue, self._main = queue, main
        self._returned: deque[Any] = deque()
        self._resting: dict[tuple[Any, ...], deque[tuple[Any, Any]]] = {}

    def take(self, shape: tuple[int, ...], dtype: Any = wp.float32) -> Any:  # noqa: ANN401
        """An array for the queue to write to."""
        self._rest()
        resting = self._resting.get((*shape, dtype))
        if resting:
            array, unused = resting.popleft()
        else:
            array = wp.empty(shape, dtype=dtype, device=self._queue.device)
            unused = self._main.record()
        self._queue.wait(unused)
        return array

    def give_back(self, array: Any) -> None:  # noqa: ANN401
        """Nothing refers to the array any more. May be called from any thread, also by the garbage collector."""
        self._returned.append(array)

    def _rest(self) -> None:
        unused = self._main.record() if self._returned else None
        for _ in range(len(self._returned)):
            array = self._returned.popleft()
            self._resting.setdefault((*array.shape, array.dtype), deque()).append((array, unused))
