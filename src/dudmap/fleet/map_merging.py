"""Merge two saved maps: votes of keyframes, refinement, checks, fusion."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.config import RelocalizationConfig, SensorConfig
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.se3 import agree
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.place_recognition import (
    MAX_CORRECTION,
    MAX_CORRECTION_DEG,
    Keyframe,
    KeyframeDatabase,
)
from dudmap.core.places.saved_map import SavedMap
from dudmap.fleet.agreement import Agreement, agreement
from dudmap.fleet.map_fusion import fuse_maps
from dudmap.fleet.map_samples import SurfacePoints, surface_points
from dudmap.fleet.sdf_alignment import MIN_STIFFNESS, SdfAlignment, align_maps

SAME_DISTANCE, SAME_ANGLE_DEG = 0.1, 4.0
"""Keyframe pairs within this distance (m, deg) vote for one pose."""
MAX_HYPOTHESES = 5

SURFACE_POINTS = 20_000
MIN_KEYFRAMES, MIN_FEATURES = 2, 40
"""Keyframes recognised at one pose; a single one needs this many features, because look-alike places reach 200."""
NOT_RECOGNISED = "too few places of one were recognised in the other at the same relative pose"


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Relative pose ``T_a_b`` (4, 4), world of b to a, of agreeing keyframe pairs.

    ``num_keyframes``: recognised of b; ``num_inliers``: features of all pairs.
    """

    T_a_b: NDArray[np.float64]
    num_keyframes: int
    num_inliers: int


def relative_poses(
    a: Sequence[Keyframe], b: Sequence[Keyframe], camera: Camera, sensor: SensorConfig
) -> list[Hypothesis]:
    """Relative poses ``T_a_b`` from keyframes, best first: averages of agreeing matches (``KeyframeDatabase.match``,
    ``camera`` of a)."""
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
    T = vote[1]
    return [other for other in votes if agree(T @ other[2], other[1] @ other[2], SAME_DISTANCE, SAME_ANGLE_DEG)]


def _average(votes: list[tuple]) -> NDArray[np.float64]:
    weights = np.array([vote[3] for vote in votes], float)
    Ts, cameras = np.stack([vote[1] for vote in votes]), np.stack([vote[2] for vote in votes])
    T = np.eye(4)
    T[:3, :3] = se3.nearest_rotation(np.average(Ts[:, :3, :3], axis=0, weights=weights))
    positions = (Ts @ cameras)[:, :3, 3]
    T[:3, 3] = np.average(positions - cameras[:, :3, 3] @ T[:3, :3].T, axis=0, weights=weights)
    return T


@dataclass(frozen=True, eq=False)
class MapPair:
    """Result of comparing two maps.

    Attributes:
        T_a_b: (4, 4) world of b to a, None if not to be merged.
        reason: Why not; empty if merged.
        hypothesis, alignment, agreement: Metrics of the accepted pose, else of the first one tried.
    """

    T_a_b: NDArray[np.float64] | None
    reason: str
    hypothesis: Hypothesis | None = None
    alignment: SdfAlignment | None = None
    agreement: Agreement | None = None

    @property
    def contradicted(self) -> bool:
        """Whether surfaces coincide in other colours, as in similar places."""
        found = self.agreement
        return self.T_a_b is None and found is not None and found.enough and bool(found.color_reason(many=True))

    def tree(self) -> dict[str, Any]:
        """Values for a JSON file."""
        out: dict[str, Any] = {"reason": self.reason or None}
        if self.T_a_b is not None:
            out["T_a_b"] = self.T_a_b.tolist()
        if self.hypothesis is not None:
            out |= {"keyframes": self.hypothesis.num_keyframes, "features": self.hypothesis.num_inliers}
        if self.alignment is not None:
            out |= {"residual_m": round(self.alignment.residual, 6), "stiffness": round(self.alignment.stiffness, 6)}
        if self.agreement is not None:
            out |= {key: round(value, 4) for key, value in asdict(self.agreement).items()}
        return out


