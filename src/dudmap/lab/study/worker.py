"""Folder of a study, one run in it, and the processes of this machine that do the runs."""

import json
import multiprocessing
import multiprocessing.process
import os
import shutil
import signal
import socket
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, cast

from dudmap.app.pipeline.environment import machine
from dudmap.errors import DudmapError
from dudmap.lab.benchmark.suites import Entry, Excerpt
from dudmap.lab.study.plan import Run

if TYPE_CHECKING:
    from dudmap.evaluation.surface import Surface
    from dudmap.io.sequences import Sequence

Outcome = Literal["finished", "known", "claimed", "died"]
"""What came of a job: its run was done now, or before, or another process is doing it, or its worker died."""

CACHED_BYTES = 300e6
"""Frames of a recording that a worker keeps read or rendered between runs, bytes at most."""
PIXEL_BYTES = 8
"""Bytes per pixel of a kept frame: depth, colour and mask."""
SAMPLES = 40_000
"""Points sampled on each surface; the standard error of a share of 1 % is then at most 0.05 %."""


class StudyFolder:
    """Results of a study on disk, shared by all processes that work on it.

    A result appears under its final name in one step (``os.replace`` of a finished folder), so there are whole results
    and none else. A claim is a lock of the operating system on a file, which ends with the process that holds it,
    however that ends; a process number written into a file would survive it and may be given to another process.

    ``runs/<key>/result.json`` holds the result of a run, ``journal-<host>.jsonl`` one line for each run that a process
    of the host began or finished, with process and time, ``locks/`` the claims.

    Attributes:
        root: The folder.
    """

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root)

    def create(self) -> None:
        """Make the folder if it does not exist."""
        for name in ("runs", "locks"):
            (self.root / name).mkdir(parents=True, exist_ok=True)

    def result(self, key: str) -> dict[str, Any] | None:
        """Result of a run, None if it has none."""
        path = self.root / "runs" / key / "result.json"
        try:
            return json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except ValueError as error:
            raise DudmapError(f"{path} is not valid JSON: {error}; remove its folder to run it again") from error

    @contextmanager
    def claim(self, key: str) -> Iterator[bool]:
        """Whether this process now has the run for itself; the claim ends with the block or the process."""
        from filelock import FileLock, Timeout

        lock = FileLock(self.root / "locks" / f"{key}.lock")
        try:
            lock.acquire(timeout=0)
        except Timeout:
            yield False
            return
        try:
            yield True
        finally:
            lock.release()

    @contextmanager
    def unfinished(self, key: str) -> Iterator[Path]:
        """Empty folder for a claimed run, which becomes its result at the end of the block, unless that raises."""
        folder = self.root / "runs" / f".{key}"  # the claim makes it ours
        if folder.exists():  # of a process that died
            shutil.rmtree(folder)
        folder.mkdir()
        self.note("begun", key)
        try:
            yield folder
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        os.replace(folder, self.root / "runs" / key)
        self.note("finished", key)

    def note(self, event: str, key: str) -> None:
        """Append a line to the journal of this host.

        Lines of several processes of a host do not mix, as each is one write. Those of several hosts would, on a
        network file system, whose clients find the end of a file each for itself.
        """
        host = socket.gethostname()
        line = {"event": event, "run": key, "pid": os.getpid(), "host": host, "time": time.time()}
        with (self.root / f"journal-{host}.jsonl").open("ab", buffering=0) as file:
            file.write((json.dumps(line) + "\n").encode())


Do = Callable[[Run, Path | None], dict[str, Any]]
"""Makes the row of a run, and keeps the run in a folder if given."""


class Job(NamedTuple):
    """A run and the study folder that takes its result, whole if ``keep``; ``do`` None runs the system."""

    run: Run
    root: Path
    keep: bool = False
    do: Do | None = None


