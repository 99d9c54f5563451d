"""Geometric verification of recognised places: plausible drift, and registration to the map of that time."""

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.dynamics.masks import Labels
from dudmap.core.frames.observation import Level, Observation
from dudmap.core.geometry import se3
from dudmap.core.geometry.se3 import agree
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.atlas import Atlas, TimedPose
from dudmap.core.places.loop_correction import TRUNCATED_DISTANCE, step_lengths
from dudmap.core.places.map_rebuilding import view_distances
from dudmap.core.places.place_recognition import PlaceMatch
from dudmap.core.tracking.frame_view import static_weights
from dudmap.core.tracking.quality_monitor import QualityMonitor
from dudmap.core.tracking.tracker import Tracker, TrackingResult
from dudmap.core.verdict import Outcome, Verdict

LOCAL_FRAMES = 8
"""Stored frames in the local map of a place, nearest first."""
LOCAL_DISTANCE, LOCAL_ANGLE_DEG = 0.8, 45.0
"""Largest distance (reference depths) and angle (deg) of these frames from the pose."""
DRIFT_ALLOWANCE, DRIFT_SHARE = 0.05, 0.1
"""Plausible drift after any path, reference depths and radians, and as a share of the path."""


@dataclass(frozen=True, eq=False)
class LoopQuery:
    """A tracked frame that may show a known place.

    Attributes:
        dynamic_mask: (H, W) bool.
        labels: See ``PoseEstimate``.
    """

    observation: Observation
    levels: list[Level]
    tracking: TrackingResult
    dynamic_mask: NDArray[np.bool_]
    labels: Labels | None = None

    @cached_property
    def static_weights(self) -> list[NDArray[np.float32]] | None:
        """Per level (h, w), weights of the registration; None = 1."""
        return None if self.labels is None else static_weights(self.labels, self.levels)


class LoopVerifier:
    """Decides whether a frame shows a recognised place, without changing the atlas."""

    def __init__(self, config: Config, atlas: Atlas, tracker: Tracker) -> None:
        self.config = config
        self.atlas = atlas
        self.tracker = tracker

    def plausibility(self, place: PlaceMatch, T_world_camera: NDArray[np.float64]) -> Verdict:
        """Whether the path since the last visit explains the implied drift.

        ``T_world_camera``: tracked pose (4, 4).
        """
        since = [pose.T_world_camera for pose in self._poses_since(place)]
        unit = self.atlas.unit
        path = step_lengths(np.reshape(since[::3], (-1, 4, 4)), unit).sum()  # every third pose: less jitter
        limit = DRIFT_ALLOWANCE + DRIFT_SHARE * path
        drift = se3.inverse(place.T_world_camera) @ T_world_camera
        distance, angle = float(np.linalg.norm(drift[:3, 3])), se3.rotation_angle(drift)
        far = "the path explains a drift of {limit:.2f}, not of {figure:.2f} "
        moved = Outcome.of("drift_m", distance, limit * unit, far + "m")
        return Verdict((moved, Outcome.of("drift_rad", angle, limit, far + "rad")))

    def register(self, place: PlaceMatch, query: LoopQuery, monitor: QualityMonitor) -> NDArray[np.float64] | None:
        """Pose (4, 4) of a frame in a local map up to the time of the place, or in its saved map; None unless features,
        distances and intensities agree."""
        local = self._local_map(place)
        if local is None:
            return None
        exposure = query.tracking.exposure
        found = self.tracker.align(local, query.levels, place.T_world_camera, query.static_weights, exposure=exposure)
        verdict = place.verdict(found, self.atlas.unit) + monitor.misfit(found)
        return found.T_world_camera if verdict.accepted else None

    def is_drifted(self, place: PlaceMatch, newest: LoopQuery, T_corrected_tracked: NDArray[np.float64]) -> bool:
        """Whether a correction improves the fit of the newest frame to the map of the place.

        The older pass are the frames stored before the farthest point of the path. True if none of them is near.
        """
        T_tracked = newest.tracking.T_world_camera
        T_corrected = T_corrected_tracked @ T_tracked
        since = list(self._poses_since(place))
        distances = view_distances(
            np.reshape([pose.T_world_camera for pose in since], (-1, 4, 4)), T_corrected, self.atlas.unit
        )
        older_pass = replace(place.keyframe, last_seen=since[int(np.argmax(distances))].timestamp)
        local = self._local_map(PlaceMatch(older_pass, T_corrected, place.num_inliers))
        return local is None or _misfit(local, newest, T_corrected) < _misfit(local, newest, T_tracked)

    def _poses_since(self, place: PlaceMatch) -> Iterator[TimedPose]:
        poses = self.atlas.poses
        begin = bisect_left(poses, place.keyframe.last_seen, key=lambda pose: pose.timestamp)
        return (pose for pose in islice(poses, begin, None) if pose.submap == self.atlas.current)

    def _local_map(self, place: PlaceMatch) -> TsdfVolume | None:
        """Map around a place at its last visit; None without stored frames nearby."""
        history, keyframe = self.atlas.history, place.keyframe
        assert history is not None
        if keyframe.submap == self.atlas.saved:
            return self.atlas.volumes[keyframe.submap]
        nearby = LOCAL_DISTANCE * self.atlas.unit
        nodes = [
            n
            for n in self.atlas.kept_nodes(keyframe.submap)
            if history.frames[n].timestamp <= keyframe.last_seen
            and agree(history.frames[n].T_world_camera, place.T_world_camera, nearby, LOCAL_ANGLE_DEG)
        ]
        T_camera_world = se3.inverse(place.T_world_camera)
        distances = [np.linalg.norm((T_camera_world @ history.frames[n].T_world_camera)[:3, 3]) for n in nodes]
        nearest = sorted(nodes[i] for i in np.argsort(distances, kind="stable")[:LOCAL_FRAMES])
        if not nearest:
            return None
        local = self.atlas.make_volume()
        history.reintegrate(local, nearest)
        return local


def _misfit(volume: TsdfVolume, query: LoopQuery, T_world_camera: NDArray[np.float64]) -> float:
    level = query.levels[-1]
    weights = np.ones_like(level.depth) if query.static_weights is None else query.static_weights[-1]
    volume.look_at(T_world_camera)
    sample = volume.sample(level.depth, level.intensity, level.camera, T_world_camera)
    largest = TRUNCATED_DISTANCE * volume.sensor.reference_depth
    distances = np.minimum(np.nan_to_num(np.abs(sample.distance), nan=largest), largest)
    return float(np.average(distances, weights=np.where(level.depth > 0, weights, 0)))
