"""Order of work on a device: the streams of a GPU, and the CPU device of Warp, which works everything off at once.

Everything that goes to a device in an order other than that of the program goes through a queue. Four traps of Warp are
avoided here: the current stream of a device belongs to the process and not to the thread, so that ``wp.ScopedStream``
in one thread redirects the others; ``array.numpy()`` uses it; errors of recording an event and of waiting for one are
printed, not raised, where no context is current in the thread; and waiting for an event fails while any thread captures
a graph.
"""

# Warp's annotations name float where any type of number is meant
# pyright: reportArgumentType=false, reportReturnType=false

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray


class Queue(Protocol):
    """Work that a device does in the order in which it is given.

    Attributes:
        device: Name of the device in Warp.
        is_pinned: Whether copies run beside the program, which needs pinned memory of the host.
    """

    device: str
    is_pinned: bool

    def launch(self, kernel: Any, dim: Any, *arguments: Any) -> None:  # noqa: ANN401
        """Run a kernel; without threads nothing happens."""
        ...

    def repeat(self, command: Any) -> None:  # noqa: ANN401
        """Run a recorded launch."""
        ...

    def copy(self, target: Any, source: Any) -> None:  # noqa: ANN401
        """Copy an array of Warp; on a GPU the source, if it is pinned, must stay as it is until then."""
        ...

    def record(self, event: Any = None) -> Any:  # noqa: ANN401
        """A mark, made anew or moved, that is reached when the work given so far is done."""
        ...

    def wait(self, event: Any) -> None:  # noqa: ANN401
        """Let the work that follows begin when a mark, of any queue, is reached; the program does not wait."""
        ...

    def finish(self, event: Any) -> None:  # noqa: ANN401
        """Wait until a mark is reached."""
        ...

    def captured(self, commands: list[Any]) -> Any:  # noqa: ANN401
        """A graph of recorded launches, ready to be replayed; they may run once meanwhile.

        Raises:
            RuntimeError: The device refuses.
        """
        ...

    def replay(self, graph: Any) -> None:  # noqa: ANN401
        """Run a graph."""
        ...

    def download(self, array: Any) -> NDArray:  # noqa: ANN401
        """A copy in the host's memory, of an array as it is after the work given so far."""
        ...


class HostQueue:
    """``Queue`` of the CPU device of Warp, where each call returns when the work is done; a mark is None."""

    is_pinned = False

    def __init__(self, device: str) -> None:
        self.device = device

    def launch(self, kernel: Any, dim: Any, *arguments: Any) -> None:  # noqa: ANN401
        """See ``Queue.launch``."""
        if np.prod(dim) > 0:
            wp.launch(kernel, dim=dim, inputs=list(arguments), device=self.device)

    def repeat(self, command: Any) -> None:  # noqa: ANN401
        """See ``Queue.repeat``."""
        command.launch()

    def copy(self, target: Any, source: Any) -> None:  # noqa: ANN401
        """See ``Queue.copy``."""
        wp.copy(target, source)

    def record(self, event: Any = None) -> Any:  # noqa: ANN401
        """See ``Queue.record``."""
        return event

    def wait(self, event: Any) -> None:  # noqa: ANN401
        """See ``Queue.wait``."""

    def finish(self, event: Any) -> None:  # noqa: ANN401
        """See ``Queue.finish``."""

    def captured(self, commands: list[Any]) -> Any:  # noqa: ANN401
        """See ``Queue.captured``."""
        with wp.ScopedCapture(device=self.device) as capture:
            for command in commands:
                command.launch()
        return capture.graph

    def replay(self, graph: Any) -> None:  # noqa: ANN401
        """See ``Queue.replay``."""
        wp.capture_launch(graph)

    def download(self, array: Any) -> NDArray:  # noqa: ANN401
        """See ``Queue.download``."""
        return array.numpy().copy()  # NumPy and Warp would share the memory


class StreamQueue:
    """``Queue`` of a GPU: one of its streams.

    Args:
        device: Name of the device in Warp.
        stream: The stream.
    """

    is_pinned = True

    def __init__(self, device: str, stream: Any) -> None:  # noqa: ANN401
        self.device, self.stream = device, stream

    def launch(self, kernel: Any, dim: Any, *arguments: Any) -> None:  # noqa: ANN401
        """See ``Queue.launch``."""
        if np.prod(dim) > 0:
            wp.launch(kernel, dim=dim, inputs=list(arguments), stream=self.stream)

    def repeat(self, command: Any) -> None:  # noqa: ANN401
        """See ``Queue.repeat``."""
        command.launch(stream=self.stream)

    def copy(self, target: Any, source: Any) -> None:  # noqa: ANN401
        """See ``Queue.copy``."""
        wp.copy(target, source, stream=self.stream)

    def record(self, event: Any = None) -> Any:  # noqa: ANN401
        """See ``Queue.record``."""
        self._enter()
        return self.stream.record_event(event)

    def wait(self, event: Any) -> None:  # noqa: ANN401
        """See ``Queue.wait``."""
        self._enter()
        self.stream.wait_event(event)

    def finish(self, event: Any) -> None:  # noqa: ANN401
        """See ``Queue.finish``."""
        wp.synchronize_event(event)

    def captured(self, commands: list[Any]) -> Any:  # noqa: ANN401
        """See ``Queue.captured``. The stream of the capture is used for nothing else, and the first replay, which
        makes the graph executable, is done here."""
        with wp.ScopedCapture(stream=wp.Stream(self.device)) as capture:
            for command in commands:
                command.launch(stream=capture.stream)
        self.replay(capture.graph)
        return capture.graph

    def replay(self, graph: Any) -> None:  # noqa: ANN401
        """See ``Queue.replay``."""
        wp.capture_launch(graph, stream=self.stream)

    def download(self, array: Any) -> NDArray:  # noqa: ANN401
        """See ``Queue.download``."""
        host = wp.empty(array.shape, dtype=array.dtype, device="cpu")
        self.copy(host, array)
        self.finish(self.record())
        return host.numpy()

    def _enter(self) -> None:
        """Make the device's context that of the thread: what has no context fails without an exception."""
        wp.get_device(self.device).make_current()


def main_queue(device: str) -> Queue:
    """Where Warp puts what is given no stream: launches, allocations, uploads of ``wp.array``."""
    return HostQueue(device) if device == "cpu" else StreamQueue(device, wp.get_stream(device))


def own_queue(device: str) -> Queue:
    """A new queue, whose work may run beside that of the others."""
    return HostQueue(device) if device == "cpu" else StreamQueue(device, wp.Stream(device))


class CaptureGate:
    """Lets a graph be captured only while no other thread uses the device, since both could fail."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._users: list[int] = []
        self._capturing = False

    @contextmanager
    def use(self) -> Iterator[None]:
        """Use the device within the block; one that captures is waited for."""
        with self._changed:
            self._changed.wait_for(lambda: not self._capturing)
            self._users.append(threading.get_ident())
        try:
            yield
        finally:
            with self._changed:
                self._users.remove(threading.get_ident())

    @contextmanager
    def capture(self) -> Iterator[bool]:
        """Whether this thread may capture within the block; not while another one uses the device."""
        own = threading.get_ident()
        with self._changed:
            free = not self._capturing and all(user == own for user in self._users)
            self._capturing = self._capturing or free
        try:
            yield free
        finally:
            if free:
                with self._changed:
                    self._capturing = False
                    self._changed.notify_all()


_gates: dict[str, CaptureGate] = {}


def gate(device: str) -> CaptureGate:
    """The gate of a device."""
    return _gates.setdefault(device, CaptureGate())
