"""Launches that are repeated in one order: a graph on a GPU, where it captures one."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from dudmap.gpu import faults
from dudmap.gpu.streams import Queue, gate

_refusing: set[str] = set()
"""Devices that have refused to capture a graph."""
_wanted = [True]
"""Whether graphs are used, as the innermost block says."""


@contextmanager
def one_by_one() -> Iterator[None]:
    """Within the block the launches of graphs are made one by one, so that each kernel can be measured."""
    _wanted.append(False)
    try:
        yield
    finally:
        _wanted.pop()


class Sequence:
    """Recorded launches, none of which allocates, or depends on a number that the host reads in between.

    The graph is captured when they are repeated first: many maps are registered to once only. A device that captures no
    graph, though it works, gets the launches one by one, and that is told.

    Args:
        queue: Where they are launched.
        commands: The launches, whose arguments stay as they are.
        as_graph: Whether a graph is wanted; on the CPU device launches one by one are as fast.
    """

    def __init__(self, queue: Queue, commands: list[Any], as_graph: bool | None = None) -> None:
        self._queue, self._commands = queue, commands
        self._as_graph = queue.is_pinned if as_graph is None else as_graph
        self._graph: Any = None
        self._was_run = False

    @property
    def is_graph(self) -> bool:
        """Whether the launches are a graph by now."""
        return self._graph is not None

    def prepare(self) -> None:
        """Capture the graph, if it is time and no other thread uses the device. The launches may run once meanwhile."""
        wanted = self._as_graph and self._was_run and _wanted[-1] and self._queue.device not in _refusing
        if not wanted or self.is_graph:
            return
        with gate(self._queue.device).capture() as is_alone:
            if is_alone:
                try:
                    self._graph = self._queue.captured(self._commands)
                except RuntimeError as error:
                    self._refuse(error)

    def run(self) -> None:
        """Launch everything in order."""
        self._was_run = True
        if self._graph is None or not _wanted[-1]:
            for command in self._commands:
                self._queue.repeat(command)
        else:
            self._queue.replay(self._graph)

    def _refuse(self, error: RuntimeError) -> None:
        device = self._queue.device
        _refusing.add(device)
        reason = " ".join(str(error).split())
        faults.tell(f"{device} captures no graph ({reason}); its kernels are launched one by one, which takes longer")
