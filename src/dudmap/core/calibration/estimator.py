"""Estimation of the calibration from pairs of frames."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SensorConfig
from dudmap.core.calibration.adjustment import (
    Adjustment,
    Fit,
    Pair,
    PairSet,
    select_across,
    select_pairs,
    standard_error,
)
from dudmap.core.calibration.depth_readout import ReadoutSearch, rectified_keyframe
from dudmap.core.calibration.keyframes import ColorKeyframe
from dudmap.core.calibration.vignetting import Brightness
from dudmap.core.geometry.calibration import MAX_VIGNETTING, NUM_PARAMETERS, PARAMETERS, Calibration
from dudmap.core.verdict import Outcome, Verdict

GROUPS: dict[str, tuple[str, ...]] = {
    "timing": ("delay", "readout"),
    "lens": ("k1", "k2"),
    "center": ("center_x", "center_y"),
    "geometry": (*PARAMETERS[:6], "log_focal", "center_x", "center_y"),
}
"""Parameters that leave their given values together."""
TESTED = GROUPS | {"vignetting": ("vignetting",)}
"""All tested groups; vignetting is estimated after the others."""
MIN_PAIRS = 14
"""Pairs in each half of the time: one more than parameters."""
PAIRS = 80
"""Pairs that decide about groups; the result uses half as many more."""
SHUTTER_PAIRS = 160
"""Pairs that decide about the depth readout."""
STRIDE = 2
"""Step through the points of a frame for these decisions."""
SHUTTER, SHUTTER_PARAMETER = "shutter", "depth_readout"
"""Group of the depth readout, estimated before all others, and its parameter."""
MATERIAL = {"timing": 0.01, "lens": 0.01, "center": 0.01, "geometry": 0.1, SHUTTER: 0.01}
"""Smallest relative decrease of the cost per group. A bent depth image, as of a Kinect, lets the geometry gain up to
7 %, a camera 25 mm away 19 to 30 %."""
EVIDENCE = 3.0
"""Smallest decrease of the cost for a group, standard errors, of estimates on one half of the time tested on the other.
Chance exceeds it once in 700 times."""

NOT_PROVEN = "other values are not proven ({figure:+.1f} standard errors, {limit:g} are needed)"
TOO_SMALL = "other values fit better by too small a share to be used ({figure:.1%}, {limit:.0%} are needed)"


@dataclass(frozen=True, eq=False)
class Estimate:
    """Result of an estimation.

    Attributes:
        calibration: With standard deviations; given values without evidence.
        verdicts: Per group of ``TESTED``, and ``SHUTTER``: whether it leaves its given values. Figure ``evidence``:
            decrease of held-out costs, standard errors; NaN with too few pairs.
        gain: Share by which held-out costs decreased.
    """

    calibration: Calibration
    verdicts: dict[str, Verdict]
    gain: float
    pairs: int


@dataclass(frozen=True, eq=False)
class _Trial:
    """Fits to both halves of the time with some free parameters, and costs (2, P) on the other halves."""

    free: NDArray[np.bool_]
    fits: list[Fit]
    costs: list[NDArray[np.float64]]
    halves: list[PairSet]

    def gains(self, other: "_Trial") -> NDArray[np.float64]:
        """Decrease (2, P) of the costs of all pairs relative to another trial."""
        return np.concatenate(other.costs, axis=1) - np.concatenate(self.costs, axis=1)

    def evidence(self, gains: NDArray[np.float64]) -> float:
        second, first = (pairs.numbers for pairs in self.halves)
        error = standard_error(gains, np.concatenate([first, second + 1 + first.max()]))
        return float(gains.sum() / max(error, 1e-12))

    def verdict(self, other: "_Trial", group: str) -> Verdict:
        """Whether this trial lets a group leave its given values: the improvement suffices, and neither cost gets
        significantly worse."""
        evidence, share = self.improvement(other)
        worst = min(self.evidence(gains) for gains in self.gains(other))
        return Verdict((
            Outcome.of("evidence", evidence, EVIDENCE, NOT_PROVEN, at_least=True),
            Outcome.of("share", share, MATERIAL[group], TOO_SMALL, at_least=True),
            Outcome.of("worst", worst, -EVIDENCE, "the colours or the depths fit worse", at_least=True),
        ))  # fmt: skip

    def improvement(self, other: "_Trial") -> tuple[float, float]:
        """Decrease of the cost: standard errors, and the smaller share of both halves."""
        shares = [1 - after.sum() / before.sum() for before, after in zip(other.costs, self.costs, strict=True)]
        return self.evidence(self.gains(other).sum(axis=0)), float(min(shares))


def _halves(keyframes: Sequence[ColorKeyframe], count: int) -> list[list[Pair]]:
    middle = len(keyframes) // 2
    return [select_pairs(part, count // 2) for part in (keyframes[:middle], keyframes[middle:])]


def mask_of(names: Sequence[str]) -> NDArray[np.bool_]:
    """Mask (13,) of parameters."""
    return np.array([name in names for name in PARAMETERS])


class CalibrationEstimator:
    """Calibration from pairs of frames of a static scene.

    With the projection pi(theta, xi, X) of ``Calibration`` at camera velocity xi, a point X of the depth image of frame
    i, and the relative pose T of the depth cameras, the residuals are

        r_I = I_j(pi(theta, xi_j, T X)) - g I_i(pi(theta, xi_i, X)) - o,      r_D = Z_j(T X) - (T X)_z.

    The calibration is common to all pairs; T follows from the unknown poses. Robust Gauss-Newton, coarse to fine, with
    priors at the given values. The covariance has three parts:

    * A sandwich with one score per frame, whose errors are correlated (Aronow, Samii and Assenova 2015, without the
      correction for pairs counted twice).
    * A factor for differences between both halves of the time (Birge 1932).
    * The difference between a fit of all parameters and the result.

    ``given``: initial calibration; 2 ``workers`` (threads) process both halves.
    """

    def __init__(self, given: Calibration, sensor: SensorConfig, workers: int = 1) -> None:
        self.given = given
        self.sensor = sensor
        self.workers = workers
        self.adjustment = Adjustment(given, sensor)

    def estimate(self, keyframes: Sequence[ColorKeyframe]) -> Estimate:
        """Calibration from keyframes in order of time; parameters without evidence keep their given values.

        Groups leave the given values one by one, most evidence first: one half's estimate predicts the other half's
        pairs better.
        """
        halves = _halves(keyframes, SHUTTER_PAIRS)
        if min(len(pairs) for pairs in halves) < MIN_PAIRS:
            few = f"fewer than {MIN_PAIRS} pairs of overlapping views in half of the time"
            unknown = dict.fromkeys((*TESTED, SHUTTER), Verdict((Outcome("evidence", reason=few),)))
            return Estimate(self.given, unknown, 0.0, sum(map(len, halves)))
        known = self.given.depth_readout
        readout, sigma, verdict, gain = self._depth_readout(halves)
        estimate = self._estimate_color(keyframes, readout)
        found, moved = estimate.calibration, (SHUTTER_PARAMETER,) if readout != known else ()
        late = max(found.delay, 0.0) if any(frame.color_offset for frame in keyframes) else 0.0
        return Estimate(
            replace(found, estimated=(*found.estimated, *moved), depth_late=late, depth_readout_sigma=sigma),
            estimate.verdicts | {SHUTTER: verdict},
            1 - (1 - gain) * (1 - estimate.gain),
            estimate.pairs,
        )

    def _depth_readout(self, halves: list[list[Pair]]) -> tuple[float, float, Verdict, float]:
        """Depth readout (s), its standard deviation, verdict, and relative decrease of the cost."""
        given, adjustment, timing = self.given, self.adjustment, mask_of(GROUPS["timing"])
        with ThreadPoolExecutor(self.workers) as pool:
            searches = list(pool.map(lambda pairs: ReadoutSearch(pairs, given, adjustment, timing, STRIDE), halves))
        one, other = searches
        sets = [PairSet(pairs, STRIDE) for pairs in halves]
        before, after = (
            _Trial(timing, [], [other.costs(of_one), one.costs(of_other)], sets)
            for of_one, of_other in ((one.given, other.given), (one.best, other.best))
        )
        verdict, found = after.verdict(before, SHUTTER), np.array([one.best.depth_readout, other.best.depth_readout])
        is_proven, evidence = verdict.accepted, verdict.figure("evidence")
        readout = float(found.mean()) if is_proven else given.depth_readout
        apart = np.sqrt(np.mean(np.square(found - readout)))
        # for a nearly quadratic cost, a decrease by E standard errors determines the minimum to 1 / (2 E) of its
        # distance
        unsure = (readout - given.depth_readout) / (2 * evidence) if is_proven else np.hypot(one.sigma, other.sigma) / 2
        sigma = float(np.hypot(apart, unsure))
        return readout, sigma, verdict, verdict.figure("share") if is_proven else 0.0

    def _estimate_color(self, keyframes: Sequence[ColorKeyframe], depth_readout: float) -> Estimate:
        rectified = CalibrationEstimator(self.given.with_depth_readout(depth_readout), self.sensor, self.workers)
        return rectified._beside_rectified([rectified_keyframe(frame, depth_readout) for frame in keyframes])

    def _beside_rectified(self, keyframes: Sequence[ColorKeyframe]) -> Estimate:
        middle = len(keyframes) // 2
        within = _halves(keyframes, PAIRS)
        halves = [PairSet(pairs, STRIDE) for pairs in within]
        everything = np.ones(NUM_PARAMETERS, dtype=bool)
        fits = [self.adjustment.with_poses(pairs, Fit.tracked(pairs, self.given))[0] for pairs in halves]
        costs = [self.adjustment.costs(halves[1 - n], fits[1 - n], self.adjustment.levels[-1:]) for n in (0, 1)]
        start = _Trial(~everything, fits, costs, halves)
        proven, verdicts = self._proven(halves, start)
        pairs = PairSet([*within[0], *within[1], *select_across(keyframes[:middle], keyframes[middle:], PAIRS // 2)])
        free, levels = proven.free, self.adjustment.levels
        fit, covariance = Fit.tracked(pairs, proven.fits[1].calibration), None
        if free.any():
            fit, covariance = self.adjustment.solve(pairs, fit, free)
        found = fit.calibration
        freed, uncertain = self.adjustment.solve(pairs, fit, everything, levels[-1:])
        sigma = np.sqrt(np.diag(uncertain))
        if covariance is not None:
            sigma[free] = np.sqrt(np.diag(covariance)[free])
        sigma = np.hypot(self._disagreement(halves, proven.fits) * sigma, found.step_to(freed.calibration))
        estimated = tuple(name for name, moved in zip(PARAMETERS, free, strict=True) if moved)
        vignetting, vignetting_sigma, verdicts["vignetting"] = self._vignetting(proven, Brightness.of(pairs, fit))
        if vignetting != self.given.vignetting:
            estimated = (*estimated, "vignetting")
        gain = 1 - float(np.concatenate(proven.costs, axis=1).mean() / np.concatenate(start.costs, axis=1).mean())
        found = replace(
            found, sigma=sigma, estimated=estimated, vignetting=vignetting, vignetting_sigma=vignetting_sigma
        )
        return Estimate(found, verdicts, gain, len(pairs))

    def _vignetting(self, proven: _Trial, everything: Brightness) -> tuple[float, float, Verdict]:
        given = self.given.vignetting
        halves = [Brightness.of(pairs, fit) for pairs, fit in zip(proven.halves, proven.fits, strict=True)]
        found = [half.fitted()[0] for half in halves]
        gains = [halves[n].costs(given) - halves[n].costs(found[1 - n]) for n in (1, 0)]
        evidence = proven.evidence(np.concatenate(gains))
        vignetting, sigma = everything.fitted()
        sigma = float(np.hypot(sigma, (found[0] - found[1]) / 2))
        change = abs(vignetting - given)
        verdict = Verdict((
            Outcome.of("evidence", evidence, EVIDENCE, NOT_PROVEN, at_least=True),
            Outcome.of("change", change, EVIDENCE * sigma, "{figure:.3f} is within its error", at_least=True),
            Outcome.of("size", change, MAX_VIGNETTING, "{figure:.2f} is more than a lens has"),
        ))  # fmt: skip
        return vignetting if verdict.accepted else given, sigma, verdict

    def _disagreement(self, halves: list[PairSet], starts: list[Fit]) -> float:
        """Factor >= 1 for standard deviations: rms difference of both halves."""
        everything, finest = np.ones(NUM_PARAMETERS, dtype=bool), self.adjustment.levels[-1:]
        with ThreadPoolExecutor(self.workers) as pool:
            solved = pool.map(lambda n: self.adjustment.solve(halves[n], starts[n], everything, finest), (0, 1))
            (one, covariance), (other, other_covariance) = solved
        apart = one.calibration.step_to(other.calibration)
        squares = float(apart @ np.linalg.solve(covariance + other_covariance, apart))
        return max(1.0, np.sqrt(squares / NUM_PARAMETERS))

    def _proven(self, halves: list[PairSet], start: "_Trial") -> tuple["_Trial", dict[str, Verdict]]:
        trial, verdicts = start, dict[str, Verdict]()
        while rest := [name for name, members in GROUPS.items() if not trial.free[mask_of(members)].all()]:
            trials = {name: self._trial(halves, trial, [name]) for name in rest}
            verdicts |= {name: other.verdict(trial, name) for name, other in trials.items()}
            proven = [name for name in rest if verdicts[name].accepted]
            if not proven:
                break
            best = max(proven, key=lambda name: verdicts[name].figure("evidence"))
            trial = trials[best]
        if "geometry" in rest and "center" in rest:
            rest.remove("center")  # part of the geometry
        if len(rest) > 1:
            trial, names = self._together(halves, trial, rest)
            verdicts |= names
        if trial.free[mask_of(GROUPS["geometry"])].all():
            both = verdicts["center"], verdicts["geometry"]
            verdicts["center"] = max(both, key=lambda verdict: verdict.figure("evidence"))
        return trial, verdicts

    def _together(
        self, halves: list[PairSet], before: "_Trial", names: Sequence[str]
    ) -> tuple["_Trial", dict[str, Verdict]]:
        """Groups that explain the pairs only jointly, such as focal length and delay, and the verdict on each given the
        others.

        All groups are freed, then fixed one by one.
        """
        trial, names = self._trial(halves, before, names), list(names)
        while len(names) > 1 and all(trial.verdict(before, name).accepted for name in names):
            fewer = {name: self._trial(halves, before, [n for n in names if n != name]) for name in names}
            verdicts = {name: trial.verdict(other, name) for name, other in fewer.items()}
            weakest = min(names, key=lambda name: verdicts[name].figure("evidence"))
            needless = [name for name in (weakest, *names) if not verdicts[name].accepted]
            if not needless:
                return trial, verdicts
            names.remove(needless[0])
            trial = fewer[needless[0]]
        return before, {}

    def _trial(self, halves: list[PairSet], before: "_Trial", names: Sequence[str]) -> "_Trial":
        free = before.free | mask_of([member for name in names for member in GROUPS[name]])
        return self._freed(halves, before.fits, free)

    def _freed(self, halves: list[PairSet], starts: list[Fit], free: NDArray[np.bool_]) -> "_Trial":
        # only the geometry can displace colours enough to need the smallest images
        levels = self.adjustment.levels if (free & mask_of(GROUPS["geometry"])).any() else self.adjustment.levels[-2:]

        def fitted(n: int) -> tuple[Fit, NDArray[np.float64]]:
            fit, _ = self.adjustment.solve(halves[n], starts[n], free, levels)
            other = replace(starts[1 - n], calibration=fit.calibration)
            return fit, self.adjustment.costs(halves[1 - n], other)

        with ThreadPoolExecutor(self.workers) as pool:
            (one, other), (cost, other_cost) = zip(*pool.map(fitted, (0, 1)), strict=True)
        return _Trial(free, [one, other], [cost, other_cost], halves)
