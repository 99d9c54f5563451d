"""The limit of dynamics: how much may move, how fast and from when on, before tracking and mapping break down.

Three sweeps over synthetic worlds: mover coverage against mover speed, against the share of the frames in which the
movers are present from the start, and against camera speed. ``docs/limits.md`` defines the figures.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.benchmark.measure import Row, in_own_process, measure_sequence
from dudmap.config import Config
from dudmap.errors import DudmapError
from dudmap.evaluation.segmentation import SCORED_COVERAGE

if TYPE_CHECKING:
    from dudmap.evaluation.surface import Surface
    from dudmap.frames.frame import Frame
    from dudmap.geometry.trajectory import Trajectory
    from dudmap.synthetic.recording import SyntheticSequence

SIZE = (320, 240)
FPS = 30.0
HANDHELD = "handheld"
CAMERA_PATHS = ("still", "slow", "handheld", "fast")
"""Camera paths in the order of their speed; the rows tell the speed that was measured."""
LARGEST_ATE = 0.02
"""A system copes with a condition if the ATE RMSE is at most this, metres, and no frame is lost."""


class Sweep(NamedTuple):
    """One grid of conditions.

    Attributes:
        name: Short name, of files too.
        x: Name of the condition along the horizontal axis.
        xs: Its values.
        coverages: Shares of the image that move: the vertical axis.
    """

    name: str
    x: str
    xs: tuple[float | str, ...]
    coverages: tuple[float, ...]

    @property
    def varied(self) -> str:
        """Attribute of a condition that the horizontal axis stands for."""
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
FRAMES, QUICK_FRAMES = 90, 60
SAMPLES = 40_000
"""Points drawn on each surface: a share of 1 % is then known to 0.05 % (standard error)."""
PART = 6
"""Conditions measured in one process: one that dies takes few with it."""


@dataclass(frozen=True)
class Condition:
    """What the systems are put through.

    Attributes:
        coverage: Share of the image that the crowd hides on average once it is there.
        speed: Of the people, m/s.
        camera_path: Name of the built-in path.
        start_share: Share of the frames, from the first on, in which the crowd exists; None: it comes in later.
        frames: Number of frames.
    """

    coverage: float
    speed: float = 1.0
    camera_path: str = HANDHELD
    start_share: float | None = None
    frames: int = FRAMES

    def sequence(self) -> "SyntheticSequence | Leaving":
        """Its recording."""
        from dudmap.synthetic import sequence
        from dudmap.synthetic.recording import DEFAULT_CAMERA

        made = sequence(
            camera_path=self.camera_path,
            frames=self.frames,
            fps=FPS,
            speed=self.speed,
            coverage=self.coverage,
            start_dynamic=self.start_share is not None,
            camera=DEFAULT_CAMERA.resized(*SIZE),
        )
        return made if self.start_share is None else Leaving(made, round(self.start_share * self.frames))


class Leaving:
    """A recording whose movers exist in its first frames only: afterwards it is its own static twin.

    Args:
        recording: With movers from the first frame on.
        until: Number of the first frame without them.
    """

    def __init__(self, recording: "SyntheticSequence", until: int) -> None:
        self._parts, self._until = (recording, recording.static_twin()), until
        self.name, self.camera, self.timestamps = f"{recording.name}-leaving", recording.camera, recording.timestamps

    @property
    def ground_truth(self) -> "Trajectory":
        """True poses."""
        return self._parts[0].ground_truth

    def __len__(self) -> int:
        return len(self.timestamps)

    def __getitem__(self, index: int) -> "Frame":
        return self._parts[index >= self._until][index]

    def mask(self, index: int) -> NDArray[np.bool_]:
        """True dynamic mask (H, W)."""
        return self._parts[index >= self._until].mask(index)


class Kept:
    """A recording held in memory, so that several systems get the same frames without rendering them again."""

    def __init__(self, recording: "SyntheticSequence | Leaving") -> None:
        self.name, self.camera, self.timestamps = recording.name, recording.camera, recording.timestamps
        self.ground_truth = recording.ground_truth
        self._frames = [recording[index] for index in range(len(recording))]
        self._masks = [recording.mask(index) for index in range(len(recording))]

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> "Frame":
        return self._frames[index]

    def mask(self, index: int) -> NDArray[np.bool_]:
        """True dynamic mask (H, W)."""
        return self._masks[index]

    def coverage(self) -> float:
        """Mean share of the image that moves, over the frames in which more than a little does."""
        shares = np.array([mask.mean() for mask in self._masks])
        return float(shares[shares > SCORED_COVERAGE].mean()) if (shares > SCORED_COVERAGE).any() else 0.0

    def camera_speed(self) -> float:
        """Mean speed of the camera, m/s."""
        steps = np.linalg.norm(np.diff(self.ground_truth.Ts_world_camera[:, :3, 3], axis=0), axis=1)
        return float(steps.sum() / (self.timestamps[-1] - self.timestamps[0]))


class Cell(NamedTuple):
    """One cell of a grid: the sweep's name, its value along the horizontal axis, and the condition there."""

    sweep: str
    x: float | str
    condition: Condition


