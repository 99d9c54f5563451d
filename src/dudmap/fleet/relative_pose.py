"""Relative pose of two maps from their keyframes: matched features, and a vote among all pairs of keyframes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.config import RelocalizationConfig, SensorConfig
from dudmap.core.geometry import se3
from dudmap.core.geometry.alignment import agree
from dudmap.core.geometry.camera import Camera
from dudmap.core.places.place_recognition import Keyframe, KeyframeDatabase

SAME_DISTANCE, SAME_ANGLE_DEG = 0.1, 4.0
"""Two pairs of keyframes vote for the same relative pose if it differs by less than this (m, deg) where the camera of
one of them was. The pose of one pair of keyframes is good to some centimetres and a degree (``POSITION_ERROR``)."""
MAX_HYPOTHESES = 5
"""Relative poses that are returned at most."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A relative pose that some pairs of keyframes agree on.

    Attributes:
        T_a_b: (4, 4) world of b to world of a.
        num_keyframes: Keyframes of b that were recognised at this relative pose.
        num_inliers: Feature matches of all pairs of keyframes that agree.
    """

    T_a_b: NDArray[np.float64]
    num_keyframes: int
    num_inliers: int


def relative_poses(
    a: Sequence[Keyframe],
    b: Sequence[Keyframe],
    camera: Camera,
    sensor: SensorConfig,
) -> list[Hypothesis]:
    """Relative poses of two maps from their keyframes, best first; empty if no place of b is known in a.

    Each keyframe of b is recognised among those of a (``KeyframeDatabase.match``), which were seen by ``camera``. Every
    recognition is a vote for ``T_a_b``; votes that agree where the camera stood are averaged with the numbers of their
    features as weights. Poses with more agreeing features come first.
    """
    database = KeyframeDatabase(RelocalizationConfig(), camera, sensor)
    votes: list[tuple[int, NDArray[np.float64], NDArray[np.float64], int]] = []
    for number, keyframe in enumerate(b):
        for place in database.match(keyframe.features, a):
            T_a_b = place.T_world_camera @ se3.inverse(keyframe.T_world_camera)
            votes.append((number, T_a_b, keyframe.T_world_camera, place.num_inliers))
    found: list[Hypothesis] = []
    left = votes
    while left and len(found) < MAX_HYPOTHESES:
        groups = [_agreeing(vote, left) for vote in left]
        best = max(groups, key=lambda group: sum(vote[3] for vote in group))
        numbers = {vote[0] for vote in best}
        found.append(Hypothesis(_average(best), len(numbers), sum(vote[3] for vote in best)))
        left = [vote for vote in left if not any(vote is other for other in best)]
    return found


def _agreeing(vote: tuple, votes: list[tuple]) -> list[tuple]:
    """Votes whose relative pose puts their own camera where that of ``vote`` does."""
    T = vote[1]
    return [other for other in votes if agree(T @ other[2], other[1] @ other[2], SAME_DISTANCE, SAME_ANGLE_DEG)]


def _average(votes: list[tuple]) -> NDArray[np.float64]:
    """Weighted mean of relative poses, taken where the cameras stood so that no lever arm enters."""
    weights = np.array([vote[3] for vote in votes], float)
    Ts, cameras = np.stack([vote[1] for vote in votes]), np.stack([vote[2] for vote in votes])
    T = np.eye(4)
    T[:3, :3] = se3.nearest_rotation(np.average(Ts[:, :3, :3], axis=0, weights=weights))
    positions = (Ts @ cameras)[:, :3, 3]
    T[:3, 3] = np.average(positions - cameras[:, :3, 3] @ T[:3, :3].T, axis=0, weights=weights)
    return T
