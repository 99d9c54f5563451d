"""Adjustment of the calibration and the keyframe poses (bundle adjustment over dense pairs)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SensorConfig
from dudmap.core.backends.cpu.color_pairs import POSE, SHARED, UNKNOWNS, linearize_pairs
from dudmap.core.backends.cpu.linear_systems import solved
from dudmap.core.backends.median import median
from dudmap.core.backends.parameters import SensorNoise, single
from dudmap.core.calibration.keyframes import SAME_SURFACE, ColorKeyframe, color_levels
from dudmap.core.geometry import se3
from dudmap.core.geometry.calibration import NUM_PARAMETERS, Calibration

MAX_ANGLE, MIN_ANGLE = np.radians(30), np.radians(2)
"""Rotation limits between the frames of a pair, radians: separation of both cameras, and overlap."""
MIN_FASTER = 0.2
"""Smallest velocity difference (m/s, rad/s) of a pair without rotation or translation."""
MAX_SHIFT = 0.35
"""Largest translation between the frames over the median depth."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two frames that see the same surfaces."""

    first: ColorKeyframe
    second: ColorKeyframe


class PairSet:
    """Pairs of F frames; images and points (every ``stride``-th) stacked for the kernel.

    Attributes:
        numbers: (P, 2) int64 frames of every pair, in order of time.
        Ts_camera_world: (F, 4, 4) tracked poses.
        depths: (F, h, w) float32; ``images``: (F, h, w) float32 filtered intensities per size, coarse to fine;
            ``brightness``: (F, h, w) float32 unfiltered, smallest size.
        points, tangents: (n, 3) and (n, 6) float32 of all frames; ``starts``: (F + 1,) start of each frame in them.
        residual_starts: (P + 1,) start of each pair's residuals, one per point of its first frame.
        twists: (F, 6) float32 velocities; ``color_offsets``: (F,) float32.
        places: (P, 25) indices of each pair's unknowns: parameters, poses of both frames. ``products``: (P n n,) flat
            indices of their products, by the first unknown.
    """

    def __init__(self, pairs: Sequence[Pair], stride: int = 1) -> None:
        by_time = {frame.timestamp: frame for pair in pairs for frame in (pair.first, pair.second)}
        number = {timestamp: n for n, timestamp in enumerate(sorted(by_time))}
        frames = [by_time[timestamp] for timestamp in number]
        self.numbers = np.array([(number[pair.first.timestamp], number[pair.second.timestamp]) for pair in pairs])
        self.Ts_camera_world = se3.inverse(np.stack([frame.T_world_camera for frame in frames]))
        self.camera = frames[0].camera
        self.depths = np.stack([frame.depth for frame in frames])
        self.images = [np.stack(images) for images in zip(*(frame.intensities for frame in frames), strict=True)]
        self.brightness = np.stack([frame.brightness for frame in frames])
        self.points = np.concatenate([frame.points[::stride] for frame in frames])
        self.tangents = np.concatenate([frame.tangents[::stride] for frame in frames])
        counts = np.array([len(frame.points[::stride]) for frame in frames])
        self.starts = np.concatenate([[0], np.cumsum(counts)])
        self.residual_starts = np.concatenate([[0], np.cumsum(counts[self.numbers[:, 0]])])
        self.twists = np.stack([frame.velocity for frame in frames]).astype(np.float32)
        self.color_offsets = np.array([frame.color_offset for frame in frames])
        own = np.broadcast_to(np.arange(NUM_PARAMETERS), (len(pairs), NUM_PARAMETERS))
        poses = NUM_PARAMETERS + POSE * self.numbers[:, :, None] + np.arange(POSE)
        self.places = np.concatenate([own, poses.reshape(len(pairs), -1)], axis=1)
        self.products = {
            begin: ((NUM_PARAMETERS - begin + POSE * len(frames)) * wanted[:, :, None] + wanted[:, None, :]).reshape(-1)
            for begin, wanted in ((begin, self.places[:, begin:] - begin) for begin in (0, SHARED))
        }

    def __len__(self) -> int:
        return len(self.numbers)


