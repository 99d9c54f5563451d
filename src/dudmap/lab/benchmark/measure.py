"""Measure a system on a recording in a separate process; tables. Unusable recordings raise a ``DudmapError``."""

import csv
import hashlib
import json
import multiprocessing
import os
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from dudmap.app.pipeline.environment import machine, versions
from dudmap.config import Config
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError, DudmapError
from dudmap.evaluation.tables import Column, Row, grid, shown
from dudmap.evaluation.trajectory import RUN_FIGURES, accuracy, ate
from dudmap.io.exporting.mesh_editing import cropped
from dudmap.lab.benchmark.suites import PASSES, Entry

if TYPE_CHECKING:
    from dudmap.core.geometry.mesh import Mesh
    from dudmap.evaluation.surface import Surface
    from dudmap.io.sequences import Sequence

SCORED = (*RUN_FIGURES, "drift_rmse_m", "rotation_rmse_deg")
"""Metrics of a trajectory; drift after aligning the first pose only."""
COMPLETE_WITHIN = 0.02
"""Distance of reconstructed true surface from the mesh, metres."""
SAMPLES = 100_000
"""Points on each surface; shares vary by 0.03 %."""
FEWER_SAMPLES = 40_000
"""Points on each surface for many runs: 0.05 %."""


DIED: Row = {"error": "its process died without a result, as when it crashes or runs out of memory"}


class Job(NamedTuple):
    """One measurement: recording, system, parameters, run folder (None: no mesh score), and ``calibrate`` the colour
    camera first."""

    entry: Entry
    system: str
    config: Config
    out: Path | None = None
    calibrate: bool = True


def measure(job: Job) -> Row:
    """Run a system on a recording and score the result."""
    sequence, passes = job.entry.open(), PASSES.get(job.system, 1)
    surfaces = job.entry.surfaces(sequence) if job.out is not None else None
    frames, calibrate = job.entry.max_frames, job.calibrate
    row = measure_sequence(sequence, job.config, surfaces, job.out, frames, passes=passes, calibrate=calibrate)
    if job.out is not None and surfaces is not None and sequence.ground_truth is not None and row["mesh_triangles"]:
        parts = {name: cropped(surfaces[1], box) for name, box in job.entry.parts.items()}
        row |= score_parts(job.out, sequence.ground_truth, parts)
    return row


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
    """Run a system on a recording: metrics of its metrics.json and errors of trajectory and mesh.

    Args:
        surfaces: True static surface and observed part, ground truth frame, if known.
        out: Run folder; None keeps nothing.
        passes, ahead: See ``dudmap.app.pipeline.run.run``; None reads ahead unless rendered.
        calibrate: Estimate the colour calibration first.
    """
    from dudmap.app.pipeline.frame_source import AHEAD
    from dudmap.app.pipeline.run import run
    from dudmap.core.geometry.mesh import Mesh
    from dudmap.lab.synthetic.recording import SyntheticSequence

    if ahead is None:
        ahead = 0 if isinstance(sequence, SyntheticSequence) else AHEAD  # rendering would compete for the cores
    if config.system == "dudmap":
        config = config.override(["sensor.self_calibration=false"])  # estimated beforehand or not at all
    with tempfile.TemporaryDirectory(prefix="dudmap-") as temporary:
        report = run(
            sequence, config, out or Path(temporary), max_frames=max_frames, progress=False, ahead=ahead,
            save_map=out is not None, passes=passes, calibrate=calibrate and config.system == "dudmap",
        )  # fmt: skip
        row: Row = {key: value for key, value in report.metrics.items() if isinstance(value, int | float)}
        row["tracked_share"] = round(report.metrics["tracked"] / report.metrics["frames"], 4)
        truth = sequence.ground_truth
        if truth is not None:
            row |= accuracy(report.trajectory, truth, SCORED)
        if truth is not None and surfaces is not None and report.metrics["mesh_triangles"]:
            try:
                row |= score_mesh(Mesh.load(report.out / "mesh.ply"), report.trajectory, truth, *surfaces, samples)
            except DatasetError as error:
                row["mesh_missing"] = str(error)
    return row


def score_mesh(
    mesh: "Mesh",
    estimate: Trajectory,
    truth: Trajectory,
    whole: "Mesh | Surface",
    seen: "Mesh | Surface",
    samples: int = SAMPLES,
) -> Row:
    """Accuracy, completeness and ghosts of a mesh, aligned by the first pose only, so that bent or shifted maps are
    penalised.

    Args:
        whole: True static surface, world frame of ``truth``.
        seen: Its observed part, for completeness.
    """
    from dudmap.evaluation.reconstruction import compare_surfaces
    from dudmap.evaluation.surface import moved

    T = ate(estimate, truth, align="origin").T_reference_estimate
    result = compare_surfaces(moved(mesh, T), whole, observed=seen, thresholds=(COMPLETE_WITHIN,), samples=samples)
    return {
        "mesh_accuracy_m": round(result.accuracy.mean, 6),
        "mesh_completeness": round(result.scores[0].recall, 5),
        "ghost_area_m2": None if result.ghost_area_m2 is None else round(result.ghost_area_m2, 5),
        "ghost_share": round(result.ghost_share, 5),
    }


def score_parts(run: Path, truth: Trajectory, parts: Mapping[str, "Mesh"]) -> Row:
    """Share of each visible true part within ``COMPLETE_WITHIN`` of a run's mesh."""
    from dudmap.core.geometry.mesh import Mesh
    from dudmap.evaluation.surface import Surface, moved

    T = ate(Trajectory.load(run / "trajectory.txt"), truth, align="origin").T_reference_estimate
    found = Surface(moved(Mesh.load(run / "mesh.ply"), T), "the mesh")
    return {
        f"completeness_{name}": round(
            float((found.distances(Surface(part, name).samples(SAMPLES)) <= COMPLETE_WITHIN).mean()), 5
        )
        for name, part in parts.items()
        if len(part.faces)
    }


