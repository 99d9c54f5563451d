"""Work for a frame that no later frame waits for."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

WAITING = 2
"""Jobs that wait at most: each holds the images of a frame."""


class Background:
    """Does jobs in another thread, in the order in which they are given; an error of one is raised by a later call."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="dudmap-background")
        self._jobs: deque[Future[None]] = deque()

    def __enter__(self) -> "Background":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, traceback: TracebackType | None) -> None:
        try:
            if kind is None:
                self.wait()
        finally:
            self._thread.shutdown()

    def do(self, job: Callable[[], None]) -> None:
        """Have a job done, as soon as no more than ``WAITING`` others are left."""
        self.wait(WAITING)
        self._jobs.append(self._thread.submit(job))

    def wait(self, left: int = 0) -> None:
        """Wait until so many jobs are left at most."""
        while len(self._jobs) > left:
            self._jobs.popleft().result()
