"""Absolute and relative trajectory error of the TUM RGB-D benchmark (Sturm et al. 2012, section V).

Poses of ``estimate`` and ``reference``, camera to world, are paired up to ``max_difference`` seconds apart.
``DatasetError``: no overlap in time or fewer than three pairs; ``ConfigError``: invalid arguments.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple, Self, get_args

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.geometry.alignment import umeyama
from dudmap.core.geometry.association import LARGEST_GAP, associate
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import ConfigError, DatasetError

Numbers = NDArray[np.float64]
Align = Literal["se3", "origin", "none"]
Unit = Literal["s", "m"]

FEWEST_PAIRS = 3
SMALLEST_SHARE = 0.1
"""Smallest share of the shorter trajectory's poses with a partner."""
SMALLEST_SPREAD = 1e-3
"""Smallest spread of positions across their direction (metres, and share of the spread along) that determines a
rotation."""
LONGEST_STEP = 3.0
"""Median time steps after which frames were lost."""
PATH_TOLERANCE = 0.1
"""Relative tolerance of ``delta`` in metres."""


STATISTICS = "rmse", "mean", "median", "max"


class Statistics(NamedTuple):
    """Root mean square, mean, median, maximum and 95 % quantile."""

    rmse: float
    mean: float
    median: float
    max: float
    p95: float

    @classmethod
    def of(cls, errors: NDArray) -> "Statistics":
        """Statistics of errors (N,)."""
        e = errors.astype(np.float64)
        median, p95 = np.percentile(e, [50, 95])
        return cls(float(np.sqrt(np.mean(e**2))), float(e.mean()), float(median), float(e.max()), float(p95))


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of N poses, or of motions between N pairs.

    Attributes:
        timestamps: (N,) seconds, of the estimate; of a motion's first pose.
        trans_errors: (N,) translations, metres.
        rot_errors_deg: (N,) rotations, degrees.
    """

    timestamps: Numbers
    trans_errors: Numbers
    rot_errors_deg: Numbers

    @classmethod
    def of(cls, timestamps: Numbers, E: Numbers, *more: Any) -> Self:  # noqa: ANN401
        """Errors from rigid motions E (N, 4, 4); ``more``: fields of the class."""
        return cls(timestamps, np.linalg.norm(E[:, :3, 3], axis=1), np.degrees(se3.rotation_angles(E)), *more)

    @property
    def num_pairs(self) -> int:
        """Number N of errors."""
        return len(self.timestamps)

    @cached_property
    def trans(self) -> Statistics:
        """Statistics of the translations, metres."""
        return Statistics.of(self.trans_errors)

    @cached_property
    def rot_deg(self) -> Statistics:
        """Statistics of the rotations, degrees."""
        return Statistics.of(self.rot_errors_deg)

    @property
    def rmse(self) -> float:
        """Root mean square of the translations, metres."""
        return self.trans.rmse


@dataclass(frozen=True, eq=False)
class AteResult(PoseErrors):
    """Absolute trajectory error.

    Attributes:
        T_reference_estimate: (4, 4) applied to the estimate.
        alignment: ``se3``, ``origin``, ``none``, or ``se3-orientations`` for positions that do not determine the
            rotation.
    """

    T_reference_estimate: Numbers
    alignment: str


@dataclass(frozen=True, eq=False)
class RpeResult(PoseErrors):
    """Relative pose error over a fixed time or path length.

    Attributes:
        delta: Interval.
        unit: Its unit.
    """

    delta: float
    unit: str


class PosePairs(NamedTuple):
    """Associated poses: (N,) timestamps of the estimate, (N, 4, 4) of both."""

    timestamps: Numbers
    Ts_estimate: Numbers
    Ts_reference: Numbers


def pair_poses(estimate: Trajectory, reference: Trajectory, max_difference: float = LARGEST_GAP) -> PosePairs:
    """Associate poses one to one, closest timestamps first."""
    for name, trajectory in (("estimated", estimate), ("reference", reference)):
        if not len(trajectory):
            raise DatasetError(f"the {name} trajectory holds no pose; nothing can be compared")
    pairs = associate(estimate.timestamps, reference.timestamps, max_difference)
    if len(pairs) < max(FEWEST_PAIRS, SMALLEST_SHARE * min(len(estimate), len(reference))):
        raise DatasetError(_unpaired(len(pairs), estimate, reference, max_difference))
    pairs.sort()
    first, second = np.array(pairs).T
    return PosePairs(estimate.timestamps[first], estimate.Ts_world_camera[first], reference.Ts_world_camera[second])


def _unpaired(pairs: int, estimate: Trajectory, reference: Trajectory, max_difference: float) -> str:
    shortest = min(len(estimate), len(reference))
    if shortest < FEWEST_PAIRS:
        mend = f"give a trajectory of at least {FEWEST_PAIRS} poses"
    elif estimate.timestamps[0] > reference.timestamps[-1] or reference.timestamps[0] > estimate.timestamps[-1]:
        mend = "give --time-offset auto if both are of one recording"
    else:
        mend = "give a larger --max-difference, or --time-offset auto if their clocks differ"
    needed = max(FEWEST_PAIRS, math.ceil(SMALLEST_SHARE * shortest))
    return (
        f"{pairs} of {len(estimate)} estimated poses ({_span(estimate)}) lie within {1000 * max_difference:g} ms of a "
        f"pose of the reference ({_span(reference)}, {len(reference)} poses); at least {needed} are needed: {mend}"
    )


def fit_scale(estimate: Trajectory, reference: Trajectory, max_difference: float = LARGEST_GAP) -> float:
    """Scale of the estimate's positions to the reference's (Umeyama 1991, eq. 42).

    Raises:
        DatasetError: No match in time, or no motion.
    """
    _, Ts_estimate, Ts_reference = pair_poses(estimate, reference, max_difference)
    positions, targets = Ts_estimate[:, :3, 3], Ts_reference[:, :3, 3]
    T, _ = umeyama(targets, positions)
    positions, targets = positions - positions.mean(axis=0), targets - targets.mean(axis=0)
    variance = float((positions**2).sum())
    scale = float((targets * (positions @ T[:3, :3].T)).sum()) / variance if variance else 0.0
    if not scale > 0:
        raise DatasetError("the positions do not determine a scale: one of the trajectories does not move")
    return scale


def adjusted(estimate: Trajectory, seconds: float = 0.0, scale: float = 1.0) -> Trajectory:
    """Trajectory with ``seconds`` added and positions times ``scale``."""
    Ts = estimate.Ts_world_camera.copy()
    Ts[:, :3, 3] *= scale
    return Trajectory(estimate.timestamps + seconds, Ts)


def ate(
    estimate: Trajectory, reference: Trajectory, align: Align = "se3", max_difference: float = LARGEST_GAP
) -> AteResult:
    """Absolute trajectory error: E_i = T_reference_i^-1 A T_estimate_i with one rigid motion A for all i.

    Errors are E_i's translation and rotation angle.

    Args:
        align: ``se3``: A minimises squared distances of positions, without scale (Umeyama 1991, as the TUM script); an
            undetermined rotation is the mean between orientations. ``origin``: A maps the first pose onto its partner.
            ``none``: A is the identity.
    """
    if align not in get_args(Align):
        raise ConfigError(f"align is {align!r}; expected one of {', '.join(get_args(Align))}")
    stamps, Ts_estimate, Ts_reference = pair_poses(estimate, reference, max_difference)
    alignment: str = align
    T = np.eye(4)
    if align == "origin":
        T = Ts_reference[0] @ se3.inverse(Ts_estimate[0])
    elif align == "se3":
        T, alignment = _align(Ts_estimate, Ts_reference)
    E = se3.inverse(Ts_reference) @ (T @ Ts_estimate)
    return AteResult.of(stamps, E, T, alignment)


def rpe(
    estimate: Trajectory,
    reference: Trajectory,
    delta: float = 1.0,
    unit: Unit = "s",
    max_difference: float = LARGEST_GAP,
) -> RpeResult:
    """Relative pose error: E_ij = (T_reference_i^-1 T_reference_j)^-1 (T_estimate_i^-1 T_estimate_j).

    Every pose i has one partner j one ``delta`` later, as in the TUM script with ``--fixed_delta``, in metres along the
    reference path. A pair is dropped if it misses ``delta`` by half the median time step (at least ``max_difference``)
    for ``s``, a tenth for ``m``. The script pairs across gaps of lost frames, and drops pairs that end at the last
    pose.
    """
    times, motion_estimate, motion_reference = _motions(estimate, reference, delta, unit, max_difference)
    return RpeResult.of(times, se3.inverse(motion_reference) @ motion_estimate, delta, unit)


def body_rotation(
    estimate: Trajectory, reference: Trajectory, max_difference: float = LARGEST_GAP
) -> tuple[Numbers, float, float]:
    """Rotation between reference body and camera, for reference poses of another body:

    ``r_camera = R_camera_body r_body`` for rotation vectors in one second.

    Returns:
        R_camera_body (3, 3), least squares (Kabsch 1976), and root mean square rotational RPE per second without and
        with it, degrees.

    Raises:
        DatasetError: No match in time, or shorter than a second.
    """
    _, motions, motions_reference = _motions(estimate, reference, 1.0, "s", max_difference)
    turns, turns_reference = se3.log_all(motions)[:, 3:], se3.log_all(motions_reference)[:, 3:]
    R = se3.nearest_rotation(turns.T @ turns_reference)
    turned = np.tile(np.eye(4), (len(motions), 1, 1))
    turned[:, :3, :3] = R.T @ motions[:, :3, :3] @ R
    before, after = (
        np.degrees(se3.rotation_angles(se3.inverse(motions_reference) @ moved)) for moved in (motions, turned)
    )
    return R, Statistics.of(before).rmse, Statistics.of(after).rmse


def _motions(
    estimate: Trajectory, reference: Trajectory, delta: float, unit: Unit, max_difference: float
) -> tuple[Numbers, Numbers, Numbers]:
    if unit not in get_args(Unit) or not (np.isfinite(delta) and delta > 0):
        raise ConfigError(f"delta is {delta} {unit}; expected a positive number of {' or '.join(get_args(Unit))}")
    stamps, Ts_estimate, Ts_reference = pair_poses(estimate, reference, max_difference)
    if unit == "s":
        position, tolerance = stamps, max(max_difference, float(np.median(np.diff(stamps))) / 2)
    else:
        steps = np.linalg.norm(np.diff(Ts_reference[:, :3, 3], axis=0), axis=1)
        position, tolerance = np.concatenate([[0.0], np.cumsum(steps)]), PATH_TOLERANCE * delta
    i, j = _partners(position, delta, tolerance)
    if not len(i):
        length = position[-1] - position[0]
        raise DatasetError(f"no two poses are {delta:g} {unit} apart; the compared part is {length:.3g} {unit} long")
    return stamps[i], se3.inverse(Ts_estimate[i]) @ Ts_estimate[j], se3.inverse(Ts_reference[i]) @ Ts_reference[j]


def trajectory_figures(
    estimate: Trajectory, reference: Trajectory, align: Align = "se3", max_difference: float = LARGEST_GAP
) -> dict[str, float | int | str | None]:
    """All metrics of a trajectory by name and unit.

    * ``covered_share``: share of the reference's duration without gaps
    * ATE; ``drift_rmse_m`` and ``rotation_rmse_deg`` after aligning the first pose only
    * RPE per second and per metre, or None with ``rpe_per_s_missing`` or ``rpe_per_m_missing``
    """
    absolute = ate(estimate, reference, align, max_difference)
    from_start = ate(estimate, reference, "origin", max_difference)
    duration = float(reference.timestamps[-1] - reference.timestamps[0])
    out: dict[str, float | int | str | None] = {"pairs": absolute.num_pairs, "alignment": absolute.alignment}
    out |= {"covered_share": covered_time(absolute.timestamps) / duration}
    out |= _figures(absolute, "ate_{}_m", "ate_rot_{}_deg")
    out |= {"drift_rmse_m": from_start.rmse, "rotation_rmse_deg": from_start.rot_deg.rmse}
    units: tuple[Unit, ...] = ("s", "m")
    for unit in units:
        names = f"rpe_trans_{{}}_m_per_{unit}", f"rpe_rot_{{}}_deg_per_{unit}"
        try:
            out |= _figures(rpe(estimate, reference, 1.0, unit, max_difference), *names)
        except DatasetError as error:
            out |= {name.format(key): None for name in names for key in STATISTICS}
            out[f"rpe_per_{unit}_missing"] = str(error)
    return out


def gaps(timestamps: Numbers) -> NDArray[np.intp]:
    """Indices of the poses after a gap of lost frames."""
    steps = np.diff(timestamps)
    return np.flatnonzero(steps > LONGEST_STEP * np.median(steps)) + 1 if len(steps) else np.array([], np.intp)


def covered_time(timestamps: Numbers) -> float:
    """Seconds between consecutive poses, without gaps."""
    after = gaps(timestamps)
    return float(timestamps[-1] - timestamps[0] - (timestamps[after] - timestamps[after - 1]).sum())


def _figures(errors: PoseErrors, trans: str, rot: str) -> dict[str, float]:
    return {name.format(key): getattr(statistics, key)
            for name, statistics in ((trans, errors.trans), (rot, errors.rot_deg)) for key in STATISTICS}  # fmt: skip


def path_figures(estimate: Trajectory) -> dict[str, float]:
    """Number of poses, duration and path length."""
    steps = np.linalg.norm(np.diff(estimate.Ts_world_camera[:, :3, 3], axis=0), axis=1)
    duration = float(estimate.timestamps[-1] - estimate.timestamps[0])
    return {"poses": len(estimate), "duration_s": round(duration, 6), "path_length_m": round(float(steps.sum()), 6)}


RUN_FIGURES = "ate_rmse_m", "ate_rot_rmse_deg", "rpe_trans_rmse_m_per_s", "rpe_rot_rmse_deg_per_s"


def accuracy(
    estimate: Trajectory, reference: Trajectory, keys: tuple[str, ...] = RUN_FIGURES
) -> dict[str, float | str | None]:
    """Selected ``trajectory_figures``, six digits; without comparison None, and ``accuracy_missing`` is the reason."""
    out: dict[str, float | str | None] = dict.fromkeys(keys)
    try:
        figures = trajectory_figures(estimate, reference)
    except DatasetError as error:
        return out | {"accuracy_missing": str(error)}
    for key in keys:
        value = figures[key]
        out[key] = round(value, 6) if isinstance(value, float) else None
    if "rpe_per_s_missing" in figures:
        out["accuracy_missing"] = str(figures["rpe_per_s_missing"])
    return out


def _align(Ts_estimate: Numbers, Ts_reference: Numbers) -> tuple[Numbers, str]:
    positions, targets = Ts_estimate[:, :3, 3], Ts_reference[:, :3, 3]
    T, spread = umeyama(targets, positions)
    if spread[1] > SMALLEST_SPREAD * max(1.0, spread[0]):
        return T, "se3"
    rotations = Ts_reference[:, :3, :3] @ np.swapaxes(Ts_estimate[:, :3, :3], 1, 2)
    T[:3, :3] = se3.nearest_rotation(rotations.mean(axis=0))  # chordal mean, Hartley et al. 2013, section 5.3
    T[:3, 3] = targets.mean(axis=0) - T[:3, :3] @ positions.mean(axis=0)
    return T, "se3-orientations"


def _partners(position: Numbers, delta: float, tolerance: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    wanted = position + delta
    after = np.clip(np.searchsorted(position, wanted), 1, len(position) - 1)
    before = after - 1
    j = np.where(wanted - position[before] <= position[after] - wanted, before, after)
    i = np.arange(len(position))
    keep = (j > i) & (np.abs(position[j] - wanted) <= tolerance + 1e-9)
    return i[keep], j[keep]


def _span(trajectory: Trajectory) -> str:
    return f"{trajectory.timestamps[0]:.3f} to {trajectory.timestamps[-1]:.3f} s"
