"""Adjustment of the calibration together with the poses of the keyframes (bundle adjustment over dense pairs)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SensorConfig
from dudmap.core.backends.cpu.color_pairs import SHARED, UNKNOWNS, linearize_pair
from dudmap.core.backends.parameters import SensorNoise, single
from dudmap.core.calibration.keyframes import SAME_SURFACE, color_levels
from dudmap.core.calibration.pairs import Pair
from dudmap.core.geometry import se3
from dudmap.core.geometry.calibration import NUM_PARAMETERS, Calibration

PRIOR_SIGMA = np.array([0.03] * 3 + [np.radians(2)] * 3 + [0.05] + [0.005] * 2 + [0.1, 0.3] + [0.03, 0.03])
"""Standard deviations of a camera about which nothing is known but what is given, in the units of ``PARAMETERS``; that
of the principal point is a share of the width. Colour cameras lie 15 to 32 mm from their depth cameras; uncorrected
focal lengths differ by up to 10 %; a lens that is not corrected bends by some per cent; a frame at 30 Hz takes
33 ms."""
POSE_SIGMA = np.array([0.02] * 3 + [np.radians(1)] * 3)
"""Standard deviation of the tracked pose of a frame, metres and radians: it binds only directions in which the images
say nothing."""
LIGHT_SIGMA = np.array([0.3, 0.1])
"""Standard deviations of gain and offset between two images."""
CORRELATED = 50.0
"""Neighbouring points whose errors are correlated and which together count as one against the priors."""
COST_SCALES = (0.01, 1.0)
"""Standard deviations of intensity (0..1) and depth differences (over sigma(z)) for the cost of a pair, fixed so that
costs are comparable; 0.01 is the noise of common colour cameras."""
FIRST_SCALES, LEAST_SCALE = (0.05, 1.0), 1e-3
"""The same at the start of an adjustment, which estimates them, and the least."""
HUBER = 1.345
"""Constant of the robust weight, standard deviations: 95 % efficiency for Gaussian errors."""
ITERATIONS = 8
"""Largest number of Gauss-Newton steps per image size."""
FIT_ITERATIONS = 3
"""Steps per image size by which poses are fitted to a known calibration."""
SETTLED, SETTLED_COARSE = 0.01, 0.1
"""A step below this many prior standard deviations in every parameter ends the largest image size; the smaller ones
only lead to the next."""
POSE = 6


class _State:
    """What is adjusted: the calibration, the pose of every frame, gain and offset of every pair.

    Attributes:
        calibration: Current estimate.
        frames: (P, 2) numbers of the two frames of every pair.
        Ts_camera_world: (F, 4, 4) of every frame; ``tracked``: as tracked.
        light: (P, 2) gain and offset of the second image of every pair over the first.
        places: (P, 25) where the unknowns of every pair stand among all: parameters, poses of both frames.
    """

    def __init__(self, pairs: Sequence[Pair], calibration: Calibration) -> None:
        self.calibration = calibration
        by_time = {frame.timestamp: frame for pair in pairs for frame in (pair.first, pair.second)}
        number = {timestamp: n for n, timestamp in enumerate(sorted(by_time))}
        self.frames = np.array([(number[pair.first.timestamp], number[pair.second.timestamp]) for pair in pairs])
        self.tracked = se3.inverse(np.stack([by_time[timestamp].T_world_camera for timestamp in number]))
        self.Ts_camera_world = self.tracked
        self.light = np.tile([1.0, 0.0], (len(pairs), 1))
        own = np.broadcast_to(np.arange(NUM_PARAMETERS), (len(pairs), NUM_PARAMETERS))
        poses = NUM_PARAMETERS + POSE * self.frames[:, :, None] + np.arange(POSE)
        self.places = np.concatenate([own, poses.reshape(len(pairs), -1)], axis=1)

    @property
    def Ts_second_first(self) -> NDArray[np.float64]:
        """Relative poses (P, 4, 4) of the pairs."""
        first, second = self.frames.T
        return self.Ts_camera_world[second] @ se3.inverse(self.Ts_camera_world[first])

    def move(self, step: NDArray[np.float64], parts: "_PairSystems") -> None:
        """Apply a step (13 + 6 F,) of parameters and poses, and what follows from it for gains and offsets."""
        self.calibration = self.calibration.retract(step[:NUM_PARAMETERS])
        self.Ts_camera_world = se3.exp_all(step[NUM_PARAMETERS:].reshape(-1, POSE)) @ self.Ts_camera_world
        self.light = self.light - parts.light_step - _times(parts.light_slope, step[self.places])


@dataclass(frozen=True, eq=False)
class _PairSystems:
    """Normal equations of all pairs, each with its gain and offset eliminated.

    Attributes:
        H, b: (P, 25, 25) and (P, 25) in the parameters and the poses of the first and the second frame.
        light_slope, light_step: (P, 2, 25) and (P, 2), minus the step of gain and offset is light_step + light_slope
            step.
        residuals: P times (2, n), see ``linearize_pair``.
    """

    H: NDArray[np.float64]
    b: NDArray[np.float64]
    light_slope: NDArray[np.float64]
    light_step: NDArray[np.float64]
    residuals: list[NDArray[np.float32]]


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations (13 + 6 F) of all pairs with all priors, and the scales of both residuals."""

    H: NDArray[np.float64]
    b: NDArray[np.float64]
    parts: _PairSystems
    scales: tuple[float, float]

    def step(self, free: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Gauss-Newton step in all poses and in the parameters that are free."""
        moves = np.concatenate([free, np.ones(len(self.b) - NUM_PARAMETERS, dtype=bool)])
        out = np.zeros(len(self.b))
        out[moves] = -_solved(self.H[np.ix_(moves, moves)], self.b[moves])
        return out


class Adjustment:
    """Robust Gauss-Newton over the calibration, the poses of the frames, and the light of the pairs.

    The poses belong to the frames and not to the pairs: every pair of a frame bears on the same pose, which is thereby
    known several times better than from one pair, and with it the translation between the cameras, which most looks
    like an error of the poses.

    Args:
        given: The calibration as given, the mean of the priors.
        sensor: Noise of the depth readings.

    Attributes:
        levels: Halvings of the colour images, coarse to fine.
    """

    def __init__(self, given: Calibration, sensor: SensorConfig) -> None:
        self.given = given
        self.sensor = sensor
        self.levels = color_levels(given.camera)
        sigma = PRIOR_SIGMA.copy()
        sigma[7:9] *= given.camera.width
        self.prior = CORRELATED * sigma**-2

    def solve(
        self, pairs: Sequence[Pair], start: Calibration, free: NDArray[np.bool_], levels: Sequence[int] = ()
    ) -> tuple[Calibration, NDArray[np.float64]]:
        """Calibration from coarse to fine over the free parameters (13,) bool, and the covariance (13, 13) that all
        would have."""
        state, scales, system = _State(pairs, start), FIRST_SCALES, None
        levels = levels or self.levels
        for level in levels:
            settled = (SETTLED if level == levels[-1] else SETTLED_COARSE) * np.sqrt(CORRELATED / self.prior)
            for _ in range(ITERATIONS):
                system = self._linearize(pairs, state, level, scales)
                step = system.step(free)
                state.move(step, system.parts)
                scales = system.scales
                if np.all(np.abs(step[:NUM_PARAMETERS]) < settled):
                    break
        assert system is not None
        return state.calibration, self._covariance(system, state, int(np.count_nonzero(free)))

    def costs(self, pairs: Sequence[Pair], calibration: Calibration) -> NDArray[np.float64]:
        """Mean robust cost (P,) of pairs whose poses are fitted with a calibration."""
        state, system = _State(pairs, calibration), None
        for level in self.levels[-2:]:
            for _ in range(FIT_ITERATIONS):
                system = self._linearize(pairs, state, level, COST_SCALES)
                state.move(system.step(np.zeros(NUM_PARAMETERS, dtype=bool)), system.parts)
        assert system is not None
        return np.array(
            [sum(_robust_mean(r / scale) for r, scale in zip(residuals, COST_SCALES, strict=True))
             for residuals in system.parts.residuals]
        )  # fmt: skip

    def _covariance(self, system: _System, state: _State, free: int) -> NDArray[np.float64]:
        """Sandwich (13, 13) with the scores of frames as its meat."""
        own, rest = slice(0, NUM_PARAMETERS), slice(NUM_PARAMETERS, None)
        # the poses follow the parameters: Schur complement, for the curvature and for every score
        across = _solved(system.H[rest, rest], system.H[rest, own]).T
        bread = np.linalg.inv(system.H[own, own] - across @ system.H[rest, own])
        scores = np.zeros((len(state.tracked), NUM_PARAMETERS))
        of_pose = across.T.reshape(-1, POSE, NUM_PARAMETERS)[state.frames]  # (P, 2, 6, 13)
        b_pose = system.parts.b[:, own.stop :].reshape(-1, 2, POSE)
        score = system.parts.b[:, own] - np.einsum("pfkc,pfk->pc", of_pose, b_pose)
        for frames in state.frames.T:
            np.add.at(scores, frames, score)
        few = len(scores) / max(len(scores) - free, 1)
        meat = few * scores.T @ scores + CORRELATED * np.diag(self.prior)
        return bread @ meat @ bread

    def _linearize(self, pairs: Sequence[Pair], state: _State, level: int, scales: tuple[float, float]) -> _System:
        parts = self._linearize_pairs(pairs, state, level, scales)
        size, places = NUM_PARAMETERS + POSE * len(state.tracked), state.places
        flat = size * places[:, :, None] + places[:, None, :]
        H = np.asarray(np.bincount(flat.reshape(-1), parts.H.reshape(-1), size * size), np.float64)
        H, b = H.reshape(size, size), np.asarray(np.bincount(places.reshape(-1), parts.b.reshape(-1), size), np.float64)
        diagonal = np.concatenate([self.prior, np.tile(CORRELATED * POSE_SIGMA**-2, len(state.tracked))])
        away = se3.log_all(state.Ts_camera_world @ se3.inverse(state.tracked))
        H[np.arange(size), np.arange(size)] += diagonal
        b += diagonal * np.concatenate([self.given.step_to(state.calibration), away.reshape(-1)])
        residuals = [np.concatenate([one[kind] for one in parts.residuals]) for kind in (0, 1)]
        new = (1.4826 * _median_abs(values, old) for values, old in zip(residuals, scales, strict=True))
        color, depth = (max(scale, LEAST_SCALE) for scale in new)
        return _System(H, b, parts, (color, depth))

    def _linearize_pairs(
        self, pairs: Sequence[Pair], state: _State, level: int, scales: tuple[float, float]
    ) -> _PairSystems:
        Ts, calibration = state.Ts_second_first, state.calibration
        H, b = np.empty((len(pairs), UNKNOWNS, UNKNOWNS)), np.empty((len(pairs), UNKNOWNS))
        place, lens = calibration.T_color_depth[:3].astype(np.float32), calibration.lens.astype(np.float32)
        intrinsics, size = calibration.camera.scaled(level).intrinsics, self.levels.index(level)
        noise, residuals = single(SensorNoise(self.sensor.sigma_base, self.sensor.sigma_scale)), []
        for number, (pair, T, light) in enumerate(zip(pairs, Ts.astype(np.float32), state.light, strict=True)):
            first, second = pair.first, pair.second
            residuals.append(np.empty((2, len(first.points)), np.float32))
            linearize_pair(
                first.points, first.tangents, T[:3], second.depth, second.camera.intrinsics,
                first.intensities[size], second.intensities[size],
                first.velocity.astype(np.float32), second.velocity.astype(np.float32),
                np.float32(first.color_offset + calibration.delay), np.float32(second.color_offset + calibration.delay),
                place, intrinsics, lens, np.float32(1 / (1 << level)), np.float32(calibration.readout),
                np.float32(light[0]), np.float32(light[1]), np.float32(SAME_SURFACE), noise,
                np.float32(1 / scales[0]), np.float32(1 / scales[1]), np.float32(HUBER), residuals[-1], H[number],
                b[number],
            )  # fmt: skip
        return _without_light(H, b, state.light, Ts, residuals)


def _without_light(
    H: NDArray[np.float64],
    b: NDArray[np.float64],
    light: NDArray[np.float64],
    Ts: NDArray[np.float64],
    residuals: list[NDArray[np.float32]],
) -> _PairSystems:
    """Normal equations of all pairs in the parameters and the poses of the frames, from those of ``linearize_pair``.

    Args:
        H, b: (P, 21, 21) and (P, 21).
        light: (P, 2) gains and offsets.
        Ts: (P, 4, 4) relative poses, the first to the second camera.
        residuals: As of ``_PairSystems``.
    """
    known, of_light, prior = slice(0, SHARED + POSE), slice(SHARED + POSE, UNKNOWNS), CORRELATED * LIGHT_SIGMA**-2
    inverse = np.asarray(np.linalg.inv(H[:, of_light, of_light] + np.diag(prior)), np.float64)
    light_step = _times(inverse, b[:, of_light] + prior * (light - [1.0, 0.0]))
    light_slope = inverse @ H[:, of_light, known]
    reduced = H[:, known, known] - H[:, known, of_light] @ light_slope
    gradient = b[:, known] - _times(H[:, known, of_light], light_step)
    # T exp(-d_first) = exp(-Ad(T) d_first) T: a twist of the first frame is one of the relative pose
    M = np.zeros((len(Ts), SHARED + POSE, SHARED + 2 * POSE))
    M[:, :SHARED, :SHARED], M[:, SHARED:, -POSE:] = np.eye(SHARED), np.eye(POSE)
    M[:, SHARED:, SHARED : SHARED + POSE] = -se3.adjoint(Ts)
    M_transposed = np.swapaxes(M, 1, 2)
    return _PairSystems(
        M_transposed @ reduced @ M, _times(M_transposed, gradient), light_slope @ M, light_step, residuals
    )


def _solved(H: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solution of ``H x = right`` by SciPy (SuperLU): most frames make no pair.

    The threads of a dense solver would keep the cores that the tracking needs busy for 50 ms after every call.
    """
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

    return splu(csc_array(H)).solve(np.ascontiguousarray(right))


def _times(matrices: NDArray[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Products (n, i) of matrices (n, i, j) and vectors (n, j)."""
    return (matrices @ vectors[:, :, None])[:, :, 0]


def _robust_mean(values: NDArray[np.float32]) -> float:
    """Mean Huber cost of the known values."""
    r = np.abs(values[np.isfinite(values)])
    return float(np.mean(np.where(r < HUBER, r * r, HUBER * (2 * r - HUBER)))) if len(r) else 0.0


def _median_abs(values: NDArray[np.float32], otherwise: float) -> float:
    known = np.abs(values[np.isfinite(values)])
    return float(np.median(known)) if len(known) else otherwise