def select_pairs(keyframes: Sequence[ColorKeyframe], count: int) -> list[Pair]:
    """Up to ``count`` overlapping pairs at different angles, positions or velocities, drawn evenly."""
    second, first = np.tril_indices(len(keyframes), -1)
    return _drawn(keyframes, first, second, count)


def select_across(before: Sequence[ColorKeyframe], after: Sequence[ColorKeyframe], count: int) -> list[Pair]:
    """Up to ``count`` such pairs, each with one frame of each group."""
    second, first = np.indices((len(after), len(before))).reshape(2, -1)
    return _drawn([*before, *after], first, len(before) + second, count)


def _drawn(
    keyframes: Sequence[ColorKeyframe], first: NDArray[np.intp], second: NDArray[np.intp], count: int
) -> list[Pair]:
    if not len(first):
        return []
    poses = np.stack([frame.T_world_camera for frame in keyframes])
    velocities = np.stack([frame.velocity for frame in keyframes])
    reach = np.array([np.median(frame.points[:, 2]) if len(frame.points) else 0.0 for frame in keyframes])[first]
    Ts = se3.inverse(poses[second]) @ poses[first]
    angles, shifts = se3.rotation_angles(Ts), np.linalg.norm(Ts[:, :3, 3], axis=1)
    faster = np.abs(velocities[first] - velocities[second]).max(axis=1)
    overlap = (angles <= MAX_ANGLE) & (shifts <= MAX_SHIFT * reach)
    apart = (angles > MIN_ANGLE) | (shifts > np.sin(MIN_ANGLE) * reach) | (faster > MIN_FASTER)
    found = np.flatnonzero(overlap & apart)
    order = np.random.default_rng(0).permutation(len(found))[:count]
    return [Pair(keyframes[int(first[n])], keyframes[int(second[n])]) for n in found[np.sort(order)].tolist()]


def standard_error(values: NDArray[np.float64], numbers: NDArray[np.int64]) -> float:
    """Standard error of the sum of values (P,) over pairs of frames ``numbers`` (P, 2). The errors of pairs with a
    common frame are correlated (Aronow, Samii and Assenova 2015)."""
    apart = values - values.mean()
    of_frames = sum(np.bincount(frames, apart, numbers.max() + 1) for frames in numbers.T)
    squares = np.square(apart).sum()
    return float(np.sqrt(max(np.square(of_frames).sum() - squares, squares)))


PRIOR_SIGMA = np.array([0.03, 0.015, 0.005] + [np.radians(2)] * 3 + [0.05] + [0.005] * 2 + [0.1, 0.3] + [0.03, 0.03])
"""Prior standard deviations of an unknown camera, in units of ``PARAMETERS`` (principal point: share of the width): 15
to 32 mm from the depth camera, focal lengths within 10 %, 33 ms per frame."""
POSE_SIGMA = np.array([0.02] * 3 + [np.radians(1)] * 3)
"""Standard deviation of a tracked pose, metres and radians, in unobserved directions."""
LIGHT_SIGMA = np.array([0.3, 0.1])
"""Standard deviations of gain and offset between two images."""
CORRELATED = 50.0
"""Neighbouring points with correlated errors that count as one against the priors."""
COST_SCALES = (0.01, 1.0)
"""Fixed standard deviations of intensity (0..1, common cameras) and depth differences (over sigma(z)) in the cost of a
pair."""
FIRST_SCALES, LEAST_SCALE = (0.05, 1.0), 1e-3
"""Initial standard deviations of an adjustment, and the lower bound of both."""
HUBER = 1.345
"""Constant of the robust weight, standard deviations: 95 % efficiency for Gaussian errors."""
ITERATIONS, COARSE_ITERATIONS = 6, 4
"""Gauss-Newton steps at the largest image size, and at smaller ones."""
STEADY = 2
"""Consecutive small steps for convergence."""
FIT_ITERATIONS = 3
"""Steps per image size that fit poses to a known calibration."""
CONVERGED, CONVERGED_COARSE = 0.01, 0.1
"""Step in prior standard deviations at convergence, largest size and smaller ones."""


