"""The limit of dynamics: the largest dynamic share of the image with which tracking and mapping still succeed.

Three sweeps over synthetic recordings: coverage by movers against their speed, against the share of the frames in which
they are present from the start, and against the speed of the camera. ``docs/limits.md`` defines the figures.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dudmap.config import Config
from dudmap.errors import DudmapError
from dudmap.evaluation.segmentation import SCORED_COVERAGE
from dudmap.lab.benchmark.conditions import FPS, SIZE, Condition
from dudmap.lab.benchmark.entries import Excerpt
from dudmap.lab.benchmark.measure import Row, code_hash, in_own_process, measure_sequence

if TYPE_CHECKING:
    from dudmap.evaluation.surface import Surface

CAMERA_PATHS = ("still", "slow", "handheld", "fast")
"""Camera paths in the order of their speed; the rows contain the measured speed."""
LARGEST_ATE = 0.02
"""A system copes with a condition if no frame is lost and the ATE RMSE is at most this, metres."""


class Sweep(NamedTuple):
    """One grid of conditions.

    Attributes:
        name: Short name, also of the files.
        x: Label of the horizontal axis.
        xs: Values along the horizontal axis.
        coverages: Values along the vertical axis: dynamic shares of the image.
    """

    name: str
    x: str
    xs: tuple[float | str, ...]
    coverages: tuple[float, ...]

    @property
    def varied(self) -> str:
        """Attribute of ``Condition`` that varies along the horizontal axis."""
        return {"speed": "speed", "start": "start_share", "camera": "camera_path"}[self.name]


SWEEPS = (
    Sweep("speed", "mover speed, m/s", (0.02, 0.1, 0.3, 1.0, 2.0, 3.0), (0.0, 0.3, 0.5, 0.7, 0.9)),
    Sweep("start", "share of frames with movers, from the first on", (0.25, 0.5, 1.0), (0.2, 0.4, 0.6)),
    Sweep("camera", "camera path", CAMERA_PATHS, (0.0, 0.3, 0.7)),
)
QUICK_SWEEPS = (
    Sweep("speed", "mover speed, m/s", (0.1, 1.0), (0.3, 0.8)),
    Sweep("start", "share of frames with movers, from the first on", (0.25, 1.0), (0.15,)),
    Sweep("camera", "camera path", ("still", "fast"), (0.4,)),
)
QUICK_FRAMES = 60
SAMPLES = 40_000
"""Points sampled on each surface; the standard error of a share of 1 % is then at most 0.05 %."""
CHUNK = 6
"""Number of conditions per process, which limits the loss if a process dies."""


class Cell(NamedTuple):
    """One cell of a grid: name of the sweep, value along the horizontal axis, and condition."""

    sweep: str
    x: float | str
    condition: Condition


def grid_cells(sweeps: tuple[Sweep, ...], frames: int) -> list[Cell]:
    """All cells of all grids; cells without movers share one condition."""
    out = []
    for sweep in sweeps:
        for x in sweep.xs:
            for coverage in sweep.coverages:
                condition = Condition(coverage, frames=frames)
                if coverage > 0 or sweep.varied != "speed":
                    condition = replace(condition, **{sweep.varied: x})
                out.append(Cell(sweep.name, x, condition))
    return out


def measure_cells(
    cells: list[Cell],
    systems: Mapping[str, Config],
    cache: Path,
    workers: int,
    done: Callable[[int], None] = lambda count: None,
) -> list[Row]:
    """One row per cell and system.

    Args:
        cells: Cells of all grids.
        systems: Configurations by name.
        cache: Folder of earlier measurements, which are reused for the same code, configuration and condition.
        workers: Number of processes at a time.
        done: Called with the number of conditions finished since the last call.
    """
    cache.mkdir(parents=True, exist_ok=True)
    found = sorted(dict.fromkeys(cell.condition for cell in cells), key=lambda condition: condition.camera_path)
    files = {(c, name): cache / f"{_fingerprint(c, config)}.json" for c in found for name, config in systems.items()}
    wanted = [
        (condition, {name: (systems[name], files[condition, name]) for name in missing})
        for condition in found
        if (missing := [name for name in systems if not files[condition, name].is_file()])
    ]
    done(len(found) - len(wanted))
    errors: dict[Condition, object] = {}

    def measure(chunk: list[ConditionJob]) -> None:
        answer = in_own_process(_measure_chunk, chunk)
        errors.update((condition, answer.get("error")) for condition, _ in chunk)
        done(len(chunk))

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(measure, [wanted[start : start + CHUNK] for start in range(0, len(wanted), CHUNK)]))
    return [
        {"sweep": cell.sweep, "x": cell.x, "coverage": cell.condition.coverage, "system": name}
        | (json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {"error": errors.get(cell.condition)})
        for cell in cells
        for name in systems
        for file in [files[cell.condition, name]]
    ]


ConditionJob = tuple[Condition, dict[str, tuple[Config, Path]]]
"""A condition and, by system, its configuration and the file for its figures."""


def _fingerprint(condition: Condition, config: Config) -> str:
    """File name that is unique to the code, the configuration and the condition."""
    text = f"{code_hash()}{astuple(condition)}{SIZE}{FPS}{LARGEST_ATE}{SAMPLES}{config.to_toml()}"
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def _measure_chunk(chunk: list[ConditionJob]) -> Row:
    for condition, systems in chunk:
        measure_condition(condition, systems)
    return {}


def measure_condition(condition: Condition, systems: Mapping[str, tuple[Config, Path]]) -> None:
    """Measure every system on the same frames of one condition, and write the figures to its file."""
    recording = Excerpt(condition.sequence()).load()
    truth, masks = recording.ground_truth, [recording.mask(index) for index in range(len(recording))]
    assert truth is not None  # all conditions are synthetic
    shares = np.array([mask.mean() for mask in masks if mask is not None])
    steps = np.linalg.norm(np.diff(truth.Ts_world_camera[:, :3, 3], axis=0), axis=1)
    speed = float(steps.sum() / (recording.timestamps[-1] - recording.timestamps[0]))
    scored = shares[shares > SCORED_COVERAGE]
    surfaces = _surfaces(condition.camera_path, condition.frames)
    coverage = float(scored.mean()) if len(scored) else 0.0
    conditions = {"coverage_measured": round(coverage, 4), "camera_speed": round(speed, 4)}
    for config, file in systems.values():
        row: Row = dict(conditions)
        try:
            row |= measure_sequence(recording, config, surfaces, samples=SAMPLES)
        except DudmapError as error:
            row["error"] = str(error)
        else:
            row["lost_share"] = round(1 - row["tracked_share"], 4)
            row["copes"] = row["lost"] == 0 and row.get("ate_rmse_m") is not None and row["ate_rmse_m"] <= LARGEST_ATE
        temporary = file.with_suffix(".part")
        temporary.write_text(json.dumps(row), encoding="utf-8")
        temporary.rename(file)  # atomic: an interrupted measurement leaves no file of this name


@lru_cache(maxsize=4)
def _surfaces(camera_path: str, frames: int) -> "tuple[Surface, Surface]":
    """True static surface, and the part of it that the camera sees without movers."""
    from dudmap.evaluation.surface import Surface
    from dudmap.lab.synthetic import sequence
    from dudmap.lab.synthetic.recording import DEFAULT_CAMERA

    camera = DEFAULT_CAMERA.resized(*SIZE)
    empty = sequence(camera_path=camera_path, frames=frames, fps=FPS, coverage=0.0, camera=camera)
    return Surface(empty.surface(), "the true surface"), Surface(
        empty.surface(observed=True), "the observed part of it"
    )


def limit(rows: list[Row], sweep: str, system: str, x: float | str) -> float | None:
    """Largest coverage up to which a system copes at all measured coverages for ``x``; None if at none."""
    cells = [row for row in rows if (row["sweep"], row["system"], row["x"]) == (sweep, system, x)]
    reached = None
    for row in sorted(cells, key=lambda row: row["coverage"]):
        if not row.get("copes"):
            break
        reached = row["coverage"]
    return reached
