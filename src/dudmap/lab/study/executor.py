"""Where the runs of a study are done: the interface, and processes of this machine."""

import multiprocessing
import multiprocessing.process
import os
import signal
import threading
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Protocol

from dudmap.lab.study.worker import Job, Outcome, perform


class WorkerDied(Exception):  # noqa: N818 - what happened to a worker, no mistake of the user
    """The process or node that did a job ended before the job did."""


class Executor(Protocol):
    """Does jobs. An engine for clusters needs no more than this.

    Attributes:
        workers: Number of jobs that are done at a time.
        cores: Cores that a job uses.
    """

    workers: int
    cores: int

    def submit(self, job: Job) -> "Future[Outcome]":
        """Start a job as soon as a worker is free; the future raises ``WorkerDied`` if its worker ends before it."""
        ...

    def close(self) -> None:
        """End all workers, at once."""
        ...


class LocalExecutor:
    """Processes of this machine, each of which outlives its jobs so that start and kernels are paid once.

    Every worker has a process pool of its own: the death of one ends its current job only.

    Args:
        workers: Number of processes.
        threads: Threads of each (DUDMAP_THREADS); by default the cores are shared equally.
        kernels: Whether the first worker compiles the kernels before any other starts.
    """

    def __init__(self, workers: int, threads: int | None = None, kernels: bool = True) -> None:
        self.workers = workers
        self.cores = threads or max(1, usable_cores() // workers)
        self._feeders = ThreadPoolExecutor(workers, thread_name_prefix="study")
        self._own = threading.local()
        self._pids: set[int] = set()
        self._lock = threading.Lock()
        self._loaded = not kernels
        self._closed = False

    def submit(self, job: Job) -> "Future[Outcome]":
        """See ``Executor``."""
        return self._feeders.submit(self._do, job)

    def _do(self, job: Job) -> Outcome:
        pool = self._pool()
        try:
            return pool.submit(perform, job).result()
        except BrokenProcessPool:
            self._pids.discard(self._own.pid)
            pool.shutdown(wait=False)
            self._own.pool = None
            raise WorkerDied from None

    def _pool(self) -> ProcessPoolExecutor:
        """Process of the calling thread."""
        if getattr(self._own, "pool", None) is None:
            context = multiprocessing.get_context("spawn")
            pool = ProcessPoolExecutor(1, context, initializer=start_worker, initargs=(self.cores,))
            try:
                pid = pool.submit(os.getpid).result()
                with self._lock:
                    if not self._loaded:  # the first process compiles; two would write the same cache at a time
                        pool.submit(load_kernels).result()
                        self._loaded = True
            except BrokenProcessPool:
                raise WorkerDied from None
            self._own.pool, self._own.pid = pool, pid
            self._pids.add(pid)
            if self._closed:
                self.close()
        return self._own.pool

    def close(self) -> None:
        """See ``Executor``."""
        self._closed = True
        self._feeders.shutdown(wait=False, cancel_futures=True)
        for pid in list(self._pids):
            try:
                os.kill(pid, signal.SIGTERM)
            except OSError:  # it ended by itself: ProcessLookupError, on Windows another one
                continue


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def set_threads(threads: int) -> None:
    """Number of threads of this process: of the kernels, OpenCV, and the libraries of linear algebra."""
    import cv2
    from threadpoolctl import threadpool_limits

    os.environ["DUDMAP_THREADS"] = str(threads)
    cv2.setNumThreads(threads)
    threadpool_limits(threads)


def start_worker(threads: int) -> None:
    """Prepare a worker process: so many threads, and no life of its own after the process that started it."""
    set_threads(threads)
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends the run; its folder stays unfinished
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_end_with, args=(parent,), daemon=True, name="parent").start()


def _end_with(parent: "multiprocessing.process.BaseProcess") -> None:
    """End this process with its parent: a worker of a process pool would wait for its next job forever."""
    parent.join()
    os._exit(1)


def load_kernels() -> None:
    """Compile the kernels, or load them from the cache."""
    from dudmap.lab.warmup import steps

    for _, step in steps():
        step()
