"""Smooth paths over the floor, and a walking person."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dudmap.lab.synthetic.rooms import SOLIDS, built
from dudmap.lab.synthetic.scene import Material, pose

STEP = 0.01
"""Sampling interval of a path, seconds."""


def smoothed(values: NDArray[np.float64], seconds: float) -> NDArray[np.float64]:
    """Gaussian smoothing along axis 0 of samples ``STEP`` apart."""
    from scipy.ndimage import gaussian_filter1d

    return gaussian_filter1d(values, seconds / STEP, axis=0, mode="nearest", truncate=3.0)


class FloorPath:
    """Path over the floor through points (K, 2), metres, at times (K,), seconds, with rounded corners and rests at both
    ends.

    Args:
        smooth: Standard deviation of the smoothing, seconds.
        gaps: Intervals (from, to) of absence, seconds.
    """

    def __init__(
        self,
        times: Sequence[float],
        points: Sequence[Sequence[float]],
        *,
        smooth: float = 0.15,
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
        first = step[int(np.argmax(moving))] if moving.any() else np.array([1.0, 0.0])
        headings = np.where(moving, np.arctan2(step[:, 1], step[:, 0]), np.nan)
        known = np.where(np.isnan(headings), 0, np.arange(1, len(headings) + 1))
        filled = np.concatenate([[np.arctan2(first[1], first[0])], headings])[np.maximum.accumulate(known)]
        self.yaws = smoothed(np.unwrap(np.append(filled, filled[-1:]))[:, None], 0.12)[:, 0]

    def at(self, t: float) -> tuple[NDArray[np.float64], float, float]:
        """Position (2,) in metres, heading in radians and distance in metres at ``t``."""
        columns = (self.positions[:, 0], self.positions[:, 1], self.yaws, self.walked)
        x, y, yaw, walked = (float(np.interp(t, self.stamps, column)) for column in columns)
        return np.array([x, y]), yaw, walked

    def pose(self, t: float, height: float) -> NDArray[np.float64]:
        """Pose (4, 4) of an object at a height in metres, facing along the path."""
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
    entry_speed: float = 1.2,
) -> FloorPath:
    """Path along ``line`` and, after a second out of view, back, until ``duration``.

    The speed is ``speed`` on the middle 40 %, else ``max(speed, entry_speed)``. 25 % are passed at ``enter`` seconds;
    ``start_inside`` begins in the middle.
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
        begin = times[-1] + 1.0
        gaps.append((times[-1], begin))
    return FloorPath(times, [list(p) for p in points], smooth=0.1, gaps=gaps)


def smooth_step(share: float) -> float:
    """Cubic step: 0 below 0, 1 above 1, with zero slope at both ends."""
    x = min(max(share, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


HIP, KNEE, SHOULDER, ELBOW = 0.90, 0.44, 1.40, 0.28  # hip and shoulder above the ground, thigh and upper arm lengths
SHANK = 0.40
LIMBS = ("torso", "head", "arm_l", "arm_r", "forearm_l", "forearm_r", "thigh_l", "thigh_r", "shank_l", "shank_r")
TORSO, HEAD, ARM_L, ARM_R, FOREARM_L, FOREARM_R, THIGH_L, THIGH_R, SHANK_L, SHANK_R = range(len(LIMBS))

OUTFITS = (
    ("stripes", (1.0, 1.0, 1.0), (0.48, 0.55, 0.72)),
    ("plaid", (1.0, 0.85, 0.8), (0.75, 0.68, 0.55)),
    ("checks", (0.74, 0.83, 0.86), (0.4, 0.4, 0.45)),
    ("wallpaper", (1.1, 0.75, 0.6), (0.5, 0.6, 0.5)),
    ("denim", (1.0, 0.66, 0.58), (0.38, 0.42, 0.55)),
)


class Figure:
    """Person 1.72 m times ``size``, facing +x, standing on z = 0.

    Attributes:
        limbs: (P,) limb of each solid.
    """

    def __init__(self, rng: np.random.Generator, outfit: int, size: float = 1.0, stride: float = 1.35) -> None:
        pattern, shirt_tint, trouser_tint = OUTFITS[outfit % len(OUTFITS)]
        shift = tuple(rng.random(2))
        rows = SOLIDS["person"]
        materials = {name: Material(offset=shift, **given) for name, given in rows["materials"].items()}
        materials["shirt"] = Material(pattern, (1.7, 1.7), shift, shirt_tint)
        materials["trousers"] = Material("denim", (1.5, 1.5), shift, trouser_tint)
        parts = [(row["limb"], row) for row in rows["body"]]
        parts += [(f"{row['limb']}_{side}", row) for limb in ("arm", "leg") for side in "lr" for row in rows[limb]]
        self.size, self.stride = size, stride * size
        self.limbs = np.array([LIMBS.index(limb) for limb, _ in parts])
        solids = built([{key: row[key] for key in row if key != "limb"} for _, row in parts], materials)
        self.primitives = [solid.scaled(size) for solid in solids]

    def poses(self, T_world_person: NDArray[np.float64], walked: float, carrying: float = 0.0) -> NDArray[np.float64]:
        """Pose T_world_limb (P, 4, 4) of every solid after ``walked`` metres; ``carrying`` in [0, 1] lifts the arms."""
        phase = 2 * np.pi * walked / self.stride
        swing = np.degrees(np.arcsin(min(self.stride / self.size / 4 / (KNEE + SHANK), 0.6)))
        limbs = np.tile(np.eye(4), (10, 1, 1))
        lean = pose(pitch=3.0) @ pose(yaw=4.0 * np.sin(phase))
        lowest = []
        for side, thigh, shank in ((1, THIGH_L, SHANK_L), (-1, THIGH_R, SHANK_R)):
            angle = side * swing * np.sin(phase)
            knee = 6.0 + 42.0 * (swing / 24.0) * max(side * np.cos(phase), 0.0) ** 2
            limbs[thigh] = pose((0, side * 0.085, HIP), pitch=-angle)
            limbs[shank] = limbs[thigh] @ pose((0, 0, -KNEE), pitch=knee)
            foot = limbs[shank] @ np.array([[-0.065, 0.185], [0, 0], [-SHANK - 0.06, -SHANK - 0.06], [1, 1]])
            lowest.append(foot[2].min())
        for side, arm, forearm in ((1, ARM_L, FOREARM_L), (-1, ARM_R, FOREARM_R)):
            angle = (1 - carrying) * (-side * 0.9 * swing * np.sin(phase)) + carrying * 25.0
            bend = (1 - carrying) * 22.0 + carrying * 65.0
            limbs[arm] = lean @ pose((0, side * 0.215, SHOULDER - 0.02), pitch=-angle, roll=side * 6.0 * (1 - carrying))
            limbs[forearm] = limbs[arm] @ pose((0, 0, -ELBOW), pitch=-bend)
        limbs[TORSO] = lean
        limbs[HEAD] = pose(yaw=2.0 * np.sin(phase)) @ lean
        limbs[:, 2, 3] -= min(lowest)  # the lower foot stands on the ground
        limbs[:, :3, 3] *= self.size
        return (T_world_person @ limbs)[self.limbs]