@dataclass(frozen=True, eq=False)
class MapSurface:
    """A map with surface points."""

    volume: TsdfVolume
    points: SurfacePoints

    @classmethod
    def of(cls, saved: SavedMap) -> "MapSurface":
        """Sample the surface of a saved map.

        Raises:
            MapError: The map has no surface.
        """
        positions = np.array([keyframe.T_world_camera[:3, 3] for keyframe in saved.keyframes]).reshape(-1, 3)
        return cls(saved.volume, surface_points(saved.volume, positions, SURFACE_POINTS))


def compare_maps(a: SavedMap, b: SavedMap, changed: bool = False) -> MapPair:
    """Relative pose of two maps, and whether they show one place.

    ``changed``: two visits with changes.

    Raises:
        MapError: A map has no surface.
    """
    found = _recognised(a, b) or [replace(one, T_a_b=se3.inverse(one.T_a_b)) for one in _recognised(b, a)]
    if not found:
        return MapPair(None, NOT_RECOGNISED)
    return decided(MapSurface.of(a), MapSurface.of(b), found, changed=changed)


def _recognised(a: SavedMap, b: SavedMap) -> list[Hypothesis]:
    found = relative_poses(a.keyframes, b.keyframes, a.volume.camera, a.volume.sensor)
    return [one for one in found if one.num_keyframes >= MIN_KEYFRAMES or one.num_inliers >= MIN_FEATURES]


def decided(
    a: MapSurface, b: MapSurface, found: Sequence[Hypothesis], many: bool = False, changed: bool = False
) -> MapPair:
    """Refine and check poses in order; return the first that passes, else the first rejection. ``many``: most pairs
    show different places."""
    empty = [name for name, one in (("first", a), ("second", b)) if not len(one.points)]
    if empty:
        return MapPair(None, f"the {' and the '.join(empty)} has no surface, its mesh is empty; leave that run out")
    first: MapPair | None = None
    for hypothesis in found:
        pair = _checked(a, b, hypothesis, many, changed)
        if pair.T_a_b is not None:
            return pair
        first = first or pair
    assert first is not None
    return first


def _checked(a: MapSurface, b: MapSurface, hypothesis: Hypothesis, many: bool, changed: bool) -> MapPair:
    aligned = align_maps(a.volume, b.volume, a.points, b.points, hypothesis.T_a_b, changed=changed)
    if not aligned.converged:
        return MapPair(None, "their surfaces cannot be aligned with each other", hypothesis, aligned)
    if aligned.stiffness < MIN_STIFFNESS:
        return MapPair(None, "their common surface does not determine their relative pose", hypothesis, aligned)
    correction = se3.inverse(hypothesis.T_a_b) @ aligned.T_a_b
    middle = b.points.points.mean(axis=0)
    moved = np.linalg.norm(correction[:3, :3] @ middle + correction[:3, 3] - middle)
    if moved > MAX_CORRECTION or np.degrees(se3.rotation_angle(correction)) > MAX_CORRECTION_DEG:
        return MapPair(None, "features and surfaces suggest different relative poses", hypothesis, aligned)
    checked = agreement(a.volume, b.volume, a.points, b.points, aligned.T_a_b)
    reason = checked.rejection_reason(many, changed)
    return MapPair(None if reason else aligned.T_a_b, reason, hypothesis, aligned, checked)


def merged_map(a: SavedMap, b: SavedMap, T_a_b: NDArray[np.float64]) -> SavedMap:
    """Fuse two maps in the world of a, with all keyframes."""
    moved = [replace(keyframe, T_world_camera=T_a_b @ keyframe.T_world_camera) for keyframe in b.keyframes]
    return SavedMap(fuse_maps([a.volume, b.volume], [np.eye(4), T_a_b]), [*a.keyframes, *moved], a.registrations)
