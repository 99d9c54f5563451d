"""Pairs of keyframes that see the same surfaces from elsewhere or at another velocity."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.color_pairs import POSE
from dudmap.core.calibration.keyframes import ColorKeyframe
from dudmap.core.geometry import se3
from dudmap.core.geometry.calibration import NUM_PARAMETERS

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


class PairSet:
    """Pairs of F frames, whose images and points (every ``stride``-th) are stacked for the kernel.

    Attributes:
        numbers: (P, 2) int64, the first and the second frame of every pair, in the order of time.
        Ts_camera_world: (F, 4, 4) of the frames as tracked.
        camera: Of the depth images.
        depths: (F, h, w) float32; ``images``: (F, h, w) float32 filtered intensities per size, coarse to fine.
        points, tangents: (n, 3) and (n, 6) float32 of all frames; ``starts``: (F + 1,) where those of each begin.
        residual_starts: (P + 1,) where the residuals of each pair begin: one per point of its first frame.
        twists: (F, 6) float32 velocities; ``color_offsets``: (F,) float32.
        places: (P, 25) where the unknowns of every pair stand among all: parameters, poses of both frames.
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

    def __len__(self) -> int:
        return len(self.numbers)


def select_pairs(keyframes: Sequence[ColorKeyframe], count: int) -> list[Pair]:
    """Up to ``count`` pairs of overlapping views at an angle or at different velocities, drawn evenly."""
    second, first = np.tril_indices(len(keyframes), -1)
    return _drawn(keyframes, first, second, count)


def select_across(before: Sequence[ColorKeyframe], after: Sequence[ColorKeyframe], count: int) -> list[Pair]:
    """The same of one frame each of two groups."""
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
