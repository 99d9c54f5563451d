"""Known places seen again: the drift since then is measured, spread over the trajectory, and taken out of the map."""

import weakref
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.frames.observation import Level, Observation
from dudmap.geometry import se3
from dudmap.geometry.alignment import agree
from dudmap.mapping.volume import TsdfVolume
from dudmap.places.atlas import Atlas
from dudmap.places.place_recognition import Keyframe, PlacedFeatures, PlaceMatch
from dudmap.places.pose_graph import Edge, optimize
from dudmap.tracking.quality_monitor import QualityMonitor
from dudmap.tracking.tracker import Tracker, TrackingResult

NEAR = 0.5, 30.0
"""A keyframe within this distance (m) and angle (deg) is being seen; frames that close to it show its place."""
EVERY = 5
"""Frames from one look at which keyframes are near to the next, and from a comparison of features to its outcome."""
SAME = 0.03, 1.0
"""Corrections measured by two frames are the same if they differ by less than this, metres and degrees."""
LOCAL = 8
"""Kept frames that the map of a place is built of, to register a frame against it."""
COMPARED = 12
"""Kept frames that the corrected map is compared with the old one by."""
FARTHEST = 0.05
"""A distance to the map counts at most this much in that comparison, metres."""
PATH_NOISE = 0.002, 0.02
"""Standard deviation of a tracked motion: metres, and per metre of its path."""
LOOP_NOISE = 0.005, 0.003
"""Standard deviation of a motion measured at a place seen again: metres and radians."""


@dataclass(frozen=True, eq=False)
class View:
    """A tracked frame that may show a known place.

    Attributes:
        observation: The frame.
        levels: Its image pyramid, coarse to fine.
        static_weights: Per level (h, w), None counts every pixel.
        static_mask: (H, W) bool.
        tracked: Its registration against the map.
    """

    observation: Observation
    levels: list[Level]
    static_weights: list[NDArray[np.float32]] | None
    static_mask: NDArray[np.bool_]
    tracked: TrackingResult


@dataclass(frozen=True, eq=False)
class Search:
    """A frame that is being compared with keyframes.

    Attributes:
        view: The frame.
        submap: That it was tracked in.
        returned: Whether the camera should be where it has not been for a while.
        places: What it is found to show.
        due: Number of the frame at which that is decided on.
    """

    view: View
    submap: int
    returned: bool
    places: "Future[list[PlaceMatch]]"
    due: int


