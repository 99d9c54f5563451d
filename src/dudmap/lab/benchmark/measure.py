"""Measurement of one system on one recording, in a separate process so that time and memory are not shared."""

import hashlib
import multiprocessing
import tempfile
import traceback
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dudmap.config import Config
from dudmap.errors import DatasetError, DudmapError
from dudmap.lab.benchmark.entries import Entry
from dudmap.lab.benchmark.score import SAMPLES, score_mesh, score_trajectory
from dudmap.lab.benchmark.systems import PASSES

if TYPE_CHECKING:
    from dudmap.core.geometry.mesh import Mesh
    from dudmap.evaluation.surface import Surface
    from dudmap.io.sequences import Sequence

Row = dict[str, Any]
"""One row of a table: sequence, system and figures by name, or ``error`` with a sentence."""


@dataclass(frozen=True)
class Job:
    """One measurement of a suite.

    Attributes:
        entry: The recording.
        system: Name of the system.
        config: Parameters of the system.
        out: Folder that keeps the run; None keeps nothing.
    """

    entry: Entry
    system: str
    config: Config
    out: Path | None = None


def measure(job: Job) -> Row:
    """Run a system on a recording and score the result.

    Raises:
        DudmapError: The recording cannot be used, or no frame could be tracked.
    """
    sequence = job.entry.open()
    row = measure_sequence(
        sequence, job.config, job.entry.surfaces(sequence), job.out, job.entry.max_frames,
        passes=PASSES.get(job.system, 1), calibrate=True,
    )  # fmt: skip
    return {"sequence": job.entry.name, "system": job.system} | row


def measure_sequence(
    sequence: "Sequence",
    config: Config,
    surfaces: "tuple[Mesh | Surface, Mesh | Surface] | None",
    out: Path | None = None,
    max_frames: int | None = None,
    samples: int = SAMPLES,
    passes: int = 1,
    calibrate: bool = False,
    ahead: int | None = None,
) -> Row:
    """Run a system on a recording: figures of its metrics.json and errors of trajectory and mesh.

    Args:
        sequence: The recording.
        config: Parameters of the system.
        surfaces: True static surface and its observed part, in the frame of the ground truth, if known.
        out: Folder that keeps the run; None keeps nothing.
        max_frames: Use only the first frames.
        samples: Number of points sampled on each surface.
        passes: See ``dudmap.app.pipeline.run.run``.
        calibrate: Estimate the calibration of the colour camera first, as ``dudmap run`` does; otherwise the recording
            is taken as given.
        ahead: Frames read ahead, see ``dudmap.app.pipeline.run.run``; None reads ahead unless frames are rendered.

    Raises:
        DudmapError: The recording cannot be used, or no frame could be tracked.
    """
    from dudmap.app.pipeline.frame_source import AHEAD
    from dudmap.app.pipeline.run import run
    from dudmap.core.geometry.mesh import Mesh
    from dudmap.lab.synthetic.recording import SyntheticSequence

    if ahead is None:
        ahead = 0 if isinstance(sequence, SyntheticSequence) else AHEAD  # rendering would compete for the cores
    config = config.override(["sensor.self_calibration=false"])  # estimated beforehand or not at all
    with tempfile.TemporaryDirectory(prefix="dudmap-") as temporary:
        folder = out or Path(temporary)
        report = run(
            sequence, config, folder,
            max_frames=max_frames, progress=False, ahead=ahead, save_map=out is not None, passes=passes,
            calibrate=calibrate,
        )  # fmt: skip
        row: Row = {key: value for key, value in report.metrics.items() if isinstance(value, int | float)}
        row["tracked_share"] = round(report.metrics["tracked"] / report.metrics["frames"], 4)
        truth = sequence.ground_truth
        if truth is not None:
            row |= score_trajectory(report.trajectory, truth)
        if truth is not None and surfaces is not None and report.metrics["mesh_triangles"]:
            try:
                row |= score_mesh(Mesh.load(report.out / "mesh.ply"), report.trajectory, truth, *surfaces, samples)
            except DatasetError as error:
                row["mesh_missing"] = str(error)
    return row


def measure_all(jobs: Iterable[Job], workers: int, done: Callable[[Row], None] = lambda row: None) -> list[Row]:
    """Measure all jobs, each in its own process; a failed one gives a row with ``error``.

    Args:
        jobs: The measurements; rows are returned in this order.
        workers: Number of processes at a time. Times per frame are reliable with one only.
        done: Called with every row as soon as it is complete.
    """

    def one(job: Job) -> Row:
        row = {"sequence": job.entry.name, "system": job.system} | in_own_process(measure, job)
        done(row)
        return row

    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(one, jobs))


def in_own_process(function: Callable[[Any], Row], argument: Any) -> Row:  # noqa: ANN401
    """Result of ``function(argument)`` in a new process; ``{"error": sentence}`` if it raises or the process dies."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        try:
            return pool.submit(function, argument).result()
        except DudmapError as error:
            return {"error": str(error)}
        except BrokenProcessPool:
            return {"error": "its process died without a result, as when it crashes or runs out of memory"}
        except Exception as error:  # a defect in one measurement must not discard the others of a suite
            traceback.print_exception(error)
            return {"error": f"{type(error).__name__}: {error}"}


@cache
def code_hash(without: tuple[str, ...] = ()) -> str:
    """SHA-256 of all sources of the package, except of the packages ``without``."""
    import dudmap

    root = Path(dudmap.__file__).parent
    sources = sorted(
        source for source in root.rglob("*.py") if not source.relative_to(root).as_posix().startswith(without)
    )
    return hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()
