"""Work that no later frame waits for."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

from dudmap.core.objects.moving_objects import MOST_WAITING

WAITING = 2
"""Waiting jobs; each holds a frame's images."""
POSTPONED = MOST_WAITING
"""Jobs that wait for an idle moment: one second; live runs then discard older moving objects."""


class Background:
    """Does jobs in order in another thread; a later call raises a job's error. ``postponed`` jobs wait until the caller
    is idle."""

    def __init__(self, *, postponed: bool = False) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="dudmap-background")
        self._jobs: deque[Future[None]] = deque()
        self._postponed: deque[Callable[[], None]] | None = deque() if postponed else None

    def __enter__(self) -> "Background":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self.wait()
        except Exception as of_job:
            if error is None:
                raise
            error.add_note(f"background work for the frames failed, too: {of_job!r}")
        finally:
            self._thread.shutdown()

    def do(self, job: Callable[[], None]) -> None:
        """Add a job once at most ``WAITING`` (``POSTPONED``) others are left."""
        if self._postponed is None:
            self.wait(WAITING)
            self._jobs.append(self._thread.submit(job))
        else:
            self.wait(POSTPONED)
            self._postponed.append(job)

    def next(self) -> bool:
        """Do the first postponed job in this thread; return whether there was one."""
        if self._postponed:
            self._postponed.popleft()()
            return True
        return False

    def wait(self, left: int = 0) -> None:
        """Wait until at most ``left`` jobs are left, or do them."""
        while len(self._jobs) > left:
            self._jobs.popleft().result()
        while self._postponed and len(self._postponed) > left:
            self.next()
