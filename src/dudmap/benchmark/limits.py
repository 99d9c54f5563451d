"""The limit of dynamics: how much may move, how fast and from when on, before tracking and mapping break down.

Three sweeps over synthetic worlds: mover coverage against mover speed, against the share of the frames in which the
movers are present from the start, and against camera speed. ``docs/limits.md`` defines the figures.
"""

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.benchmark.measure import Row, in_own_process, measure_sequence
from dudmap.config import Config
from dudmap.errors import DudmapError
from dudmap.metrics import SCORED_COVERAGE

if TYPE_CHECKING:
    from dudmap.frame import Frame
    from dudmap.mesh import Mesh
    from dudmap.synthetic.recording import SyntheticSequence
    from dudmap.trajectory import Trajectory

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


SWEEPS = (
    Sweep("speed", "mover speed, m/s", (0.02, 0.1, 0.3, 1.0, 3.0), (0.0, 0.3, 0.6, 0.9)),
    Sweep("start", "share of frames with movers, from the first on", (0.25, 0.5, 1.0), (0.1, 0.3, 0.5)),
    Sweep("camera", "camera path", CAMERA_PATHS, (0.0, 0.3, 0.6)),
)
QUICK_SWEEPS = (
    Sweep("speed", "mover speed, m/s", (0.1, 1.0), (0.3, 0.8)),
    Sweep("start", "share of frames with movers, from the first on", (0.25, 1.0), (0.15,)),
    Sweep("camera", "camera path", ("still", "fast"), (0.4,)),
)
FRAMES, QUICK_FRAMES = 120, 80


@dataclass(frozen=True)
class Condition:
    """One cell of a grid.

    Attributes:
        sweep: Name of the sweep it belongs to.
        x: Value along the horizontal axis.
        coverage: Share of the image that the crowd hides on average once it is there.
        speed: Of the people, m/s.
        camera_path: Name of the built-in path.
        start_share: Share of the frames, from the first on, in which the crowd exists; None: it comes in later.
        frames: Number of frames.
    """

    sweep: str
    x: float | str
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
            speed=self.speed if self.coverage else None,
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


def conditions(sweeps: tuple[Sweep, ...], frames: int) -> list[Condition]:
    """All cells of all grids."""
    out = []
    for sweep in sweeps:
        for x in sweep.xs:
            for coverage in sweep.coverages:
                key = {"speed": "speed", "start": "start_share", "camera": "camera_path"}[sweep.name]
                varied: dict[str, Any] = {key: x}
                out.append(Condition(sweep.name, x, coverage, frames=frames, **varied))
    return out


def measure_conditions(
    cells: list[Condition],
    systems: Mapping[str, Config],
    workers: int,
    done: Callable[[Condition], None] = lambda condition: None,
) -> list[Row]:
    """One row per condition and system.

    Conditions are shared out among ``workers`` processes at a time.
    """
    batches = [cells[start::workers] for start in range(min(workers, len(cells)))]
    rows: dict[Condition, list[Row]] = {}

    def one(batch: list[Condition]) -> None:
        for part in _parts(batch, 8):
            answer = in_own_process(_measure_batch, (part, dict(systems)))
            for condition in part:
                known = {"sweep": condition.sweep, "x": condition.x, "coverage": condition.coverage}
                failed = [{**known, "system": name, "error": answer.get("error")} for name in systems]
                rows[condition] = answer.get(condition, failed)  # type: ignore[call-overload]
                done(condition)

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(one, batches))
    return [row for condition in cells for row in rows[condition]]


def _parts(batch: list[Condition], size: int) -> Iterator[list[Condition]]:
    """Pieces of a list: a process that dies takes few conditions with it."""
    for start in range(0, len(batch), size):
        yield batch[start : start + size]


def _measure_batch(job: tuple[list[Condition], dict[str, Config]]) -> dict[Any, list[Row]]:
    cells, systems = job
    return {condition: measure_condition(condition, systems) for condition in cells}


def measure_condition(condition: Condition, systems: Mapping[str, Config]) -> list[Row]:
    """Every system on the same frames of one condition."""
    recording = Kept(condition.sequence())
    surfaces = _surfaces(condition.camera_path, condition.frames)
    known = {
        "sweep": condition.sweep,
        "x": condition.x,
        "coverage": condition.coverage,
        "coverage_measured": round(recording.coverage(), 4),
        "camera_speed": round(recording.camera_speed(), 4),
    }
    rows = []
    for name, config in systems.items():
        row: Row = {**known, "system": name}
        try:
            row |= measure_sequence(recording, config, surfaces)
        except DudmapError as error:
            row["error"] = str(error)
        else:
            row["lost_share"] = round(1 - row["tracked_share"], 4)
            row["copes"] = row["lost"] == 0 and row.get("ate_rmse_m") is not None and row["ate_rmse_m"] <= LARGEST_ATE
        rows.append(row)
    return rows


@lru_cache(maxsize=4)
def _surfaces(camera_path: str, frames: int) -> "tuple[Mesh, Mesh]":
    """True surface, whole and as far as the camera would see it if nobody were there."""
    from dudmap.synthetic import sequence
    from dudmap.synthetic.recording import DEFAULT_CAMERA

    camera = DEFAULT_CAMERA.resized(*SIZE)
    empty = sequence(camera_path=camera_path, frames=frames, fps=FPS, coverage=0.0, camera=camera)
    return empty.surface(), empty.surface(observed=True)


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
