"""One system on one recording, in a process of its own so that time and memory are its own."""

import multiprocessing
import tempfile
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dudmap.benchmark.entries import Entry
from dudmap.benchmark.score import SAMPLES, score_mesh, score_trajectory
from dudmap.benchmark.systems import PASSES
from dudmap.config import Config
from dudmap.errors import DatasetError, DudmapError

if TYPE_CHECKING:
    from dudmap.evaluation.surface import Surface
    from dudmap.geometry.mesh import Mesh
    from dudmap.sequences import Sequence

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
    """

    entry: Entry
    system: str
    config: Config
    out: Path | None = None


def measure(job: Job) -> Row:
    """Run the system over the recording and score what it gave.

    Raises:
        DudmapError: The recording cannot be used, or nothing could be tracked.
    """
    sequence = job.entry.open()
    row = measure_sequence(
        sequence, job.config, job.entry.surfaces(sequence), job.out, job.entry.max_frames,
        passes=PASSES.get(job.system, 1),
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
) -> Row:
    """Figures of one run: those of its metrics.json, and how trajectory and mesh compare with the truth.

    Args:
        sequence: The recording.
        config: The system.
        surfaces: True static surface, whole and as far as it was seen, in the frame of the ground truth, if known.
        out: Folder that keeps the run; None keeps nothing.
        max_frames: Use only the first frames.
        samples: Points drawn on each surface.
        passes: See ``dudmap.run.run``.

    Raises:
        DudmapError: The recording cannot be used, or nothing could be tracked.
    """
    from dudmap.geometry.mesh import Mesh
    from dudmap.pipeline.frame_source import AHEAD
    from dudmap.pipeline.run import run
    from dudmap.synthetic.recording import SyntheticSequence

    ahead = 0 if isinstance(sequence, SyntheticSequence) else AHEAD  # rendering would take the cores from the system
    with tempfile.TemporaryDirectory(prefix="dudmap-") as temporary:
        folder = out or Path(temporary)
        report = run(
            sequence, config, folder,
            max_frames=max_frames, progress=False, ahead=ahead, save_map=out is not None, passes=passes,
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
    """Measure all jobs, each in its own process, ``workers`` at a time; a failed one becomes a row with ``error``.

    Args:
        jobs: What to measure; rows come back in this order.
        workers: Processes at a time. Times per frame mean most with one.
        done: Called with every row as soon as it is there.
    """

    def one(job: Job) -> Row:
        row = {"sequence": job.entry.name, "system": job.system} | in_own_process(measure, job)
        done(row)
        return row

    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(one, jobs))


def in_own_process(function: Callable[[Any], Row], argument: Any) -> Row:  # noqa: ANN401
    """What ``function(argument)`` returns in a fresh process; {"error": sentence} where it fails."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send, args=(function, argument, sender))
    process.start()
    sender.close()
    try:
        return receiver.recv()
    except EOFError:
        process.join()
        return {"error": f"its process ended with code {process.exitcode} and without a result"}
    finally:
        process.join()
        receiver.close()


def _send(function: Callable[[Any], Row], argument: Any, sender: Connection) -> None:  # noqa: ANN401
    try:
        sender.send(function(argument))
    except DudmapError as error:
        sender.send({"error": str(error)})
    finally:
        sender.close()
