"""The limit of dynamics: the largest dynamic share of the image with which tracking and mapping still succeed.

Three sweeps over synthetic recordings: coverage by movers against their speed, against the share of the frames in which
they are present from the start, and against the speed of the camera. ``docs/limits.md`` defines the figures.
"""

import hashlib
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Listing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dudmap.config import Config
from dudmap.errors import DudmapError
from dudmap.evaluation.segmentation import SCORED_COVERAGE
from dudmap.lab.benchmark.measure import FEWER_SAMPLES, Row, code_hash, grid, measure_each, measure_sequence
from dudmap.lab.benchmark.suites import Excerpt
from dudmap.lab.synthetic import sequence
from dudmap.lab.synthetic.recording import SyntheticSequence

SIZE = (320, 240)
"""Image size, pixels."""
FPS = 30.0
"""Frame rate, Hz."""
FRAMES, QUICK_FRAMES = 90, 60
"""Number of frames of a recording."""
LARGEST_ATE = 0.02
"""A system copes with a condition if no frame is lost and the ATE RMSE is at most this, metres."""


@dataclass(frozen=True)
class Condition:
    """One experimental condition: speed of the people in m/s, built-in camera path, number of frames.

    Attributes:
        coverage: Mean share of the image that the crowd covers once all of it is in view.
        start_share: Share of the frames, from the first on, in which the crowd exists; None if it enters later.
    """

    coverage: float
    speed: float = 1.0
    camera_path: str = "handheld"
    start_share: float | None = None
    frames: int = FRAMES

    def sequence(self) -> SyntheticSequence:
        """Recording of this condition."""
        recording = sequence(
            camera_path=self.camera_path, frames=self.frames, fps=FPS, speed=self.speed, coverage=self.coverage,
            start_dynamic=self.start_share is not None, camera=SIZE,
        )  # fmt: skip
        until = round((self.start_share or 1.0) * self.frames)
        return recording if until == self.frames else recording.static_twin(since=float(recording.timestamps[until]))


class Sweep(NamedTuple):
    """One grid of conditions: coverages against the values ``xs`` of the attribute ``varied``, with the label ``x``."""

    name: str
    x: str
    varied: str
    xs: tuple[float | str, ...]
    coverages: tuple[float, ...]


SPEED = Sweep("speed", "mover speed, m/s", "speed", (0.02, 0.1, 0.3, 1.0, 2.0, 3.0), (0.0, 0.3, 0.5, 0.7, 0.9))
START = Sweep(
    "start", "share of frames with movers, from the first on", "start_share", (0.25, 0.5, 1.0), (0.2, 0.4, 0.6)
)
CAMERA = Sweep("camera", "camera path", "camera_path", ("still", "slow", "handheld", "fast"), (0.0, 0.3, 0.7))
"""Camera paths in the order of their speed; the rows contain the measured speed."""
SWEEPS = (SPEED, START, CAMERA)
QUICK_SWEEPS = (
    SPEED._replace(xs=(0.1, 1.0), coverages=(0.3, 0.8)),
    START._replace(xs=(0.25, 1.0), coverages=(0.15,)),
    CAMERA._replace(xs=("still", "fast"), coverages=(0.4,)),
)


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
    out: Path,
    workers: int,
    done: Callable[[Row], None] = lambda row: None,
) -> list[Row]:
    """One row per cell and system.

    A file measured-<fingerprint>.jsonl in ``out`` keeps the figures: a condition that it has for the same code and
    systems is not measured again. ``done`` is called whenever a condition was measured by all systems.
    """
    out.mkdir(parents=True, exist_ok=True)
    text = code_hash() + "".join(f"{name}{config.to_toml()}" for name, config in systems.items())
    file = out / f"measured-{hashlib.sha256(text.encode()).hexdigest()[:8]}.jsonl"
    conditions = list(dict.fromkeys(cell.condition for cell in cells))
    jobs = [(asdict(condition), (condition, dict(systems))) for condition in conditions]
    found = dict(zip(conditions, measure_each(measure_condition, jobs, workers, done, file), strict=True))
    return [
        {"sweep": cell.sweep, "x": cell.x, "coverage": cell.condition.coverage, "system": name}
        | found[cell.condition].get(name, {"error": found[cell.condition].get("error")})
        for cell in cells
        for name in systems
    ]


