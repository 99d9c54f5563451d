"""What a study costs beside its runs (docs/cluster.md).

``python benchmarks/study_overhead.py runs FOLDER`` reads the journal of a study that ran: the time from the begin of a
run to the begin of the next run of the same worker, less the time of the run itself.
``python benchmarks/study_overhead.py folder`` claims, writes and reads 10,000 run folders without running anything, and
counts the operations on the file system that one takes.
``python benchmarks/study_overhead.py driver`` conducts runs that do nothing in this process, with ``--cluster`` on a
Ray cluster: processor time of the process that hands them out.
"""

import argparse
import os
import sys
import tempfile
import time
from collections import Counter, defaultdict
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np

from dudmap.lab.study.conduct import conduct
from dudmap.lab.study.executor import Executor
from dudmap.lab.study.plan import Plan, Run, make_plan
from dudmap.lab.study.store import StudyFolder
from dudmap.lab.study.worker import Job, Outcome, perform

ROW = {f"figure_{n}": n / 7 for n in range(40)}
"""Figures of a run, as many as a real one has."""
IMPORTANT = ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.listdir", "os.scandir", "shutil.rmtree")
"""Operations on the file system that Python reports (audit events); reads and writes of an open file are not among."""


def nothing(run: Run, out: Path | None) -> dict[str, Any]:
    """A run that does nothing."""
    return ROW


def empty_plan(count: int) -> Plan:
    """A design of so many runs."""
    levels = [round(0.001 + 1e-6 * n, 9) for n in range(count)]
    room = {"scene": "room", "frames": 2}
    return make_plan({"factors": {"tracker.huber": levels}, "sequences": [room], "responses": ["lost"], "confirm": 0})


def of_runs(folder: Path) -> None:
    """Overhead between the real runs of a study."""
    store, of_worker = StudyFolder(folder), defaultdict(list)
    for line in store.journal():
        if line["event"] in ("begun", "finished"):
            of_worker[line["host"], line["pid"]].append(line)
    gaps, seconds = [], []
    for lines in of_worker.values():
        for first, second, third in zip(lines, lines[1:], lines[2:], strict=False):
            if (first["event"], second["event"], third["event"]) == ("begun", "finished", "begun"):
                result = store.result(first["run"])
                assert result is not None
                gaps.append(third["time"] - first["time"] - result["seconds"])
                seconds.append(result["seconds"])
    ms = 1000 * np.array(gaps)
    print(f"{len(ms)} runs of {np.median(seconds):.2f} s (median) by {len(of_worker)} workers: overhead per run "
          f"{np.median(ms):.1f} ms (median), {np.percentile(ms, 95):.1f} ms (95 %)")  # fmt: skip


def of_folder(count: int) -> None:
    """Time, size and operations of run folders."""
    events: Counter[str] = Counter()
    sys.addaudithook(lambda event, _: events.update([event]) if event in IMPORTANT else None)
    runs = empty_plan(count).runs()
    with tempfile.TemporaryDirectory(prefix="study-overhead-") as root:
        store, times, found = StudyFolder(root), [], ""
        store.create()
        perform(Job(runs[0], Path(root), do=nothing))  # imports
        for n, run in enumerate(runs[1:]):
            begin = time.process_time()
            events.clear()
            perform(Job(run, Path(root), do=nothing))
            times.append(time.process_time() - begin)
            if n == 0:
                found = ", ".join(f"{name} {number}" for name, number in sorted(events.items()))
        ms = 1000 * np.array(times)
        tenth = max(len(ms) // 10, 1)
        size = sum(path.stat().st_size for path in (Path(root) / "runs" / runs[-1].key).iterdir())
        begin = time.process_time()
        known = sum(store.result(run.key) is not None for run in runs)
        scan = time.process_time() - begin
        journal = sum(path.stat().st_size for path in Path(root).glob("journal*"))
        print(f"claim, begin, write and end a run: {np.median(ms[:tenth]):.2f} ms of processor time for the first "
              f"{tenth} runs, {np.median(ms[-tenth:]):.2f} ms for the last {tenth}; operations: {found}\n"
              f"result of a run {size} bytes, journal {journal / len(runs):.0f} bytes per run; a study that goes on "
              f"looks up {known} results in {scan:.2f} s")  # fmt: skip


class Instant:
    """Executor that does a job at once, in this process."""

    workers, cores = 1000, 1

    def submit(self, job: Job) -> "Future[Outcome]":
        """See ``Executor``."""
        out: Future[Outcome] = Future()
        out.set_result(perform(job))
        return out

    def close(self) -> None:
        """See ``Executor``."""


def of_driver(count: int, address: str) -> None:
    """Processor time per run of the process that hands the runs out."""
    executor: Executor = Instant()
    if address:
        from dudmap.lab.study.cluster import RayExecutor

        executor = RayExecutor(address)
    plan = empty_plan(count)
    begin = time.process_time()
    runs = plan.runs()
    made = time.process_time() - begin
    with tempfile.TemporaryDirectory(prefix="study-overhead-") as root:
        begin, wall = time.process_time(), time.monotonic()
        conduct(runs, Path(root), executor, do=nothing)
        cpu, wall = time.process_time() - begin, time.monotonic() - wall
        executor.close()
    where = f"Ray, {executor.workers} at a time" if address else "in this process, the run folders included"
    print(f"{count} empty runs ({where}): {1000 * cpu / count:.2f} ms of the driver's processor time per run, "
          f"{1000 * made / count:.2f} ms to make the list of runs; {wall:.0f} s in all")  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("runs", "folder", "driver"))
    parser.add_argument("folder", type=Path, nargs="?", help="study folder")
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--cluster", default="", help="address of a Ray cluster")
    given = parser.parse_args()
    os.environ.setdefault("DUDMAP_THREADS", "1")
    if given.what == "runs":
        of_runs(given.folder)
    elif given.what == "folder":
        of_folder(given.count)
    else:
        of_driver(given.count, given.cluster)
