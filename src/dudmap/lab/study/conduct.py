"""Execution of the runs of a study: begins what is missing, repeats what a dead worker left, reports progress."""

import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Lock

from dudmap.lab.study.designs import Table
from dudmap.lab.study.plan import Run
from dudmap.lab.study.worker import Do, Executor, Job, StudyFolder

ATTEMPTS = 3
"""Times a run is begun whose worker dies, after which it is left out; a later start of the study tries again."""
POLL = 0.5
"""Time between two looks at a run that another process has claimed, seconds."""


@dataclass
class Progress:
    """State of a study.

    Attributes:
        total, done, begun: Number of different runs, of those that have a result, and of those that had one at the
            start.
        deaths: Number of workers that died.
        spent: Time of all runs so far, those of earlier starts included, seconds.
        started: ``time.monotonic`` at the start.
        cores: Cores that a run uses.
    """

    total: int
    done: int
    begun: int
    deaths: int = 0
    spent: float = 0.0
    started: float = 0.0
    cores: int = 1

    def describe(self) -> str:
        """State in words."""
        now, spent = self.done - self.begun, self.spent * self.cores / 3600  # core-hours
        whole = spent / max(self.done, 1) * self.total
        left = (time.monotonic() - self.started) / now * (self.total - self.done) if now else None
        return (
            f"run {self.done} of {self.total}{'' if left is None else f', {duration(left)} left'}, "
            f"{duration(3600 * spent)} of about {duration(3600 * whole)} of core time"
            + (f", {self.deaths} workers died" if self.deaths else "")
        )


def duration(seconds: float) -> str:
    """Time in words."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def conduct(
    runs: Sequence[Run],
    root: Path,
    executor: Executor,
    *,
    keep: bool = False,
    do: Do | None = None,
    report: Callable[[Progress], None] = lambda progress: None,
) -> Progress:
    """Do all runs that have no result yet, equal ones once; ``report`` is called after every run.

    ``keep`` keeps whole run folders, ``do`` replaces the system (see ``Job``).
    """
    folder = StudyFolder(root)
    folder.create()
    unique = {run.key: run for run in runs}
    results = {key: folder.result(key) for key in unique}
    missing = deque(key for key, result in results.items() if result is None)
    known = [result["seconds"] for result in results.values() if result is not None]
    state = Progress(
        len(unique), len(known), len(known), spent=sum(known), started=time.monotonic(), cores=executor.cores
    )
    deaths: Counter[str] = Counter()
    stopped, lock = Event(), Lock()

    def work() -> None:
        while missing and not stopped.is_set():
            try:
                key = missing.popleft()
            except IndexError:  # another thread took it
                return
            outcome = executor.perform(Job(unique[key], root, keep, do))
            if outcome == "claimed":  # by another start of the study, or a worker that has yet to notice its end
                missing.append(key)
                time.sleep(POLL)
                continue
            with lock:
                if outcome == "died":
                    folder.note("died", key)
                    deaths[key] += 1
                    state.deaths += 1
                    if deaths[key] < ATTEMPTS:
                        missing.append(key)
                    continue
                result = folder.result(key)
                assert result is not None
                state.done += 1
                state.spent += result["seconds"]
                report(state)

    with ThreadPoolExecutor(executor.workers, thread_name_prefix="study") as pool:
        try:
            for thread in [pool.submit(work) for _ in range(executor.workers)]:
                thread.result()
        except BaseException:  # Ctrl-C, or a defect: the workers end at once
            stopped.set()
            executor.close()
            raise
    return state


def table_of(runs: Sequence[Run], root: Path) -> Table:
    """One row per run: number of the point, recording, replicate, values of the factors, figures, error, time.

    A run without a result has the error "no result: its worker died".
    """
    import pandas as pd

    folder = StudyFolder(root)
    rows = []
    for run in runs:
        result = folder.result(run.key) or {"row": {"error": "no result: its worker died"}, "seconds": None}
        row = {"run": run.key, "point": run.point, "sequence": run.sequence, "replicate": run.replicate}
        rows.append({**row, **run.values, "seconds": result["seconds"], **result["row"]})
    return pd.DataFrame(rows)
