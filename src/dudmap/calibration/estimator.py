"""Estimation of the calibration from pairs of frames."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.calibration.keyframes import SAME_SURFACE, ColorKeyframe, color_levels
from dudmap.config import SensorConfig
from dudmap.geometry import se3
from dudmap.geometry.calibration import NUM_PARAMETERS, PARAMETERS, Calibration
from dudmap.kernels.color_pairs import UNKNOWNS, linearize_pair

GROUPS: dict[str, tuple[str, ...]] = {
    "timing": ("delay", "readout"),
    "lens": ("k1", "k2"),
    "geometry": ("rotation_x", "rotation_y", "rotation_z", "log_focal", "center_x", "center_y"),
}
"""Parameters that leave their given values together. The translation follows the rest of the geometry: most of it looks
like a rotation, which alone proves that the cameras are not where they are said to be."""
TRANSLATION = ("translation_x", "translation_y", "translation_z")
PRIOR_SIGMA = np.array([0.03] * 3 + [np.radians(2)] * 3 + [0.05] + [0.005] * 2 + [0.1, 0.3] + [0.03, 0.03])
"""Standard deviations of a camera about which nothing is known but what is given, in the units of ``PARAMETERS``; that
of the principal point is a share of the width. Colour cameras lie 15 to 32 mm from their depth cameras; uncorrected
focal lengths differ by up to 10 %; a lens that is not corrected bends by some per cent; a frame at 30 Hz takes
33 ms."""
POSE_SIGMA = np.array([0.02] * 3 + [np.radians(1)] * 3)
"""Standard deviation of the tracked relative pose of two frames, metres and radians: it binds only directions in which
the depth images of a pair say nothing."""
LIGHT_SIGMA = np.array([0.3, 0.1])
"""Standard deviations of gain and offset between two images."""
CORRELATED = 50.0
"""Neighbouring points whose errors are correlated and which together count as one against the priors."""
COST_SCALES = (0.01, 1.0)
"""The same for the cost of a pair, fixed so that costs are comparable; 0.01 is the noise of common colour cameras."""
HUBER = 1.345
"""Constant of the robust weight, standard deviations: 95 % efficiency for Gaussian errors."""
ITERATIONS = 8
"""Largest number of Gauss-Newton steps per image size."""
FIT_ITERATIONS = 3
"""Steps per image size by which the pose of a pair is fitted with a known calibration."""
SETTLED = 0.01
"""A step below this many prior standard deviations in every parameter ends an image size."""
FIRST_SCALES, LEAST_SCALE = (0.05, 1.0), 1e-3
"""Standard deviations of the intensity difference (0..1) and of the depth difference over sigma(z) at the start, and
the least."""
MAX_ANGLE, MIN_ANGLE = np.radians(30), np.radians(2)
"""Rotation between the frames of a pair: enough to tell the cameras apart, little enough to see the same."""
MIN_FASTER = 0.2
"""Difference of velocity (m/s, rad/s) with which two views at no angle also make a pair."""
MAX_SHIFT = 0.35
"""Largest translation between the frames of a pair over the median depth."""
MIN_PAIRS = 14
"""Pairs of either half of the time without which nothing is estimated: one more than parameters."""
PAIRS = 80
"""Pairs that decide what is estimated; half as many more, across the halves, enter the result."""
MATERIAL = {"timing": 0.01, "lens": 0.01, "geometry": 0.05}
"""Share by which it must decrease: less is not worth leaving the given values, however certain it is. A depth image
bent by one or two per cent, as that of a Kinect is, can be told from a colour camera elsewhere only in part: on a
recording with such a depth (TUM fr1_xyz) the geometry gained 2 to 4 % and its use made the poses worse; 25 mm gain
30 %."""
EVIDENCE = 2.0
"""Standard errors by which a group of parameters, estimated from either half of the time, must decrease the cost of the
pairs of the other half. Chance does so in both halves once in 2000 times."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two frames that see the same surfaces, with what they do not share with other pairs.

    Attributes:
        first, second: The frames.
        T_second_first: (4, 4) current estimate.
        T_tracked: (4, 4) as tracked.
        light: (2,) gain and offset of the second image over the first.
    """

    first: ColorKeyframe
    second: ColorKeyframe
    T_second_first: NDArray[np.float64]
    T_tracked: NDArray[np.float64]
    light: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Estimate:
    """Result of an estimation.

    Attributes:
        calibration: What was found, with its standard deviations; as given where there is no evidence.
        evidence: Per group of ``GROUPS``, the decrease of the cost of pairs that were not used, in standard errors, the
            smaller one of both halves; NaN where there were too few pairs.
        gain: Share by which the cost of pairs that were not used decreased.
        pairs: Number of pairs.
    """

    calibration: Calibration
    evidence: dict[str, float]
    gain: float
    pairs: int


@dataclass(frozen=True, eq=False)
class _Trial:
    """Calibrations from both halves of the time with some free parameters, and the costs of the other halves' pairs."""

    free: NDArray[np.bool_]
    known: list[Calibration]
    costs: list[NDArray[np.float64]]
    evidence: float
    gain: float


