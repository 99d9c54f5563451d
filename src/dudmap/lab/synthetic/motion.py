"""Smooth paths over the floor."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dudmap.lab.synthetic.scene import pose

STEP = 0.01
"""Sampling interval of a path, seconds."""


def smoothed(values: NDArray[np.float64], seconds: float) -> NDArray[np.float64]:
    """Gaussian smoothing along axis 0 of samples ``STEP`` apart, with constant continuation at the ends."""
    width = seconds / STEP
    if width < 0.5:
        return values
    reach = int(np.ceil(3 * width))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    weights /= weights.sum()
    padded = np.pad(values, [(reach, reach)] + [(0, 0)] * (values.ndim - 1), mode="edge")
    columns = [np.convolve(column, weights, mode="valid") for column in padded.reshape(len(padded), -1).T]
    return np.asarray(np.stack(columns, axis=1), dtype=np.float64).reshape(values.shape)


class FloorPath:
    """Path over the floor through points (K, 2) in metres at given times (K,) in seconds, with rounded corners.

    It starts and stops gradually, and rests before the first time and after the last.

    Args:
        smooth: Standard deviation of the smoothing, seconds.
        yaw: Heading before the first motion, radians; None takes the direction of the first motion.
        gaps: Intervals (from, to) in which the object is absent, seconds.
    """

    def __init__(
        self,
        times: Sequence[float],
        points: Sequence[Sequence[float]],
        *,
        smooth: float = 0.15,
        yaw: float | None = None,
        gaps: Sequence[tuple[float, float]] = (),
    ) -> None:
        self._start = times[0] - 1.0
        stamps = np.arange(self._start, times[-1] + 1.0 + STEP, STEP)
        table = np.asarray(points, dtype=np.float64)
        raw = np.stack([np.interp(stamps, times, table[:, k]) for k in range(2)], axis=1)
        # A jump inside a gap (absent here, present again there) must not be smoothed into a motion.
        inner = [0.5 * (a + b) for a, b in gaps if np.isfinite(a + b)]
        pieces = np.searchsorted(stamps, inner)
        pieces = pieces[(pieces > 0) & (pieces < len(stamps))]
        self.positions = np.concatenate([smoothed(part, smooth) for part in np.split(raw, pieces)])
        self.stamps, self.gaps = stamps, tuple(gaps)
        step = np.diff(self.positions, axis=0)
        length = np.linalg.norm(step, axis=1)
        length[pieces - 1] = 0.0
        self.walked = np.concatenate([[0.0], np.cumsum(length)])
        moving = length > 0.01 * STEP
        if yaw is None:
            first = int(np.argmax(moving))
            yaw = float(np.arctan2(step[first, 1], step[first, 0])) if moving.any() else 0.0
        headings = np.where(moving, np.arctan2(step[:, 1], step[:, 0]), np.nan)
        known = np.where(np.isnan(headings), 0, np.arange(1, len(headings) + 1))
        filled = np.concatenate([[yaw], headings])[np.maximum.accumulate(known)]
        self.yaws = smoothed(np.unwrap(np.append(filled, filled[-1:]))[:, None], 0.12)[:, 0]

    def at(self, t: float) -> tuple[NDArray[np.float64], float, float]:
        """Position (2,) in metres, heading in radians and covered distance in metres at time ``t``."""
        columns = (self.positions[:, 0], self.positions[:, 1], self.yaws, self.walked)
        x, y, yaw, walked = (float(np.interp(t, self.stamps, column)) for column in columns)
        return np.array([x, y]), yaw, walked

    def pose(self, t: float, height: float) -> NDArray[np.float64]:
        """Pose (4, 4) of what stands at a height in metres and faces along the path, at time ``t``."""
        position, yaw, _ = self.at(t)
        return pose((*position, height), float(np.degrees(yaw)))

    def present(self, t: float) -> bool:
        """Whether the object exists at time ``t``."""
        return not any(a <= t < b for a, b in self.gaps)


def crossing(
    line: tuple[Sequence[float], Sequence[float]],
    speed: float,
    duration: float,
    *,
    enter: float = 1.0,
    start_inside: bool = False,
    pause: float = 1.0,
    entry_speed: float = 1.2,
) -> FloorPath:
    """Path from one end of ``line`` to the other and, after a pause out of view, back again, until ``duration``.

    The middle 40 % of the line are covered at ``speed``, the ends at ``max(speed, entry_speed)``, so that slow movers
    also come into view. 25 % of the line are covered at the time ``enter`` in seconds; with ``start_inside`` the path
    begins in the middle of the view.
    """
    a, b = np.asarray(line[0], float), np.asarray(line[1], float)
    length = float(np.linalg.norm(b - a))
    fast = max(speed, entry_speed)
    shares = np.array([0.0, 0.3, 0.7, 1.0])
    needed = np.cumsum([0.0, 0.3 * length / fast, 0.4 * length / speed, 0.3 * length / fast])
    begin = enter - 0.25 * length / fast
    if start_inside:
        begin = -float(np.interp(0.4, shares, needed))
    times: list[float] = []
    points: list[NDArray[np.float64]] = []
    gaps: list[tuple[float, float]] = [] if start_inside else [(-np.inf, begin)]
    while not times or times[-1] < duration:
        ahead = len(points) % 8 == 0
        for share, moment in zip(shares, needed, strict=True):
            times.append(begin + float(moment))
            points.append(a + (share if ahead else 1 - share) * (b - a))
        begin = times[-1] + pause
        gaps.append((times[-1], begin))
    return FloorPath(times, [list(p) for p in points], smooth=0.1, gaps=gaps)


def smooth_step(share: float) -> float:
    """Cubic step: 0 below 0, 1 above 1, with zero slope at both ends."""
    x = min(max(share, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)
