"""Rolling shutter of the depth camera: readout time of its rows, from pairs of frames."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dudmap.core.calibration.adjustment import Adjustment, Fit, Pair, PairSet, standard_error
from dudmap.core.calibration.keyframes import ColorKeyframe
from dudmap.core.frames.rolling_shutter import rectified_images
from dudmap.core.geometry.calibration import Calibration

STEP = 0.02
"""Initial readouts of the search besides 0, in both directions, seconds: sensors at 30 Hz take 10 to 33 ms."""
LONGEST = 0.05
"""Longest plausible readout at low frame rates, seconds; at higher ones the frame interval."""


def rectified_keyframe(keyframe: ColorKeyframe, readout: float) -> ColorKeyframe:
    """Keyframe rectified to the time of its middle row, for a depth readout in seconds."""
    added, camera, velocity = readout - keyframe.depth_readout, keyframe.camera, keyframe.velocity
    if added == 0 or not velocity.any():
        return keyframe
    depth, _, _ = rectified_images(keyframe.depth, camera, added, velocity)
    points = keyframe.points.astype(np.float64)
    rows = camera.fy * points[:, 1] / points[:, 2] + camera.cy
    tau = (added * ((rows + 0.5) / camera.height - 0.5))[:, None]
    speed = velocity[:3] + np.cross(velocity[3:], points)
    points = points + tau * speed + tau**2 / 2 * np.cross(velocity[3:], speed)
    return replace(keyframe, depth=depth, points=points.astype(np.float32), depth_readout=readout)


class ReadoutSearch:
    """Mean robust cost of the pairs of one half of the time over the depth readout.

    Delay and readout of the colour camera, and poses, are fitted to each readout; two parabolas through three readouts
    give the minimum. No readout exceeds the frame interval.

    Args:
        free: (13,) bool, the timing parameters.

    Attributes:
        given: Calibration with the given readout and its fitted timing.
        best: Calibration with the best readout.
        sigma: Its standard deviation, seconds: a sandwich of the slopes of the pairs' costs; without a minimum that of
            a uniform distribution.
    """

    def __init__(
        self, pairs: Sequence[Pair], given: Calibration, adjustment: Adjustment, free: NDArray[np.bool_], stride: int
    ) -> None:
        self._pairs, self._given, self._adjustment, self._stride = pairs, given, adjustment, stride
        self._free = free
        intervals = [frame.interval for pair in pairs for frame in (pair.first, pair.second)]
        longest = min(LONGEST, float(np.median(intervals)))
        step = min(STEP, longest)
        fitted = {readout: self._fitted(readout) for readout in {-step, 0.0, step, given.depth_readout}}
        for _ in range(2):
            lowest = lowest_readout({readout: cost.mean() for readout, (cost, _) in fitted.items()}, longest)
            fitted[lowest] = self._fitted(lowest)
        self.given = fitted[given.depth_readout][1]
        self.best = min(fitted.values(), key=lambda each: each[0].mean())[1]
        before, middle, after = (fitted[readout][0] for readout in (-step, 0.0, step))
        bend = (before + after - 2 * middle) / step**2
        slopes = (after - before) / (2 * step) + bend * self.best.depth_readout
        unknown = longest / np.sqrt(3)
        error = standard_error(slopes, PairSet(pairs, stride).numbers)
        self.sigma = min(error / bend.sum(), unknown) if bend.sum() > 0 else unknown

    def _fitted(self, readout: float) -> tuple[NDArray[np.float64], Calibration]:
        pairs, start = self._rectified(readout), self._given.with_depth_readout(readout)
        fit, _ = self._adjustment.solve(pairs, Fit.tracked(pairs, start), self._free, self._adjustment.levels[-2:])
        return self._adjustment.costs(pairs, fit).sum(axis=0), fit.calibration

    def costs(self, calibration: Calibration) -> NDArray[np.float64]:
        """Costs (2, P) of intensities and depths for a calibration."""
        pairs = self._rectified(calibration.depth_readout)
        fit, _ = self._adjustment.with_poses(pairs, Fit.tracked(pairs, calibration))
        return self._adjustment.costs(pairs, fit, self._adjustment.levels[-1:])

    def _rectified(self, readout: float) -> PairSet:
        frames = {id(frame): frame for pair in self._pairs for frame in (pair.first, pair.second)}
        moved = {key: rectified_keyframe(frame, readout) for key, frame in frames.items()}
        return PairSet([Pair(moved[id(pair.first)], moved[id(pair.second)]) for pair in self._pairs], self._stride)


def lowest_readout(costs: dict[float, float], longest: float) -> float:
    """Minimum within +-``longest`` of the parabola through the three readouts around the best one."""
    readouts = np.array(sorted(costs))
    values = np.array([costs[readout] for readout in readouts.tolist()])
    middle = min(max(int(values.argmin()), 1), len(values) - 2)
    a, b, _ = np.polyfit(readouts[middle - 1 : middle + 2], values[middle - 1 : middle + 2], 2)
    lowest = -b / (2 * a) if a > 0 else -np.copysign(longest, b)
    return float(np.clip(lowest, -longest, longest))