def measure_condition(job: tuple[Condition, Mapping[str, Config]]) -> Row:
    """Figures of every system, by its name, on the same frames of one condition."""
    from dudmap.evaluation.surface import Surface

    condition, systems = job
    made = condition.sequence()
    recording, truth = Excerpt(made).load(), made.ground_truth
    shares = np.array([mask.mean() for index in range(len(made)) if (mask := recording.mask(index)) is not None])
    steps = np.linalg.norm(np.diff(truth.Ts_world_camera[:, :3, 3], axis=0), axis=1)
    speed = float(steps.sum() / (recording.timestamps[-1] - recording.timestamps[0]))
    scored = shares[shares > SCORED_COVERAGE]
    conditions = {
        "coverage_measured": round(float(scored.mean()) if len(scored) else 0.0, 4), "camera_speed": round(speed, 4)
    }  # fmt: skip
    empty = sequence(
        camera_path=condition.camera_path, frames=condition.frames, fps=FPS, coverage=0.0, camera=made.camera
    )
    surfaces = (
        Surface(empty.surface(), "the true surface"),
        Surface(empty.surface(observed=True), "the observed part of it"),
    )
    rows: Row = {}
    for name, config in systems.items():
        row: Row = dict(conditions)
        try:
            row |= measure_sequence(recording, config, surfaces, samples=FEWER_SAMPLES)
        except DudmapError as error:
            row["error"] = str(error)
        else:
            row["lost_share"] = round(1 - row["tracked_share"], 4)
            row["copes"] = row["lost"] == 0 and row.get("ate_rmse_m") is not None and row["ate_rmse_m"] <= LARGEST_ATE
        rows[name] = row
    return rows


def limit(rows: list[Row], sweep: str, system: str, x: float | str) -> float | None:
    """Largest coverage up to which a system copes at all measured coverages for ``x``; None if at none."""
    cells = [row for row in rows if (row["sweep"], row["system"], row["x"]) == (sweep, system, x)]
    reached = None
    for row in sorted(cells, key=lambda row: row["coverage"]):
        if not row.get("copes"):
            break
        reached = row["coverage"]
    return reached


def limits_table(rows: Listing[Row], sweeps: Listing[Sweep], systems: Listing[str]) -> str:
    """Markdown table of the largest coverage with which each system copes, per value of every sweep."""
    text = ""
    for sweep in sweeps:
        body = []
        for x in sweep.xs:
            reached = [limit(list(rows), sweep.name, system, x) for system in systems]
            body.append([str(x), *("none" if share is None else f"{100 * share:.0f} %" for share in reached)])
        text += f"\n{grid([sweep.x, *systems], body, words=1)}"
    return text


def cells_table(rows: Listing[Row], sweeps: Listing[Sweep], systems: Listing[str]) -> str:
    """Markdown table of all cells: ATE in mm and share of lost frames, bold where the system copes."""
    text = ""
    for sweep in sweeps:
        found = {(row["x"], row["coverage"], row["system"]): row for row in rows if row["sweep"] == sweep.name}
        body = [
            [str(x), f"{100 * coverage:.0f} %", *(_cell(found.get((x, coverage, name), {})) for name in systems)]
            for x in sweep.xs
            for coverage in sweep.coverages
        ]
        text += f"\n{grid([sweep.x, 'coverage', *systems], body)}"
    return text


def _cell(row: Row) -> str:
    if row.get("ate_rmse_m") is None:
        return "no pose" if row.get("error") else ""
    text = f"{1000 * row['ate_rmse_m']:.1f}" + (f" ({100 * row['lost_share']:.0f} % lost)" if row["lost"] else "")
    return f"**{text}**" if row["copes"] else text
