"""One run of a study, in a worker process."""

import json
import time
import traceback
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, cast

from dudmap.errors import DudmapError
from dudmap.lab.benchmark.entries import Entry, Excerpt
from dudmap.lab.study.plan import Run
from dudmap.lab.study.store import StudyFolder

if TYPE_CHECKING:
    from dudmap.evaluation.surface import Surface
    from dudmap.io.sequences import Sequence

Outcome = Literal["finished", "known", "claimed"]
"""What came of a job: its run was done now, or before, or another process is doing it."""

CACHED_BYTES = 300e6
"""Frames of a recording that a worker keeps read or rendered between runs, bytes at most."""
PIXEL_BYTES = 8
"""Bytes per pixel of a kept frame: depth, colour and mask."""
SAMPLES = 40_000
"""Points sampled on each surface; the standard error of a share of 1 % is then at most 0.05 %."""


Do = Callable[[Run, Path | None], dict[str, Any]]
"""Makes the row of a run, and keeps the run in a folder if given."""


class Job(NamedTuple):
    """A run and the study folder that takes its result.

    Attributes:
        run: The run.
        root: The study folder.
        keep: Whether the whole run folder (trajectory, mesh, map) is kept beside the figures.
        do: What is done; None runs the system.
    """

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

    Raises:
        DudmapError: The recording cannot be used, or no frame could be tracked.
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