def perform(job: Job) -> Outcome:
    """Do a run unless it is done or another process has claimed it.

    A run that fails with an error has that error as its result; it is not tried again, as it would fail again.
    """
    folder = StudyFolder(job.root)
    key = job.run.key
    with folder.claim(key) as mine:
        if not mine:
            return "claimed"
        if folder.result(key) is not None:
            return "known"
        with folder.unfinished(key) as place:
            start = time.perf_counter()
            try:
                row = (job.do or measure_run)(job.run, place / "run" if job.keep else None)
            except DudmapError as error:
                row = {"error": str(error)}
            except Exception as error:  # a defect in one run must not discard the others of a study
                (place / "error.txt").write_text(traceback.format_exc(), encoding="utf-8")
                row = {"error": f"{type(error).__name__}: {error}"}
            result = {"row": row, "seconds": round(time.perf_counter() - start, 3)}
            (place / "result.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return "finished"


def measure_run(run: Run, out: Path | None) -> dict[str, Any]:
    """Figures of one run of the system, as ``dudmap.lab.benchmark.measure`` makes them.

    Frames are not prepared ahead in a second thread, so that the time per frame is all the time a frame takes.
    """
    from dudmap.lab.benchmark.measure import measure_sequence

    reset_peak_memory()
    return measure_sequence(
        _recording(run.entry), run.config, _surfaces(run.entry) if run.surfaces else None, out,
        run.entry.max_frames, SAMPLES, calibrate=run.calibrate, ahead=0,
    )  # fmt: skip


@lru_cache(maxsize=1)
def _recording(entry: Entry) -> "Sequence":
    """Recording of a run; a short one is read or rendered once for all runs that follow each other."""
    sequence = entry.open()
    frames = min(len(sequence), entry.max_frames or len(sequence))
    size = frames * sequence.camera.width * sequence.camera.height * PIXEL_BYTES
    return cast("Sequence", Excerpt(sequence)) if size <= CACHED_BYTES else sequence


@lru_cache(maxsize=4)
def _surfaces(entry: Entry) -> "tuple[Surface, Surface] | None":
    """True surfaces of a recording with their search trees."""
    from dudmap.evaluation.surface import Surface

    found = entry.surfaces(entry.open())
    return None if found is None else (Surface(found[0], "the true surface"), Surface(found[1], "its observed part"))


def reset_peak_memory() -> None:
    """Let the peak of the resident memory start anew, where the system can (Linux).

    Elsewhere the peak of a run is that of all runs of its process so far.
    """
    import gc

    gc.collect()
    switch = Path("/proc/self/clear_refs")
    if switch.is_file():
        switch.write_text("5", encoding="utf-8")  # proc(5): reset the peak resident set size


class Executor(Protocol):
    """Does jobs: ``workers`` at a time, each asked for by a thread of its own, on so many ``cores`` each."""

    workers: int
    cores: int

    def perform(self, job: Job) -> Outcome:
        """Do a job in another process."""
        ...

    def close(self) -> None:
        """End all workers, at once."""
        ...


class LocalExecutor:
    """Processes of this machine, each of which outlives its jobs so that start and kernels are paid once.

    Every worker is a process pool of its own: the death of one ends its current job only. The cores are shared equally
    unless ``threads`` says how many each has; with ``kernels`` the first worker compiles them before any other starts.
    """

    def __init__(self, workers: int, threads: int | None = None, kernels: bool = True) -> None:
        self.workers = workers
        self.cores = threads or max(1, machine()["cores_usable"] // workers)
        self._pids: dict[ProcessPoolExecutor, int] = {}
        self._idle: list[ProcessPoolExecutor] = []
        self._lock = threading.Lock()
        self._loaded = not kernels
        self._closed = False

    def perform(self, job: Job) -> Outcome:
        """See ``Executor``."""
        pool = self._idle.pop() if self._idle else self._started()
        try:
            if pool not in self._pids:
                self._pids[pool] = pool.submit(os.getpid).result()
                with self._lock:
                    if not self._loaded:  # the first process compiles; two would write the same cache at a time
                        pool.submit(load_kernels).result()
                        self._loaded = True
            if self._closed:
                self.close()
            outcome = pool.submit(perform, job).result()
        except BrokenProcessPool:
            self._pids.pop(pool, None)
            pool.shutdown(wait=False)
            return "died"
        self._idle.append(pool)
        return outcome

    def _started(self) -> ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(1, context, initializer=start_worker, initargs=(self.cores,))

    def close(self) -> None:
        """See ``Executor``."""
        self._closed = True
        for pid in list(self._pids.values()):
            try:
                os.kill(pid, signal.SIGTERM)
            except OSError:  # it ended by itself: ProcessLookupError, on Windows another one
                continue


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
