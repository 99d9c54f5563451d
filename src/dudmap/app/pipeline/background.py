"""Work for a frame that no later frame waits for."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

from dudmap.core.objects.moving_objects import MOST_WAITING

WAITING = 2
"""Jobs that wait at most for the other thread: each holds the images of a frame."""
POSTPONED = MOST_WAITING
"""Jobs that wait at most for an idle moment: those of a second. A live run without idle moments so gives up the moving
objects of its older frames (``MovingObjects``), not frames."""


class Background:
    """Does jobs in the order in which they are given; an error of one is raised by a later call.

    They are done in another thread; those of a live run, whose frames should not have to share two cores with them, are
    ``postponed`` until the caller has nothing else to do.
    """

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
            error.add_note(f"work beside the frames failed, too: {of_job!r}")
        finally:
            self._thread.shutdown()

    def do(self, job: Callable[[], None]) -> None:
        """Have a job done, as soon as no more than ``WAITING`` others are left (``POSTPONED``, if they are)."""
        if self._postponed is None:
            self.wait(WAITING)
            self._jobs.append(self._thread.submit(job))
        else:
            self.wait(POSTPONED)
            self._postponed.append(job)

    def next(self) -> bool:
        """Do the first postponed job, in this thread; returns whether there was one."""
        if self._postponed:
            self._postponed.popleft()()
            return True
        return False

    def wait(self, left: int = 0) -> None:
        """Wait until so many jobs are left at most, or do them."""
        while len(self._jobs) > left:
            self._jobs.popleft().result()
        while self._postponed and len(self._postponed) > left:
            self.next()
