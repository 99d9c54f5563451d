"""Pairs of keyframes that see the same surfaces from elsewhere or at another velocity."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dudmap.core.calibration.keyframes import ColorKeyframe
from dudmap.core.geometry import se3

MAX_ANGLE, MIN_ANGLE = np.radians(30), np.radians(2)
"""Rotation between the frames of a pair: enough to tell the cameras apart, little enough to see the same."""
MIN_FASTER = 0.2
"""Difference of velocity (m/s, rad/s) with which two views at no angle also make a pair."""
MAX_SHIFT = 0.35
"""Largest translation between the frames of a pair over the median depth."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two frames that see the same surfaces."""

    first: ColorKeyframe
    second: ColorKeyframe


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
            found.append(Pair(first, second))
    order = np.random.default_rng(0).permutation(len(found))[:count]
    return [found[n] for n in sorted(order)]
