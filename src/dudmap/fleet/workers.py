"""Worker processes that do the jobs of a merge, and what they needed."""

import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from types import TracebackType
from typing import TypeVar

from dudmap.app.pipeline.environment import peak_rss_mb
from dudmap.errors import DudmapError

Job = TypeVar("Job")
Result = TypeVar("Result")


class Workers:
    """Processes with one thread each; a single one is this process.

    ``peak_rss_mb`` is the peak memory of each so far, by its id, empty on Windows; ``cpu_s`` the processor time of all
    jobs.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self.peak_rss_mb: dict[int, float] = {}
        self.cpu_s = 0.0
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(count, context, initializer=_prepare) if count > 1 else None

    def __enter__(self) -> "Workers":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def map(self, function: Callable[[Job], Result], jobs: Sequence[Job]) -> Iterator[Result]:
        """Results of jobs, in their order.

        Raises:
            DudmapError: A worker was ended, by the system as a rule for want of memory.
        """
        if self._pool is None:
            measured = (_measured(function, job) for job in jobs)
        else:
            futures = [self._pool.submit(_measured, function, job) for job in jobs]
            measured = (future.result() for future in futures)
        try:
            for result, pid, peak, cpu in measured:
                if peak is not None:
                    self.peak_rss_mb[pid] = max(peak, self.peak_rss_mb.get(pid, 0.0))
                self.cpu_s += cpu
                yield result
        except BrokenProcessPool:
            raise DudmapError(
                f"a worker was ended by the system, perhaps for want of memory; repeat with fewer than {self.count} "
                "workers"
            ) from None


def _prepare() -> None:
    """One thread for this worker."""
    import cv2

    os.environ["DUDMAP_THREADS"] = "1"
    cv2.setNumThreads(1)


def _measured(function: Callable[[Job], Result], job: Job) -> tuple[Result, int, float | None, float]:
    """Result of a job, id and peak memory of the process, and processor time of the job."""
    start = time.process_time()
    result = function(job)
    return result, os.getpid(), peak_rss_mb(), time.process_time() - start