class LoopCloser:
    """Looks for places seen before, and corrects what the tracking has drifted since.

    A place is believed when its features (3D-3D RANSAC), the map of its own time (distances) and that map's image
    (intensities) put the camera at the same pose, twice, from two frames. The corrected map replaces the old one only
    if the frames fit it as well.

    Args:
        config: All parameters.
        atlas: What is corrected.
        tracker: Registers frames.
    """

    def __init__(self, config: Config, atlas: Atlas, tracker: Tracker) -> None:
        self.config = config
        self.atlas = atlas
        self.tracker = tracker
        self.closed = 0
        self._count = 0
        self._next_attempt = 0
        self._failures = 0
        self._num_keyframes = 0
        self._search: Search | None = None
        self._searcher: ThreadPoolExecutor | None = None
        self._pending: tuple[int, NDArray[np.float64]] | None = None  # submap and correction a first frame measured
        self._edges: list[Edge] = []

    def close(self, view: View, health: QualityMonitor) -> NDArray[np.float64] | None:
        """Correct the atlas if a frame shows a place from which the tracking has drifted, or one of another submap.

        The features are compared beside the next frames; a frame's places are decided on a fixed number of frames
        later, so that the same recording always gives the same result.

        Returns:
            (4, 4) motion of the frame's pose by the correction, None where nothing was corrected.
        """
        self._count += 1
        if self._search is not None:
            if self._count < self._search.due:
                return None
            search, self._search = self._search, None
            if search.submap == self.atlas.current:
                return self._decide(search, health)
        keyframes = self.atlas.keyframes.keyframes
        new_keyframe, self._num_keyframes = len(keyframes) > self._num_keyframes, len(keyframes)
        if not new_keyframe and self._count % EVERY:
            return None
        now = view.observation.timestamp
        near = self.atlas.keyframes.near(view.tracked.T_world_camera, self.atlas.current, *NEAR)
        returned = any(self._old(keyframe, now) for keyframe in near)
        among = [keyframe for keyframe in keyframes if self._candidate(keyframe, now)]
        wanted = new_keyframe or returned or self._pending or len(self.atlas.volumes) > 1
        if among and wanted and self._count >= self._next_attempt:
            self._look(view, among, returned)
        if not returned:  # what has come back stays unseen until it is decided
            _see(near, now)
        return None

    def _look(self, view: View, among: list[Keyframe], returned: bool) -> None:
        """Compare a frame with these keyframes, in a thread of its own."""
        if self._searcher is None:
            self._searcher = ThreadPoolExecutor(1, thread_name_prefix="dudmap-loops")
            weakref.finalize(self, self._searcher.shutdown, wait=False)
        features = self._features(view)
        places = self._searcher.submit(self.atlas.keyframes.match, features, among)
        self._search = Search(view, self.atlas.current, returned, places, self._count + EVERY)
        self._next_attempt = self._count + self.config.loops.gap

    def _features(self, view: View) -> PlacedFeatures:
        """Features of a frame; those of the newest keyframe if the frame has just become one."""
        keyframes = self.atlas.keyframes.keyframes
        if keyframes and keyframes[-1].timestamp == view.observation.timestamp:
            return keyframes[-1].features
        return self.atlas.keyframes.extract(view.observation, view.static_mask)

    def _old(self, keyframe: Keyframe, now: float) -> bool:
        return now - keyframe.last_seen > self.config.loops.min_age

    def _candidate(self, keyframe: Keyframe, now: float) -> bool:
        if keyframe.submap != self.atlas.current:
            return self.config.submaps.enabled
        return self.config.loops.enabled and self._old(keyframe, now)

    def _decide(self, search: "Search", health: QualityMonitor) -> NDArray[np.float64] | None:
        """Correction by the places that a frame was found to show, None if none was made."""
        view, T = search.view, search.view.tracked.T_world_camera
        pending, self._pending = self._pending, None
        in_vain = search.returned
        for place in search.places.result()[:2]:
            submap = place.keyframe.submap
            same = submap == self.atlas.current
            noise = 1.5 * self.config.loops.min_distance, 1.5 * self.config.loops.min_angle_deg
            if same and agree(place.T_world_camera, T, *noise):
                return self._confirm(place, view)
            if same and not self._believable(place, T):
                continue
            T_found = self._registered(place, view, health)
            if T_found is None:
                in_vain = True
                continue
            self._failures = 0
            if same and agree(T_found, T, self.config.loops.min_distance, self.config.loops.min_angle_deg):
                return self._confirm(place, view)
            correction = T_found @ se3.inverse(T)
            if pending is None or pending[0] != submap or not agree(pending[1] @ T, T_found, *SAME):
                self._pending = submap, correction  # a second frame must say the same
                self._next_attempt = self._count
                return None
            return self._correct(place, view, T_found) if same else self._join(submap, correction)
        if in_vain:  # and dear: the next time later
            self._failures = min(self._failures + 1, 4)
            self._next_attempt = self._count + self._failures * self.config.loops.gap
        return None

    def _confirm(self, place: PlaceMatch, view: View) -> None:
        """Remember that there was no drift between a place and now: later corrections leave that part alone."""
        self._failures = 0
        T = view.tracked.T_world_camera
        self._edges += self._edge(place, view, T)
        _see(self.atlas.keyframes.near(T, self.atlas.current, *NEAR), view.observation.timestamp)

    def _edge(self, place: PlaceMatch, view: View, T_world_camera: NDArray[np.float64]) -> list[Edge]:
        """Measured motion from a kept frame of a place to the newest kept frame; none if they are the same."""
        history = self.atlas.history
        assert history is not None
        nodes = self.atlas.nodes(self.atlas.current)
        if len(nodes) < 2:
            return []
        stamps = np.array([history.timestamps[n] for n in nodes])
        old = nodes[int(np.argmin(np.abs(stamps - place.keyframe.timestamp)))]
        if old == nodes[-1]:
            return []
        T_camera_new = se3.inverse(view.tracked.T_world_camera) @ history.Ts_world_camera[nodes[-1]]
        T_old_new = se3.inverse(history.Ts_world_camera[old]) @ T_world_camera @ T_camera_new
        return [Edge(old, nodes[-1], T_old_new, *LOOP_NOISE)]

    def _believable(self, place: PlaceMatch, T: NDArray[np.float64]) -> bool:
        """Whether the path since a place was last seen is long enough for such a drift."""
        since = [
            pose.T_world_camera
            for pose in self.atlas.poses
            if pose.submap == self.atlas.current and pose.timestamp >= place.keyframe.last_seen
        ]
        path = _path_length(since[::3])
        drift = se3.inverse(place.T_world_camera) @ T
        limit = 0.05 + self.config.loops.max_drift * path
        return bool(np.linalg.norm(drift[:3, 3]) < limit) and se3.rotation_angle(drift) < limit

    def _registered(self, place: PlaceMatch, view: View, health: QualityMonitor) -> NDArray[np.float64] | None:
        """Pose of the frame in the map of a place's own time; None unless features, distances and image agree."""
        history = self.atlas.history
        assert history is not None
        keyframe, limits = place.keyframe, self.config.relocalization
        nodes = [
            n
            for n in self.atlas.nodes(keyframe.submap)
            if history.timestamps[n] <= keyframe.last_seen
            and agree(history.Ts_world_camera[n], place.T_world_camera, 0.8, 45.0)
        ]
        apart = [np.linalg.norm((se3.inverse(place.T_world_camera) @ history.Ts_world_camera[n])[:3, 3]) for n in nodes]
        nearest = sorted(nodes[i] for i in np.argsort(apart, kind="stable")[:LOCAL])
        if not nearest:
            return None
        local = self.atlas.make_volume()
        history.reintegrate(local, nearest)
        found = self.tracker.align(
            local, view.levels, place.T_world_camera, view.static_weights, exposure=view.tracked.exposure
        )
        if (
            found.converged
            and not health.deviation(found, recognized=True)
            and found.inlier_share >= limits.min_on_map
            and agree(found.T_world_camera, place.T_world_camera, limits.max_distance, limits.max_angle_deg)
        ):
            return found.T_world_camera
        return None

    def _correct(self, place: PlaceMatch, view: View, T_found: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Spread the drift over the kept frames, build the map anew, and take it over if it is no worse."""
        history = self.atlas.history
        assert history is not None
        nodes = self.atlas.nodes(self.atlas.current)
        loop = self._edge(place, view, T_found)
        if not loop:
            return None
        number = {n: i for i, n in enumerate(nodes)}
        Ts = np.stack([history.Ts_world_camera[n] for n in nodes])
        edges = [_tracked_edge(i, Ts) for i in range(len(nodes) - 1)]
        for edge in (*self._edges, *loop):
            if edge.a in number and edge.b in number:
                edges.append(Edge(number[edge.a], number[edge.b], edge.T_a_b, edge.sigma_distance, edge.sigma_angle))
        Ts_new = optimize(Ts, edges)
        if not np.all(np.isfinite(Ts_new)):
            return None
        volume = self.atlas.make_volume()
        history.reintegrate(volume, nodes, list(Ts_new))
        if self._worse(volume, nodes, Ts, Ts_new):
            return None
        self._edges += loop
        self.closed += 1
        return self.atlas.correct(nodes, Ts_new, volume)

    def _worse(
        self, volume: TsdfVolume, nodes: list[int], Ts: NDArray[np.float64], Ts_new: NDArray[np.float64]
    ) -> bool:
        """Whether the kept frames fit the corrected map clearly worse than the old one, in distance or in image."""
        chosen = np.unique(np.linspace(0, len(nodes) - 1, COMPARED).round().astype(int))
        before = self.misfit(self.atlas.volume, [nodes[i] for i in chosen], Ts[chosen])
        after = self.misfit(volume, [nodes[i] for i in chosen], Ts_new[chosen])
        return bool(after[0] > 1.15 * before[0] + 0.0005 or after[1] > 1.15 * before[1] + 0.002)

    def misfit(self, volume: TsdfVolume, nodes: list[int], Ts: NDArray[np.float64]) -> tuple[float, float]:
        """Mean distance (m) and mean difference of intensity (0..1) of kept frames to a map at poses (n, 4, 4)."""
        import cv2

        history = self.atlas.history
        assert history is not None
        camera = self.atlas.keyframes.camera.scaled(2)
        distances, differences = [], []
        for n, T in zip(nodes, Ts, strict=True):
            stored = history[n]
            depth = np.where(stored.static, stored.frame.depth, np.float32(0))[1::4, 1::4]
            grey = cv2.cvtColor(stored.frame.color, cv2.COLOR_RGB2GRAY)
            size = (depth.shape[1], depth.shape[0])
            intensity = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32) / np.float32(255)
            volume.look_at(T)
            sample = volume.sample(np.ascontiguousarray(depth), np.asarray(intensity), camera, T)
            on_map = np.isfinite(sample.distance)
            distances.append(np.minimum(np.abs(sample.distance[on_map]), FARTHEST))
            differences.append(np.abs(sample.difference[on_map]))
        return float(np.concatenate(distances).mean()), float(np.concatenate(differences).mean())

    def _join(self, other: int, T_other_current: NDArray[np.float64]) -> NDArray[np.float64]:
        """Make one map of the current submap and another; the older one's world stays."""
        current = self.atlas.current
        self.closed += 1
        if other < current:
            self.atlas.join(current, other, T_other_current)
            return T_other_current
        self.atlas.join(other, current, se3.inverse(T_other_current))
        return np.eye(4)


def _see(keyframes: list[Keyframe], now: float) -> None:
    for keyframe in keyframes:
        keyframe.last_seen = now


def _tracked_edge(i: int, Ts: NDArray[np.float64]) -> Edge:
    """Motion from one kept frame to the next as it was tracked, the less certain the longer it is."""
    T_a_b = se3.inverse(Ts[i]) @ Ts[i + 1]
    path = _path_length([Ts[i], Ts[i + 1]])
    sigma = PATH_NOISE[0] + PATH_NOISE[1] * path
    return Edge(i, i + 1, T_a_b, sigma, sigma)


def _path_length(Ts: list[NDArray[np.float64]]) -> float:
    """Length of a path in metres; a turn by one radian counts a metre."""
    steps = [se3.inverse(a) @ b for a, b in pairwise(Ts)]
    return float(sum(np.linalg.norm(step[:3, 3]) + se3.rotation_angle(step) for step in steps))