def measure_each(
    function: Callable[[Any], Row],
    jobs: Iterable[tuple[Row, Any]],
    workers: int = 1,
    done: Callable[[Row], None] = lambda row: None,
    kept: Path | None = None,
    *,
    shared: bool = False,
) -> list[Row]:
    """Rows ``label | function(argument)`` in order, from separate processes.

    Args:
        workers: Processes; times are reliable with one.
        shared: Reuse processes; if one dies, the rest have separate ones.
    """
    jobs = list(jobs)
    rows: dict[str, Row] = {}
    lines = kept.read_text(encoding="utf-8").splitlines() if kept is not None and kept.is_file() else []
    known = {_key(row["label"]): row["row"] for line in lines if line.endswith("}") for row in [json.loads(line)]}
    pool = _processes(workers) if shared else None

    def one(job: tuple[Row, Any]) -> None:
        label, argument = job
        key = _key(label)
        if key in known:
            rows[key] = label | known[key]
            return
        row = DIED if pool is None else _result(pool, function, argument)
        row = in_own_process(function, argument) if row == DIED else row
        if kept is not None and row != DIED:
            with kept.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps({"label": label, "row": row}) + "\n")
        rows[key] = label | row
        done(rows[key])

    try:
        with ThreadPoolExecutor(workers) as threads:
            list(threads.map(one, jobs))
    finally:
        if pool is not None:
            pool.shutdown()
    return [rows[_key(label)] for label, _ in jobs]


def _key(label: Row) -> str:
    return json.dumps(label, sort_keys=True)


def measure_all(jobs: Iterable[Job], workers: int, done: Callable[[Row], None] = lambda row: None) -> list[Row]:
    """Measure all jobs of a suite; see ``measure_each``."""
    labelled = [({"sequence": job.entry.name, "system": job.system}, job) for job in jobs]
    return measure_each(measure, labelled, workers, done)


def in_own_process(function: Callable[[Any], Row], argument: Any) -> Row:  # noqa: ANN401
    """Result of ``function(argument)`` in a new process; ``{"error": sentence}`` if it fails."""
    with _processes(1) as pool:
        return _result(pool, function, argument)


def _result(pool: ProcessPoolExecutor, function: Callable[[Any], Row], argument: Any) -> Row:  # noqa: ANN401
    try:
        return pool.submit(function, argument).result()
    except DudmapError as error:
        return {"error": str(error)}
    except BrokenProcessPool:
        return DIED
    except Exception as error:  # a defect in one measurement must not discard the others of a suite
        traceback.print_exception(error)
        return {"error": f"{type(error).__name__}: {error}"}


def _processes(count: int) -> ProcessPoolExecutor:
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(count, context, initializer=_end_with_parent)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


@cache
def code_hash(without: tuple[str, ...] = ()) -> str:
    """SHA-256 of all sources except packages ``without``."""
    import dudmap

    root = Path(dudmap.__file__).parent
    sources = sorted(
        source for source in root.rglob("*.py") if not source.relative_to(root).as_posix().startswith(without)
    )
    return hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()


COLUMNS = (
    Column("frames", "frames"),
    Column("lost", "lost"),
    Column("ate_rmse_m", "ATE RMSE, mm", 1000, 1),
    Column("rpe_trans_rmse_m_per_s", "RPE, mm/s", 1000, 1),
    Column("rpe_rot_rmse_deg_per_s", "RPE, deg/s", 1, 2),
    Column("drift_rmse_m", "drift RMSE, mm", 1000, 1),
    Column("rotation_rmse_deg", "rotation RMSE, deg", 1, 2),
    Column("mask_iou_mean", "mask IoU", 1, 3),
    Column("mesh_accuracy_m", "accuracy, mm", 1000, 1),
    Column("mesh_completeness", "completeness, %", 100, 1),
    Column("completeness_slats", "slats, %", 100, 1),
    Column("completeness_wires", "wires, %", 100, 1),
    Column("ghost_area_m2", "ghost, m2", 1, 3),
    Column("ms_per_frame_median", "ms/frame", 1, 1),
    Column("ms_per_frame_p95", "p95 ms", 1, 1),
    Column("cpu_s", "CPU s", 1, 1),
    Column("peak_rss_mb", "peak MB"),
)


def markdown(rows: list[Row]) -> str:
    """Markdown table of rows, then the failed ones."""
    good = [row for row in rows if "error" not in row]
    used = [column for column in COLUMNS if any(row.get(column.key) is not None for row in good)]
    header = ["sequence", "system", *(column.heading for column in used)]
    body = [
        [str(row["sequence"]), str(row["system"]), *(shown(row.get(column.key), column) for column in used)]
        for row in good
    ]
    failed = [f"- {row['sequence']}, {row['system']}: {row['error']}" for row in rows if "error" in row]
    return grid(header, body) + ("\n" + "\n".join(failed) + "\n" if failed else "")


def save(rows: list[Row] | None, text: str, out: Path, name: str, more: Row | None = None) -> Row:
    """Write <name>.md, .json and, for rows, .csv; return the JSON content."""
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.md").write_text(text, encoding="utf-8")
    content: Row = {"machine": machine(), "versions": versions(), **(more or {})}
    if rows is not None:
        content["rows"] = rows
        with (out / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(dict.fromkeys(key for row in rows for key in row)), restval="")
            writer.writeheader()
            writer.writerows(rows)
    (out / f"{name}.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return content