@dataclass(frozen=True, eq=False)
class Fit:
    """State of an adjustment, from which another may start.

    Attributes:
        Ts_camera_world: (F, 4, 4) of every frame.
        light: (P, 2) gain and offset of the second image of every pair over the first.
        scales: Standard deviations of intensity (0..1) and depth differences (over sigma(z)).
    """

    calibration: Calibration
    Ts_camera_world: NDArray[np.float64]
    light: NDArray[np.float64]
    scales: tuple[float, float] = FIRST_SCALES

    @classmethod
    def tracked(cls, pairs: PairSet, calibration: Calibration) -> "Fit":
        """Initial state: tracked poses, equal light."""
        return cls(calibration, pairs.Ts_camera_world, np.tile([1.0, 0.0], (len(pairs), 1)))

    def moved(
        self, pairs: PairSet, step: NDArray[np.float64], parts: "_PairSystems", scales: tuple[float, float]
    ) -> "Fit":
        """State after a step (13 + 6 F,) of parameters and poses."""
        return Fit(
            self.calibration.retract(step[:NUM_PARAMETERS]) if step[:NUM_PARAMETERS].any() else self.calibration,
            se3.exp_all(step[NUM_PARAMETERS:].reshape(-1, POSE)) @ self.Ts_camera_world,
            self.light - parts.light_step - _times(parts.light_slope, step[pairs.places[:, parts.begin :]]),
            scales,
        )


@dataclass(frozen=True, eq=False)
class _PairSystems:
    """Normal equations of all pairs without gain and offset.

    Attributes:
        H, b: (P, n, n) and (P, n) in parameters and both poses, n = 25, or in the poses alone, n = 12.
        light_slope, light_step: (P, 2, n) and (P, 2): the step of gain and offset is -(light_step + light_slope step).
        residuals: (2, n) of all pairs, see ``linearize_pair``.
    """

    H: NDArray[np.float64]
    b: NDArray[np.float64]
    light_slope: NDArray[np.float64]
    light_step: NDArray[np.float64]
    residuals: NDArray[np.float32]

    @property
    def begin(self) -> int:
        return SHARED + 2 * POSE - self.b.shape[1]


@dataclass(frozen=True, eq=False)
class _System:
    H: NDArray[np.float64]
    b: NDArray[np.float64]
    parts: _PairSystems

    def step(self, free: NDArray[np.bool_]) -> NDArray[np.float64]:
        begin, out = self.parts.begin, np.zeros(len(self.b) + self.parts.begin)
        moves = np.concatenate([free, np.ones(len(out) - NUM_PARAMETERS, dtype=bool)])
        known = moves[begin:]
        out[moves] = -solved(self.H[np.ix_(known, known)], self.b[known])
        return out


