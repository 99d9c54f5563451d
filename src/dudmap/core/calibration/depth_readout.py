"""Rolling shutter of the depth camera: the time that it takes to read out its rows, from pairs of frames."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dudmap.core.calibration.adjustment import Adjustment, Fit, Pair, PairSet
from dudmap.core.calibration.keyframes import ColorKeyframe
from dudmap.core.frames.rolling_shutter import rectified_images
from dudmap.core.geometry.calibration import Calibration

STEP = 0.02
"""Readouts of this size, both ways, are compared with none, seconds: sensors at 30 Hz take 10 to 33 ms."""
LONGEST = 0.05
"""Longest readout that is believed, seconds."""


def rectified_keyframe(keyframe: ColorKeyframe, readout: float) -> ColorKeyframe:
    """Keyframe at the time of its middle row, whose depth was read out in so many seconds."""
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
    """Mean robust cost of the pairs of frames of one half of the time, as a function of the readout of their depth.

    The cost is nearly quadratic: its minimum is that of the parabola through three readouts, and then once more of that
    through the nearest three. The poses of the frames are fitted to each.

    Args:
        pairs: Of keyframes.
        given: Calibration of the colour camera.
        adjustment: Fits the poses.
        stride: Every so many points of a keyframe.

    Attributes:
        costs: (2, P) of intensities and depths of every pair, by readout.
        best: Readout with the smallest cost, seconds.
    """

    def __init__(self, pairs: Sequence[Pair], given: Calibration, adjustment: Adjustment, stride: int) -> None:
        self._pairs, self._given, self._adjustment, self._stride = pairs, given, adjustment, stride
        self.costs: dict[float, NDArray[np.float64]] = {}
        for readout in (-STEP, 0.0, STEP):
            self.cost(readout)
        self.cost(self._vertex())
        self.best = self._vertex()

    def cost(self, readout: float) -> NDArray[np.float64]:
        """Costs (2, P) of a readout in seconds."""
        if readout not in self.costs:
            known = {id(frame): frame for pair in self._pairs for frame in (pair.first, pair.second)}
            moved = {key: rectified_keyframe(frame, readout) for key, frame in known.items()}
            pairs = PairSet([Pair(moved[id(pair.first)], moved[id(pair.second)]) for pair in self._pairs], self._stride)
            start = Fit.tracked(pairs, self._given.with_depth_readout(readout))
            fit, _ = self._adjustment.with_poses(pairs, start, self._adjustment.levels)
            self.costs[readout] = self._adjustment.costs(pairs, fit)
        return self.costs[readout]

    def _vertex(self) -> float:
        """Minimum of the parabola through the three readouts around the best one."""
        readouts = np.array(sorted(self.costs))
        values = np.array([self.costs[readout].mean() for readout in readouts.tolist()])
        middle = min(max(int(values.argmin()), 1), len(values) - 2)
        a, b, _ = np.polyfit(readouts[middle - 1 : middle + 2], values[middle - 1 : middle + 2], 2)
        lowest = -b / (2 * a) if a > 0 else readouts[values.argmin()]
        return float(np.clip(lowest, -LONGEST, LONGEST))
