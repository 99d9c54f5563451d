"""One system on one recording, in a process of its own so that time and memory are its own."""

import multiprocessing
import tempfile
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from dudmap.benchmark.entries import Entry
from dudmap.config import Config
from dudmap.errors import DudmapError

Row = dict[str, Any]
"""One line of a table: sequence, system, and figures by name; ``error`` holds a sentence where there are none."""


@dataclass(frozen=True)
class Job:
    """What is to be measured.

    Attributes:
        entry: The recording.
        system: Name of the system.
        config: Its parameters.
        out: Folder that keeps the run; None keeps nothing.
        surface: Whether to score the mesh where the true surface is known.
    """

    entry: Entry
    system: str
    config: Config
    out: Path | None = None
    surface: bool = True


def measure(job: Job) -> Row:
    """Run the system over the recording and score what it gave.

    Raises:
        DudmapError: The recording cannot be used, or nothing could be tracked.
    """
    from dudmap.benchmark.score import score_trajectory
    from dudmap.run import run

    sequence = job.entry.open()
    row: Row = {"sequence": job.entry.name, "system": job.system}
    with tempfile.TemporaryDirectory(prefix="dudmap-") as temporary:
        out = job.out or Path(temporary)
        report = run(sequence, job.config, out, max_frames=job.entry.max_frames, progress=False)
        row |= {key: value for key, value in report.metrics.items() if isinstance(value, int | float)}
        row |= score_trajectory(report.trajectory, sequence.ground_truth)
        row["tracked_share"] = round(report.metrics["tracked"] / max(report.metrics["frames"], 1), 4)
    return row


def measure_all(jobs: Iterable[Job], workers: int, done: Callable[[Row], None] = lambda row: None) -> list[Row]:
    """Measure all jobs, each in its own process, ``workers`` at a time; a failed one becomes a row with ``error``.

    Args:
        jobs: What to measure; rows come back in this order.
        workers: Processes at a time. Times per frame mean most with one.
        done: Called with every row as soon as it is there.
    """

    def one(job: Job) -> Row:
        row = _in_own_process(job)
        done(row)
        return row

    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(one, jobs))


def _in_own_process(job: Job) -> Row:
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send_measure, args=(job, sender))
    process.start()
    sender.close()
    try:
        row: Row = receiver.recv()
    except EOFError:
        process.join()
        row = {"error": f"its process ended with code {process.exitcode} and without a result"}
    finally:
        process.join()
        receiver.close()
    return {"sequence": job.entry.name, "system": job.system} | row


def _send_measure(job: Job, sender: Connection) -> None:
    try:
        sender.send(measure(job))
    except DudmapError as error:
        sender.send({"error": str(error)})
    finally:
        sender.close()