class Adjustment:
    """Robust Gauss-Newton over the calibration, the poses of the frames, and the light of the pairs.

    A frame has one pose in all its pairs: a pose per pair would absorb the translation between the cameras.
    ``given``: initial calibration, mean of the priors. ``levels``: halvings of the colour images, coarse to fine.
    """

    def __init__(self, given: Calibration, sensor: SensorConfig) -> None:
        self.given = given
        self.noise = single(SensorNoise(sensor.sigma_base, sensor.sigma_scale))
        self.levels = color_levels(given.camera)
        sigma = PRIOR_SIGMA.copy()
        sigma[7:9] *= given.camera.width
        self.prior = CORRELATED * sigma**-2

    def solve(
        self, pairs: PairSet, start: Fit, free: NDArray[np.bool_], levels: Sequence[int] = ()
    ) -> tuple[Fit, NDArray[np.float64]]:
        """Fit of the ``free`` parameters (13,) bool, and the covariance (13, 13) of all."""
        fit, system = start, None
        levels = levels or self.levels
        for level in levels:
            settled = (CONVERGED if level == levels[-1] else CONVERGED_COARSE) * np.sqrt(CORRELATED / self.prior)
            small = 0
            for _ in range(ITERATIONS if level == levels[-1] else COARSE_ITERATIONS):
                system = self._linearize(pairs, fit, level, fit.scales)
                step = system.step(free)
                fit = fit.moved(pairs, step, system.parts, new_scales(system.parts.residuals, fit.scales))
                small = small + 1 if np.all(np.abs(step[:NUM_PARAMETERS]) < settled) else 0
                if small == STEADY:
                    break
        assert system is not None
        return fit, self._covariance(pairs, system, int(np.count_nonzero(free)))

    def with_poses(self, pairs: PairSet, start: Fit, levels: Sequence[int] = ()) -> tuple[Fit, NDArray[np.float32]]:
        """Fit of the poses alone, and the last residuals (2, n).

        ``levels``: image sizes, all by default. Fine images suffice near the fitted calibration.
        """
        fit, residuals = start, np.empty((2, 0), np.float32)
        for level in levels or self.levels:
            for _ in range(FIT_ITERATIONS):
                system = self._linearize(pairs, fit, level, COST_SCALES, known=True)
                fit = fit.moved(pairs, system.step(np.zeros(NUM_PARAMETERS, dtype=bool)), system.parts, COST_SCALES)
                residuals = system.parts.residuals
        return replace(fit, scales=new_scales(residuals, COST_SCALES)), residuals

    def costs(self, pairs: PairSet, start: Fit, levels: Sequence[int] = ()) -> NDArray[np.float64]:
        """Mean robust costs (2, P) of intensities and depths, with fitted poses; see ``with_poses``."""
        _, residuals = self.with_poses(pairs, start, levels)
        scaled = np.abs(residuals) / np.array(COST_SCALES, np.float32)[:, None]
        robust = np.where(scaled < HUBER, scaled * scaled, HUBER * (2 * scaled - HUBER))
        seen = np.isfinite(robust)
        of_pair = pairs.residual_starts[:-1]
        sums = np.add.reduceat(np.where(seen, robust, 0), of_pair, axis=1, dtype=np.float64)
        return sums / np.maximum(np.add.reduceat(seen, of_pair, axis=1, dtype=np.int64), 1)

    def _covariance(self, pairs: PairSet, system: _System, free: int) -> NDArray[np.float64]:
        """Sandwich covariance (13, 13) with the scores of frames."""
        own, rest = slice(0, NUM_PARAMETERS), slice(NUM_PARAMETERS, None)
        # Schur complement of the poses, for the curvature and for every score
        across = solved(system.H[rest, rest], system.H[rest, own]).T
        bread = np.linalg.inv(system.H[own, own] - across @ system.H[rest, own])
        scores = np.zeros((len(pairs.Ts_camera_world), NUM_PARAMETERS))
        of_pose = across.T.reshape(-1, POSE, NUM_PARAMETERS)[pairs.numbers]  # (P, 2, 6, 13)
        b_pose = system.parts.b[:, own.stop :].reshape(-1, 2, POSE)
        score = system.parts.b[:, own] - np.einsum("pfkc,pfk->pc", of_pose, b_pose)
        for frames in pairs.numbers.T:
            np.add.at(scores, frames, score)
        few = len(scores) / max(len(scores) - free, 1)
        meat = few * scores.T @ scores + CORRELATED * np.diag(self.prior)
        return bread @ meat @ bread

    def _linearize(
        self, pairs: PairSet, fit: Fit, level: int, scales: tuple[float, float], *, known: bool = False
    ) -> _System:
        begin, tracked = SHARED if known else 0, pairs.Ts_camera_world
        parts = self._linearize_pairs(pairs, fit, level, scales, begin)
        places, size = pairs.places[:, begin:] - begin, NUM_PARAMETERS - begin + POSE * len(tracked)
        products = np.bincount(pairs.products[begin], parts.H.reshape(-1), size * size)
        H = np.asarray(products, np.float64).reshape(size, size)
        b = np.asarray(np.bincount(places.reshape(-1), parts.b.reshape(-1), size), np.float64)
        diagonal = np.concatenate([self.prior[begin:], np.tile(CORRELATED * POSE_SIGMA**-2, len(tracked))])
        away = se3.log_all(fit.Ts_camera_world @ se3.inverse(tracked)).reshape(-1)
        H[np.arange(size), np.arange(size)] += diagonal
        b += diagonal * (away if known else np.concatenate([self.given.step_to(fit.calibration), away]))
        return _System(H, b, parts)

    def _linearize_pairs(
        self, pairs: PairSet, fit: Fit, level: int, scales: tuple[float, float], begin: int
    ) -> _PairSystems:
        first, second = pairs.numbers.T
        Ts, calibration = fit.Ts_camera_world[second] @ se3.inverse(fit.Ts_camera_world[first]), fit.calibration
        H, b = np.empty((len(pairs), UNKNOWNS, UNKNOWNS)), np.empty((len(pairs), UNKNOWNS))
        residuals = np.empty((2, pairs.residual_starts[-1]), np.float32)
        linearize_pairs(
            pairs.numbers, pairs.starts, pairs.points, pairs.tangents, Ts[:, :3].astype(np.float32), pairs.depths,
            pairs.camera.intrinsics, pairs.images[self.levels.index(level)], pairs.twists,
            (pairs.color_offsets + calibration.delay).astype(np.float32),
            calibration.T_color_depth[:3].astype(np.float32), calibration.camera.scaled(level).intrinsics,
            calibration.lens.astype(np.float32), np.float32(1 / (1 << level)),
            np.float32(calibration.depth_readout + calibration.readout),
            fit.light.astype(np.float32), np.float32(SAME_SURFACE), self.noise, np.float32(1 / scales[0]),
            np.float32(1 / scales[1]), np.float32(HUBER), begin, pairs.residual_starts, residuals, H,
            b,
        )  # fmt: skip
        return _without_light(H, b, fit.light, Ts, residuals, begin)


