"""Runs of a study, in worker processes, stored as they end."""

import os
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from dudmap.app.pipeline.environment import machine
from dudmap.app.pipeline.run_folder import locked
from dudmap.core import kernel_cache
from dudmap.lab.benchmark.measure import FEWER_SAMPLES, Row, measure_each, measure_sequence
from dudmap.lab.benchmark.suites import Entry, Excerpt
from dudmap.lab.study.designs import Table
from dudmap.lab.study.plan import Run
from dudmap.lab.warmup import steps

if TYPE_CHECKING:
    from dudmap.evaluation.surface import Surface
    from dudmap.io.sequences import Sequence as Recording

Conduct = Callable[[Sequence[Run]], list[Row]]
CACHED_BYTES = 300e6
"""Bytes of frames that a worker keeps."""
PIXEL_BYTES = 8
"""Bytes per pixel of a kept frame."""


class Job(NamedTuple):
    """A run, its threads, and its folder, if kept."""

    run: Run
    threads: int
    out: Path | None


def conduct(
    runs: Sequence[Run],
    root: Path,
    jobs: int = 1,
    *,
    keep: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
    measure: Callable[[Job], Row] | None = None,
) -> list[Row]:
    """Do all runs without metrics, ``jobs`` at a time; ``runs.jsonl`` in ``root`` collects metrics by key, or
    ``error``. ``keep`` leaves run folders in ``runs/``. ``measure`` replaces the system."""
    unique = {run.key: run for run in runs}
    if measure is None and kernel_cache.is_cold():  # once, not in every worker
        for _, step in steps():
            step()
    threads = max(1, machine()["cores_usable"] // jobs)
    work = [({"run": key}, Job(run, threads, root / "runs" / key if keep else None)) for key, run in unique.items()]
    done = list[Row]()

    def count(row: Row) -> None:
        done.append(row)
        progress(len(done), len(work))

    with locked(root):
        rows = measure_each(measure or measure_run, work, jobs, count, root / "runs.jsonl", shared=True)
    found = {row["run"]: row for row in rows}
    return [found[run.key] for run in runs]


def table_of(runs: Sequence[Run], rows: Sequence[Row]) -> Table:
    """One row per run: point, recording, replicate, values, metrics or error."""
    import pandas as pd

    places = ({"point": run.point, "sequence": run.sequence, "replicate": run.replicate, **run.values} for run in runs)
    return pd.DataFrame([{"run": run.key} | place | row for run, place, row in zip(runs, places, rows, strict=True)])


def measure_run(job: Job) -> Row:
    """Metrics of one run of the system.

    Frames are not prepared in a second thread, which would hide time.
    """
    import cv2
    from threadpoolctl import threadpool_limits

    os.environ["DUDMAP_THREADS"] = str(job.threads)
    cv2.setNumThreads(job.threads)
    threadpool_limits(job.threads)
    _reset_peak_memory()
    entry, run = job.run.entry, job.run
    return measure_sequence(
        _recording(entry), run.config, _surfaces(entry) if run.surfaces else None, job.out,
        entry.max_frames, FEWER_SAMPLES, calibrate=run.calibrate, ahead=0,
    )  # fmt: skip


def _reset_peak_memory() -> None:
    import gc

    gc.collect()
    switch = Path("/proc/self/clear_refs")
    if switch.is_file():
        switch.write_text("5", encoding="utf-8")  # proc(5): reset the peak resident set size


@lru_cache(maxsize=1)
def _recording(entry: Entry) -> "Recording":
    sequence = entry.open()
    frames = min(len(sequence), entry.max_frames or len(sequence))
    size = frames * sequence.camera.width * sequence.camera.height * PIXEL_BYTES
    return cast("Recording", Excerpt(sequence)) if size <= CACHED_BYTES else sequence


@lru_cache(maxsize=4)
def _surfaces(entry: Entry) -> "tuple[Surface, Surface] | None":
    from dudmap.evaluation.surface import Surface

    found: Any = entry.surfaces(entry.open())
    return found and (Surface(found[0], "the true surface"), Surface(found[1], "its observed part"))
