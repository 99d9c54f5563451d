"""Motion: smooth paths over the floor, and the articulated model of a walking person."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dudmap.lab.synthetic.scene import Material, Primitive, box, capsule, ellipsoid, pose

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
        gaps: Intervals (from, to) in which the object is absent, seconds.
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
    entry_speed: float = 1.2,
) -> FloorPath:
    """Path from one end of ``line`` to the other and, after a second out of view, back again, until ``duration``.

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
        begin = times[-1] + 1.0
        gaps.append((times[-1], begin))
    return FloorPath(times, [list(p) for p in points], smooth=0.1, gaps=gaps)


def smooth_step(share: float) -> float:
    """Cubic step: 0 below 0, 1 above 1, with zero slope at both ends."""
    x = min(max(share, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


HIP, KNEE, SHOULDER, ELBOW = 0.90, 0.44, 1.40, 0.28  # hip and shoulder above the ground, thigh and upper arm lengths
SHANK = 0.40
TORSO, HEAD, ARM_L, ARM_R, FOREARM_L, FOREARM_R, THIGH_L, THIGH_R, SHANK_L, SHANK_R = range(10)

OUTFITS = (
    ("stripes", (1.0, 1.0, 1.0), (0.45, 0.55, 0.85)),
    ("plaid", (1.0, 0.85, 0.8), (0.75, 0.68, 0.55)),
    ("checks", (0.6, 0.9, 0.7), (0.4, 0.4, 0.45)),
    ("wallpaper", (1.1, 0.75, 0.6), (0.5, 0.6, 0.5)),
    ("denim", (1.2, 0.6, 0.55), (0.35, 0.4, 0.6)),
)


class Figure:
    """Person 1.72 m tall times ``size``, facing +x and standing on z = 0.

    Attributes:
        primitives: The solids, each in the frame of its limb.
        limbs: (P,) number of the limb of each solid.
    """

    def __init__(self, rng: np.random.Generator, outfit: int, size: float = 1.0, stride: float = 1.35) -> None:
        pattern, shirt_tint, trouser_tint = OUTFITS[outfit % len(OUTFITS)]
        shift = tuple(rng.random(2))
        shirt = Material(pattern, (1.7 / size, 1.7 / size), shift, shirt_tint)
        trousers = Material("denim", (1.5 / size, 1.5 / size), shift, trouser_tint)
        skin = Material("skin", (3.0 / size, 3.0 / size), shift)
        hair = Material("denim", (3.0 / size, 3.0 / size), shift, (0.35, 0.25, 0.18))
        shoe = Material("denim", (2.0 / size, 2.0 / size), shift, (0.25, 0.22, 0.22))
        self.size, self.stride = size, stride * size
        parts: list[tuple[int, Primitive]] = [
            (TORSO, ellipsoid((0, 0, HIP + 0.04), (0.115, 0.165, 0.13), trousers)),
            (TORSO, ellipsoid((0, 0, HIP + 0.33), (0.125, 0.185, 0.27), shirt)),
            (TORSO, capsule((0, -0.13, SHOULDER - 0.01), (0, 0.13, SHOULDER - 0.01), 0.075, shirt)),
            (TORSO, capsule((0, 0, SHOULDER), (0.01, 0, SHOULDER + 0.12), 0.05, skin)),
            (HEAD, ellipsoid((0.02, 0, SHOULDER + 0.21), (0.095, 0.075, 0.115), skin)),
            (HEAD, ellipsoid((-0.005, 0, SHOULDER + 0.24), (0.10, 0.082, 0.10), hair)),
            (HEAD, ellipsoid((0.115, 0, SHOULDER + 0.20), (0.02, 0.014, 0.022), skin)),
        ]
        for arm, forearm in ((ARM_L, FOREARM_L), (ARM_R, FOREARM_R)):
            parts += [
                (arm, capsule((0, 0, 0), (0, 0, -ELBOW), 0.046, shirt)),
                (forearm, capsule((0, 0, 0), (0, 0, -0.23), 0.036, skin)),
                (forearm, ellipsoid((0, 0, -0.31), (0.03, 0.022, 0.075), skin)),
            ]
        for thigh, shank in ((THIGH_L, SHANK_L), (THIGH_R, SHANK_R)):
            parts += [
                (thigh, capsule((0, 0, 0), (0, 0, -KNEE), 0.075, trousers)),
                (shank, capsule((0, 0, 0), (0, 0, -SHANK), 0.052, trousers)),
                (shank, box((0.06, 0, -SHANK - 0.025), (0.25, 0.09, 0.07), shoe)),
            ]
        scale = np.diag([size, size, size, 1.0])
        self.limbs = np.array([limb for limb, _ in parts])
        self.primitives = [_scaled(primitive, scale, size) for _, primitive in parts]

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


def _scaled(primitive: Primitive, scale: NDArray[np.float64], size: float) -> Primitive:
    T = primitive.T_body_primitive.copy()
    T[:3, 3] = (scale @ np.append(T[:3, 3], 1.0))[:3]
    hx, hy, hz = primitive.half
    return Primitive(primitive.kind, (hx * size, hy * size, hz * size), T, primitive.material)