def _without_light(
    H: NDArray[np.float64],
    b: NDArray[np.float64],
    light: NDArray[np.float64],
    Ts: NDArray[np.float64],
    residuals: NDArray[np.float32],
    begin: int,
) -> _PairSystems:
    """Normal equations of all pairs without gain and offset.

    ``H``, ``b``: (P, 21, 21), (P, 21) of ``linearize_pair``. ``light``: (P, 2) gains and offsets. ``Ts``: (P, 4, 4)
    second camera from first. ``begin``: first unknown parameter.
    """
    known, of_light, own = slice(begin, SHARED + POSE), slice(SHARED + POSE, UNKNOWNS), SHARED - begin
    prior = CORRELATED * LIGHT_SIGMA**-2
    inverse = np.asarray(np.linalg.inv(H[:, of_light, of_light] + np.diag(prior)), np.float64)
    light_step = _times(inverse, b[:, of_light] + prior * (light - [1.0, 0.0]))
    light_slope = inverse @ H[:, of_light, known]
    reduced = H[:, known, known] - H[:, known, of_light] @ light_slope
    gradient = b[:, known] - _times(H[:, known, of_light], light_step)
    # T exp(-d_first) = exp(-Ad(T) d_first) T: a twist of the first frame becomes a twist of the relative pose
    M = np.zeros((len(Ts), own + POSE, own + 2 * POSE))
    M[:, :own, :own], M[:, own:, -POSE:] = np.eye(own), np.eye(POSE)
    M[:, own:, own : own + POSE] = -se3.adjoint(Ts)
    M_transposed = np.swapaxes(M, 1, 2)
    return _PairSystems(
        M_transposed @ reduced @ M, _times(M_transposed, gradient), light_slope @ M, light_step, residuals
    )


def _times(matrices: NDArray[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return (matrices @ vectors[:, :, None])[:, :, 0]


def new_scales(residuals: NDArray[np.float32], scales: tuple[float, float]) -> tuple[float, float]:
    """Robust standard deviations of intensity and depth differences (2, n); unchanged without finite differences."""
    known = (np.abs(values[np.isfinite(values)]) for values in residuals)
    new = [1.4826 * float(median(r)) if len(r) else scale for r, scale in zip(known, scales, strict=True)]
    return max(new[0], LEAST_SCALE), max(new[1], LEAST_SCALE)