def grid_cells(sweeps: tuple[Sweep, ...], frames: int) -> list[Cell]:
    """All cells of all grids; some have the same condition, as the speed of nobody is the same at any speed."""
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
    kept: Path,
    workers: int,
    done: Callable[[int], None] = lambda count: None,
) -> list[Row]:
    """One row per cell and system.

    Args:
        cells: Of the grids.
        systems: Configurations by name.
        kept: Folder of what has been measured: what the same code, configuration and condition gave before is not
            measured again.
        workers: Processes at a time.
        done: Called with the number of conditions that are finished in addition.
    """
    kept.mkdir(parents=True, exist_ok=True)
    found = sorted(dict.fromkeys(cell.condition for cell in cells), key=lambda condition: condition.camera_path)
    files = {(c, name): kept / f"{_fingerprint(c, config)}.json" for c in found for name, config in systems.items()}
    wanted = [
        (condition, {name: (systems[name], files[condition, name]) for name in missing})
        for condition in found
        if (missing := [name for name in systems if not files[condition, name].is_file()])
    ]
    done(len(found) - len(wanted))
    errors: dict[Condition, object] = {}

    def one(part: list[Job]) -> None:
        answer = in_own_process(_measure_part, part)
        errors.update((condition, answer.get("error")) for condition, _ in part)
        done(len(part))

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(one, [wanted[start : start + PART] for start in range(0, len(wanted), PART)]))
    return [
        {"sweep": cell.sweep, "x": cell.x, "coverage": cell.condition.coverage, "system": name}
        | (json.loads(file.read_text()) if file.is_file() else {"error": errors.get(cell.condition)})
        for cell in cells
        for name in systems
        for file in [files[cell.condition, name]]
    ]


Job = tuple[Condition, dict[str, tuple[Config, Path]]]
"""A condition, and the configurations that it is measured with and the files for what they gave."""


def _fingerprint(condition: Condition, config: Config) -> str:
    """Name for what this code measures: any change of code, configuration or condition gives another."""
    text = f"{_code()}{astuple(condition)}{SIZE}{FPS}{LARGEST_ATE}{SAMPLES}{config.to_toml()}"
    return hashlib.sha256(text.encode()).hexdigest()[:20]


@cache
def _code() -> str:
    import dudmap

    sources = sorted(Path(dudmap.__file__).parent.rglob("*.py"))
    return hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()


def _measure_part(part: list[Job]) -> Row:
    for condition, systems in part:
        measure_condition(condition, systems)
    return {}


def measure_condition(condition: Condition, systems: Mapping[str, tuple[Config, Path]]) -> None:
    """Every system on the same frames of one condition; the figures go into the system's file."""
    recording = Kept(condition.sequence())
    surfaces = _surfaces(condition.camera_path, condition.frames)
    known = {
        "coverage_measured": round(recording.coverage(), 4),
        "camera_speed": round(recording.camera_speed(), 4),
    }
    for config, file in systems.values():
        row: Row = dict(known)
        try:
            row |= measure_sequence(recording, config, surfaces, samples=SAMPLES)
        except DudmapError as error:
            row["error"] = str(error)
        else:
            row["lost_share"] = round(1 - row["tracked_share"], 4)
            row["copes"] = row["lost"] == 0 and row.get("ate_rmse_m") is not None and row["ate_rmse_m"] <= LARGEST_ATE
        part = file.with_suffix(".part")
        part.write_text(json.dumps(row), encoding="utf-8")
        part.rename(file)


@lru_cache(maxsize=4)
def _surfaces(camera_path: str, frames: int) -> "tuple[Surface, Surface]":
    """True surface, whole and as far as the camera would see it if nobody were there."""
    from dudmap.evaluation.surface import Surface
    from dudmap.synthetic import sequence
    from dudmap.synthetic.recording import DEFAULT_CAMERA

    camera = DEFAULT_CAMERA.resized(*SIZE)
    empty = sequence(camera_path=camera_path, frames=frames, fps=FPS, coverage=0.0, camera=camera)
    return Surface(empty.surface(), "the true surface"), Surface(empty.surface(observed=True), "what was seen of it")


def limit(rows: list[Row], sweep: str, system: str, x: float | str) -> float | None:
    """Largest coverage with which, and with all smaller ones measured, a system copes at ``x``; None if with none."""
    cells = sorted(
        (row for row in rows if (row["sweep"], row["system"], row["x"]) == (sweep, system, x)), key=_coverage
    )
    reached = None
    for row in cells:
        if not row.get("copes"):
            break
        reached = row["coverage"]
    return reached


def _coverage(row: Row) -> float:
    return row["coverage"]
