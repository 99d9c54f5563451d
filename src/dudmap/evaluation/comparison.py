"""Scores of estimated trajectories against one true one."""

from dataclasses import dataclass
from functools import cached_property
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import ConfigError, DatasetError
from dudmap.evaluation.files import Clock, find_reference, find_trajectory, load_trajectories, tracked_share
from dudmap.evaluation.hints import hints
from dudmap.evaluation.tables import Column
from dudmap.evaluation.time_offset import MotionComparison
from dudmap.evaluation.trajectory import (
    Align,
    AteResult,
    RpeResult,
    adjusted,
    ate,
    fit_scale,
    path_figures,
    rpe,
    trajectory_figures,
)

COLUMNS = (
    Column("name", "method"),
    Column("ate_rmse_m", "ATE RMSE, mm", 1000, 1),
    Column("ate_median_m", "median, mm", 1000, 1),
    Column("ate_max_m", "max, mm", 1000, 1),
    Column("rpe_trans_rmse_m_per_s", "RPE, mm/s", 1000, 1),
    Column("rpe_rot_rmse_deg_per_s", "RPE, deg/s", 1, 2),
    Column("pairs", "matched"),
    Column("covered_share", "covered, %", 100, 1),
    Column("time_offset_s", "time offset, s", 1, 3),
    Column("scale", "scale", 1, 4),
)


class Named(NamedTuple):
    """Path of an estimate, and its method's name."""

    name: str
    path: Path

    @classmethod
    def of(cls, text: str) -> "Named":
        """Parse ``NAME=PATH``, or a path, whose stem becomes the name."""
        name, equals, path = text.partition("=")
        if equals and name and path and not Path(text).exists():
            return cls(name, Path(path))
        folder = Path(text).resolve()
        return cls(folder.name if folder.is_dir() else folder.stem, Path(text))


class Manner(NamedTuple):
    """Options of ``dudmap evaluate trajectory``.

    Attributes:
        seconds: Added to the estimate's times; None: best agreement.
    """

    formats: tuple[str | None, str | None] = (None, None)
    clock: Clock = Clock()
    align: Align = "se3"
    max_difference: float = 0.02
    seconds: float | None = 0.0
    scale: bool = False


@dataclass(frozen=True, eq=False)
class Score:
    """An estimate and its errors.

    Attributes:
        found: The estimate after time offset and scale.
    """

    name: str
    file: Path
    run: Path | None
    figures: dict[str, Any]
    found: Trajectory
    true: Trajectory | None
    manner: Manner
    remarks: tuple[str, ...] = ()

    @cached_property
    def absolute(self) -> AteResult:
        """Absolute errors."""
        return ate(self.found, self._reference, self.manner.align, self.manner.max_difference)

    @cached_property
    def relative(self) -> RpeResult | None:
        """Relative errors per second; None if too short."""
        try:
            return rpe(self.found, self._reference, 1.0, "s", self.manner.max_difference)
        except DatasetError:  # the reason is among the figures
            return None

    @property
    def row(self) -> dict[str, Any]:
        """Metrics for one row of a table."""
        return {"name": self.name} | {k: v for k, v in self.figures.items() if not isinstance(v, list)}

    @property
    def _reference(self) -> Trajectory:
        assert self.true is not None
        return self.true


def score(estimate: Path, name: str, reference: Path | None, manner: Manner) -> Score:
    """Score of a run folder or poses; without reference, metrics of the path alone."""
    file, run = find_trajectory(estimate)
    truth = find_reference(reference, run)
    estimated, known = load_trajectories(file, truth, manner.formats, manner.clock)
    found, true = estimated.trajectory, known.trajectory if known else None
    figures: dict[str, Any] = {"estimate": str(file), "reference": str(truth) if truth else None}
    figures |= {"estimate_format": estimated.format, "reference_format": known.format if known else None}
    remarks = (*found.remarks, *(true.remarks if true else ()))
    figures |= path_figures(found) | {"tracked_share": tracked_share(len(found), run, truth)}
    if true is not None:
        seconds = MotionComparison(found, true).best().seconds if manner.seconds is None else manner.seconds
        found = adjusted(found, seconds)
        factor = fit_scale(found, true, manner.max_difference) if manner.scale else 1.0
        found = adjusted(found, scale=factor)
        figures |= {"time_offset_s": round(seconds, 6)} if seconds else {}
        figures |= {"scale": factor} if manner.scale else {}
        errors = trajectory_figures(found, true, manner.align, manner.max_difference)
        figures |= {key: rounded(value) if isinstance(value, float) else value for key, value in errors.items()}
        figures["hints"] = hints(found, true, manner.max_difference)
    return Score(name, file, run, figures, found, true, manner, remarks)


def compare(estimates: list[Named], reference: Path, manner: Manner) -> list[Score]:
    """Scores of several estimates against one reference.

    Raises:
        DatasetError: An unreadable estimate, or times that do not match.
        ConfigError: Two estimates have one name.
    """
    names = [estimate.name for estimate in estimates]
    double = next((name for name in names if names.count(name) > 1), None)
    if double is not None:
        raise ConfigError(f"found two estimates with the name {double}; name them by NAME=PATH")
    scores, failed = [], []
    for name, path in estimates:
        try:
            scores.append(score(path, name, reference, manner))
        except DatasetError as error:
            failed.append(f"{name}: {error}")
    if failed:
        raise DatasetError("; ".join(failed))
    return scores


def rounded(value: float, digits: int = 9) -> float | None:
    """Rounded metric for JSON: None if it is not finite."""
    return round(float(value), digits) if isfinite(value) else None