@dataclass(frozen=True, eq=False)
class _PairSystem:
    """Normal equations of a pair in the parameters alone (``H``, ``score``), and what gives its own unknowns."""

    H: NDArray[np.float64]
    score: NDArray[np.float64]
    inverse: NDArray[np.float64]
    across: NDArray[np.float64]
    own_b: NDArray[np.float64]
    residuals: NDArray[np.float32]
    misfit: float

    def moved(self, pair: Pair, step: NDArray[np.float64]) -> Pair:
        """The pair after a step (13,) of the parameters."""
        own = -self.inverse @ (self.own_b + self.across.T @ step)
        return replace(pair, T_second_first=se3.exp(own[:6]) @ pair.T_second_first, light=pair.light + own[6:])


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations of all pairs in the parameters alone, and the scales of both residuals."""

    H: NDArray[np.float64]
    b: NDArray[np.float64]
    parts: list[_PairSystem]
    scales: tuple[float, float]


def select_pairs(keyframes: Sequence[ColorKeyframe], count: int) -> list[Pair]:
    """Up to ``count`` pairs of overlapping views at an angle or at different velocities, drawn evenly."""
    return _drawn([(a, b) for n, b in enumerate(keyframes) for a in keyframes[:n]], count)


def select_across(before: Sequence[ColorKeyframe], after: Sequence[ColorKeyframe], count: int) -> list[Pair]:
    """The same of one frame each of two groups."""
    return _drawn([(a, b) for b in after for a in before], count)


def _drawn(candidates: list[tuple[ColorKeyframe, ColorKeyframe]], count: int) -> list[Pair]:
    found = []
    for first, second in candidates:
        T = se3.inverse(second.T_world_camera) @ first.T_world_camera
        reach = float(np.median(first.points[:, 2])) if len(first.points) else 0.0
        angle, shift = se3.rotation_angle(T), float(np.linalg.norm(T[:3, 3]))
        if angle > MAX_ANGLE or shift > MAX_SHIFT * reach:
            continue
        faster = float(np.abs(first.velocity - second.velocity).max())
        if angle > MIN_ANGLE or shift > np.sin(MIN_ANGLE) * reach or faster > MIN_FASTER:
            found.append(Pair(first, second, T, T, np.array([1.0, 0.0])))
    order = np.random.default_rng(0).permutation(len(found))[:count]
    return [found[n] for n in sorted(order)]


def mask_of(names: Sequence[str]) -> NDArray[np.bool_]:
    """Mask (13,) of parameters."""
    return np.array([name in names for name in PARAMETERS])


class CalibrationEstimator:
    """Calibration from pairs of frames of a static scene, by differences of intensity and depth.

    A point X of the depth image of frame i is seen by both colour cameras; with the calibration theta, the projection
    pi(theta, xi, X) of ``Calibration`` with the camera's velocity xi, and the relative pose T of the depth cameras,

        r_I = I_j(pi(theta, xi_j, T X)) - g I_i(pi(theta, xi_i, X)) - o,      r_D = Z_j(T X) - (T X)_z.

    An error of theta moves the colours of both frames, but not alike: by a turn of the camera it is turned along, with
    the velocities it changes. theta is common to all pairs; T, g and o are unknowns of each pair and eliminated by
    the Schur complement. Robust Gauss-Newton, coarse to fine, with priors at the given values. The covariance is a
    sandwich with one score per frame, the sum of those of its pairs: it admits that the pixels of a pair, and the pairs
    of a frame, err together (Aronow, Samii and Assenova 2015, without the correction for pairs counted twice).

    Args:
        given: The calibration as given.
        sensor: Noise of the depth readings.
    """

    def __init__(self, given: Calibration, sensor: SensorConfig) -> None:
        self.given = given
        self.sensor = sensor
        self.levels = color_levels(given.camera)
        sigma = PRIOR_SIGMA.copy()
        sigma[7:9] *= given.camera.width
        self.prior = CORRELATED * sigma**-2

    def estimate(self, keyframes: Sequence[ColorKeyframe], count: int = PAIRS) -> Estimate:
        """Calibration that explains pairs of frames, as far as they prove it.

        Groups of parameters leave the given values one after the other, that with the most evidence first, as long as
        their estimate from either half of the time predicts the pairs of the other half better. What merely absorbs
        errors of another kind, such as a bent depth image, does so differently from place to place and fails.

        Args:
            keyframes: In the order of time.
            count: Number of pairs, half of them in each half of the time.
        """
        middle = len(keyframes) // 2
        halves = [select_pairs(part, count // 2) for part in (keyframes[:middle], keyframes[middle:])]
        everything = np.ones(NUM_PARAMETERS, dtype=bool)
        if min(len(pairs) for pairs in halves) < MIN_PAIRS:
            return Estimate(self.given, dict.fromkeys(GROUPS, float("nan")), 0.0, sum(map(len, halves)))
        free, evidence = ~everything, {}
        known = [self.given, self.given]  # from the first and from the second half
        costs = [self._explained(halves[1 - n], known[n]) for n in (0, 1)]
        first_costs = costs
        while len(rest := [name for name in GROUPS if not free[mask_of(GROUPS[name])].all()]) > 0:
            trials = {name: self._trial(halves, known, costs, free | mask_of(GROUPS[name])) for name in rest}
            evidence |= {name: trial.evidence for name, trial in trials.items()}
            best = max(rest, key=lambda name: trials[name].evidence)
            if evidence[best] < EVIDENCE or trials[best].gain < MATERIAL[best]:
                break
            chosen = trials[best]
            if best == "geometry":
                chosen = self._trial(halves, chosen.known, costs, chosen.free | mask_of(TRANSLATION))
            free, known, costs = chosen.free, chosen.known, chosen.costs
        pairs = [*halves[0], *halves[1], *select_across(keyframes[:middle], keyframes[middle:], count // 2)]
        found, covariance = self._solve(pairs, known[1], free) if free.any() else (self.given, None)
        _, uncertain = self._solve(pairs, found, everything, self.levels[-1:])
        sigma = np.sqrt(np.diag(uncertain))
        if covariance is not None:
            sigma[free] = np.sqrt(np.diag(covariance)[free])
        estimated = tuple(name for name, moved in zip(PARAMETERS, free, strict=True) if moved)
        gain = 1 - float(np.concatenate(costs).mean() / np.concatenate(first_costs).mean())
        return Estimate(replace(found, sigma=sigma, estimated=estimated), evidence, gain, len(pairs))

    def _trial(
        self,
        halves: list[list[Pair]],
        known: list[Calibration],
        costs: list[NDArray[np.float64]],
        free: NDArray[np.bool_],
    ) -> "_Trial":
        """What the parameters that are free would explain."""
        # only the geometry can displace the colours by so much that the smallest images have to begin
        levels = self.levels if (free & mask_of(GROUPS["geometry"])).any() else self.levels[-2:]
        found = [self._solve(halves[n], known[n], free, levels)[0] for n in (0, 1)]
        new = [self._explained(halves[1 - n], found[n]) for n in (0, 1)]
        gains = [before - after for before, after in zip(costs, new, strict=True)]
        errors = [float(gain.mean() / max(gain.std() / np.sqrt(len(gain)), 1e-12)) for gain in gains]
        shares = [float(gain.mean() / before.mean()) for gain, before in zip(gains, costs, strict=True)]
        return _Trial(free, found, new, min(errors), min(shares))

    def _solve(
        self,
        pairs: Sequence[Pair],
        start: Calibration,
        free: NDArray[np.bool_],
        levels: Sequence[int] = (),
    ) -> tuple[Calibration, NDArray[np.float64]]:
        """Robust Gauss-Newton from coarse to fine over the free parameters; calibration and covariance (13, 11)."""
        calibration, scales, system = start, FIRST_SCALES, None
        pairs = [replace(pair, T_second_first=pair.T_tracked, light=np.array([1.0, 0.0])) for pair in pairs]
        for level in levels or self.levels:
            for _ in range(ITERATIONS):
                system = self._linearize(pairs, calibration, level, scales)
                deviation = self.given.step_to(calibration)
                step = np.zeros(NUM_PARAMETERS)
                H = system.H + np.diag(self.prior)
                b = system.b + self.prior * deviation
                step[free] = -np.linalg.solve(H[np.ix_(free, free)], b[free])
                calibration, scales = calibration.retract(step), system.scales
                pairs = [part.moved(pair, step) for pair, part in zip(pairs, system.parts, strict=True)]
                if np.all(np.abs(step) * np.sqrt(self.prior / CORRELATED) < SETTLED):
                    break
        assert system is not None
        bread = np.linalg.inv(system.H + np.diag(self.prior))
        scores: dict[float, NDArray[np.float64]] = {}
        for pair, part in zip(pairs, system.parts, strict=True):
            for frame in (pair.first, pair.second):
                scores[frame.timestamp] = scores.get(frame.timestamp, 0.0) + part.score
        by_frame = np.array(list(scores.values()))
        few = len(by_frame) / max(len(by_frame) - np.count_nonzero(free), 1)
        meat = few * by_frame.T @ by_frame + CORRELATED * np.diag(self.prior)
        return calibration, bread @ meat @ bread

    def _explained(self, pairs: Sequence[Pair], calibration: Calibration) -> NDArray[np.float64]:
        """Mean robust cost (P,) of pairs whose poses are fitted with a calibration."""
        fitted = [replace(pair, T_second_first=pair.T_tracked, light=np.array([1.0, 0.0])) for pair in pairs]
        still, system = np.zeros(NUM_PARAMETERS), None
        for level in self.levels[-2:]:
            for _ in range(FIT_ITERATIONS):
                system = self._linearize(fitted, calibration, level, COST_SCALES)
                fitted = [part.moved(pair, still) for pair, part in zip(fitted, system.parts, strict=True)]
        assert system is not None
        return np.array([part.misfit for part in system.parts])

    def _linearize(
        self, pairs: Sequence[Pair], calibration: Calibration, level: int, scales: tuple[float, float]
    ) -> _System:
        parts = [self._linearize_pair(pair, calibration, level, scales) for pair in pairs]
        color = np.concatenate([part.residuals[0] for part in parts])
        depth = np.concatenate([part.residuals[1] for part in parts])
        new = tuple(1.4826 * _median_abs(values, old) for values, old in zip((color, depth), scales, strict=True))
        H, b = sum(part.H for part in parts), sum(part.score for part in parts)
        return _System(np.asarray(H), np.asarray(b), parts, (max(new[0], LEAST_SCALE), max(new[1], LEAST_SCALE)))

    def _linearize_pair(
        self, pair: Pair, calibration: Calibration, level: int, scales: tuple[float, float]
    ) -> "_PairSystem":
        """Normal equations of a pair with its own unknowns eliminated."""
        first, second = pair.first, pair.second
        camera = calibration.camera.scaled(level)
        number = self.levels.index(level)
        H, b = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
        residuals = np.empty((2, len(first.points)), np.float32)
        linearize_pair(
            first.points, first.tangents, pair.T_second_first[:3].astype(np.float32),
            second.depth, second.camera.intrinsics,
            first.intensities[number], second.intensities[number],
            first.velocity.astype(np.float32), second.velocity.astype(np.float32),
            np.float32(first.color_offset + calibration.delay), np.float32(second.color_offset + calibration.delay),
            calibration.T_color_depth[:3].astype(np.float32), camera.intrinsics, calibration.lens.astype(np.float32),
            np.float32(1 / (1 << level)), np.float32(calibration.readout),
            np.float32(pair.light[0]), np.float32(pair.light[1]), np.float32(SAME_SURFACE),
            np.array([self.sensor.sigma_base, self.sensor.sigma_scale], np.float32),
            np.float32(1 / scales[0]), np.float32(1 / scales[1]), np.float32(HUBER), residuals, H, b,
        )  # fmt: skip
        own = slice(NUM_PARAMETERS, UNKNOWNS)
        prior = CORRELATED * np.concatenate([POSE_SIGMA, LIGHT_SIGMA]) ** -2
        away = np.concatenate([se3.log(pair.T_second_first @ se3.inverse(pair.T_tracked)), pair.light - [1.0, 0.0]])
        inverse = np.asarray(np.linalg.inv(H[own, own] + np.diag(prior)), np.float64)
        own_b = b[own] + prior * away
        across = H[:NUM_PARAMETERS, own]
        score = b[:NUM_PARAMETERS] - across @ inverse @ own_b
        reduced = H[:NUM_PARAMETERS, :NUM_PARAMETERS] - across @ inverse @ across.T
        misfit = sum(_robust_mean(r / scale) for r, scale in zip(residuals, scales, strict=True))
        return _PairSystem(reduced, score, inverse, across, own_b, residuals, misfit)


def _robust_mean(values: NDArray[np.float32]) -> float:
    """Mean Huber cost of the known values."""
    r = np.abs(values[np.isfinite(values)])
    return float(np.mean(np.where(r < HUBER, r * r, HUBER * (2 * r - HUBER)))) if len(r) else 0.0


def _median_abs(values: NDArray[np.float32], otherwise: float) -> float:
    known = np.abs(values[np.isfinite(values)])
    return float(np.median(known)) if len(known) else otherwise
