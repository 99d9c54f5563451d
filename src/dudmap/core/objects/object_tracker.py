"""Moving objects with a lasting identity, position, extent and velocity (thesis section 7.1).

An object is a spatially connected set of moving pixels, without a classifier; it never influences camera pose or map.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dudmap.config import MoversConfig
from dudmap.core.backends.median import median
from dudmap.core.frames.observation import Level
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.objects.regions import (
    MIN_SHARE,
    MovingPixels,
    Region,
    connected_regions,
    is_fully_visible,
    split_between,
    trimmed_box,
)
from dudmap.core.objects.scene_flow import InstanceFrame, displacements
from dudmap.core.state import Remembered, Stateful

OUTLIER_SPEED = 0.7
"""Largest deviation of a displacement's velocity from the median, reference depths per second; beyond, the mask
changed."""
MERGE_DISTANCE = 0.3
"""Distance below which a small region is merged with a larger one, reference depths."""
MAX_JUMP = 0.4
"""Largest distance from the predicted position in data association, reference depths; overlapping boxes also match."""
MEMORY = 0.7
"""Time for which an object out of view keeps its identity, seconds."""
VELOCITY_WINDOW = 0.2
"""Time over which the velocity is averaged, seconds."""
ESTABLISHED = 0.5
"""Age after which separate objects stay separate when they touch, seconds."""


@dataclass(frozen=True, eq=False)
class Mover:
    """One moving object in one frame.

    Attributes:
        id: Number, at least 1, constant while the object is tracked.
        mask: (h, w) bool, at the resolution of the labels.
        points: (N, 3) float32, metres, world frame, of the mask pixels with depth.
        centroid: (3,) metres, world frame, mean of the points: of the visible side, not of the object.
        box: (2, 3) metres, world frame, smallest and largest coordinates, without the outermost 1 % of the points.
        velocity: (3,) m/s, world frame; 0 in the first frame.
        age: Seconds since it was first seen.
    """

    id: int
    mask: NDArray[np.bool_]
    points: NDArray[np.float32]
    centroid: NDArray[np.float64]
    box: NDArray[np.float64]
    velocity: NDArray[np.float64]
    age: float

    @property
    def speed(self) -> float:
        """Length of the velocity, m/s."""
        return float(np.linalg.norm(self.velocity))


@dataclass(frozen=True, eq=False)
class _Measurement:
    """Motion of an object in one frame.

    ``duration``: seconds since it was last seen. ``displacement``: (3,) m since then by optical flow, None if unknown.
    ``positions``: (2, 3) m, of its centroid and of the centre of its box.
    """

    time: float
    duration: float
    displacement: NDArray[np.float64] | None
    positions: NDArray[np.float64]
    fully_visible: bool


@dataclass(eq=False)
class _Track:
    """State of an object over time: times in seconds, last centroid and box (m), area in square metres."""

    id: int
    first_seen: float
    last_seen: float
    centroid: NDArray[np.float64]
    box: NDArray[np.float64]
    area: float = 0.0
    velocity: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    measurements: list[_Measurement] = field(default_factory=list)


class ObjectTracker(Stateful):
    """Segments the moving pixels of each frame into objects and associates them with earlier objects.

    The moving pixels of the last frame, displaced by the velocities of their objects, predict the object of each pixel.
    They also split the region of touching objects. Velocities are estimated over the last ``VELOCITY_WINDOW`` seconds:

    * A fully visible object: slope of a line through its positions (the surface of a rolling ball is faster).
    * An object cut off by the image border or an occluder: mean of its frame-to-frame displacements without outliers.
      Each is the median over pixels matched by forward-backward optical flow (Lucas and Kanade 1981).
    """

    _tracks: Remembered[list[_Track]]
    _last: Remembered[InstanceFrame | None] = None
    _next_id: Remembered[int] = 1

    def __init__(self, config: MoversConfig, reference_depth: float = 1.0) -> None:
        self.config = config
        self.reference_depth = reference_depth
        self._tracks = []

    def update(
        self, timestamp: float, dynamic: NDArray[np.bool_], level: Level, T_world_camera: NDArray[np.float64]
    ) -> list[Mover]:
        """Moving objects of a tracked frame, by number; ``dynamic`` (h, w) marks the moving pixels of ``level``."""
        self._tracks = [track for track in self._tracks if timestamp - track.last_seen <= MEMORY]
        predicted_ids = self._predicted_ids(timestamp, level.camera, T_world_camera)
        pixels = connected_regions(dynamic, level, T_world_camera, predicted_ids)
        objects = [] if pixels is None else self._segment(pixels)
        if pixels is None or not objects:
            self._last = None
            return []
        clouds = [pixels.points[indices] for indices in objects]
        boxes = [trimmed_box(points) for points in clouds]
        centroids = [points.mean(axis=0, dtype=np.float64) for points in clouds]
        tracks = self._associate(timestamp, objects, centroids, boxes, pixels.predicted_id)
        frame = _instance_frame(timestamp, level, pixels, objects, tracks)
        known_displacements: dict[int, NDArray[np.float64]] = {}
        if self._last is not None and self._last.ids.shape == frame.ids.shape:
            known = [track.id for track in self._tracks if track.last_seen == self._last.timestamp]
            known_displacements = displacements(self._last, frame, known, MAX_JUMP * self.reference_depth)
        movers = []
        for indices, track, centroid, box in zip(objects, tracks, centroids, boxes, strict=True):
            mask = frame.ids == track.id
            measurement = _Measurement(
                timestamp,
                timestamp - track.last_seen,
                known_displacements.get(track.id),
                np.stack([centroid, box.mean(axis=0)]),
                is_fully_visible(mask, level.depth, self.reference_depth),
            )
            self._update_velocity(track, measurement)
            track.centroid, track.box, track.last_seen = centroid, box, timestamp
            track.area = float(pixels.area[indices].sum())
            age = timestamp - track.first_seen
            movers.append(Mover(track.id, mask, frame.points[mask], centroid, box, track.velocity.copy(), age))
        self._last = frame
        return sorted(movers, key=lambda mover: mover.id)

    def _predicted_ids(
        self, timestamp: float, camera: Camera, T_world_camera: NDArray[np.float64]
    ) -> NDArray[np.int32]:
        """Object predicted at constant velocity in each 2x2 pixels: ((h + 1) // 2, (w + 1) // 2), 0 = none."""
        h, w = (camera.height + 1) // 2, (camera.width + 1) // 2
        out = np.zeros((h, w), dtype=np.int32)
        last = self._last
        if last is None or last.ids.shape != camera.shape:
            return out
        number = last.ids[::2, ::2]
        occupied = number > 0
        number = number[occupied]
        shift = np.zeros((self._next_id, 3), dtype=np.float32)
        for track in self._tracks:
            shift[track.id] = track.velocity * (timestamp - last.timestamp)
        T = se3.inverse(T_world_camera).astype(np.float32)
        points = (last.points[::2, ::2][occupied] + shift[number]) @ T[:3, :3].T + T[:3, 3]
        order = np.argsort(-points[:, 2])  # the nearest point is written last
        order = order[: np.count_nonzero(points[:, 2] > 0)]
        number = number[order]
        u, v = ((camera.project(points[order]) + 0.5) / 2).astype(np.int64).T
        inside = (u >= 0) & (v >= 0) & (u < w) & (v < h)
        out[v[inside], u[inside]] = number[inside]
        return out

    def _segment(self, pixels: MovingPixels) -> list[NDArray[np.int64]]:
        """Pixels (k,) of each object, after splitting regions of touching objects and joining fragments."""
        regions = [
            Region.of(pixels, indices)
            for start, stop in pixels.ranges
            for indices in self._split(np.arange(start, stop), pixels)
        ]
        regions.sort(key=lambda region: -region.area)
        groups: list[list[Region]] = []
        for region in regions:
            fitting = next((group for group in self._candidates(region, groups) if self._is_near(region, group)), None)
            groups.append([region]) if fitting is None else fitting.append(region)
        return [
            np.concatenate([region.indices for region in group])
            for group in groups
            if sum(region.area for region in group) >= self.config.min_area
        ]

    def _split(self, indices: NDArray[np.int64], pixels: MovingPixels) -> list[NDArray[np.int64]]:
        """Parts of a region that contains several established objects; otherwise the region alone."""
        least = MIN_SHARE * pixels.shape[0] * pixels.shape[1]
        if len(indices) < 2 * least or len(self._tracks) < 2:
            return [indices]
        predicted = pixels.predicted_id[indices]
        counts = np.bincount(predicted)
        ids = [
            track.id
            for track in self._tracks
            if track.id < len(counts)
            and counts[track.id] >= least
            and self._is_established(track, float(pixels.area[indices[predicted == track.id]].sum()))
        ]
        return [indices] if len(ids) < 2 else split_between(pixels, indices, ids)

    def _candidates(self, region: Region, groups: list[list[Region]]) -> list[list[Region]]:
        """Objects that may include a region: same prediction, or much larger."""
        same = [group for group in groups if region.predicted_id and group[0].predicted_id == region.predicted_id]
        track = next((track for track in self._tracks if track.id == region.predicted_id), None)
        if track and self._is_established(track, region.area):
            return same
        return same + [group for group in groups if region.area < 0.5 * sum(part.area for part in group)]

    def _is_near(self, region: Region, group: list[Region]) -> bool:
        return any(region.is_near(part, MERGE_DISTANCE * self.reference_depth) for part in group)

    def _is_established(self, track: _Track, area: float) -> bool:
        known = track.last_seen - track.first_seen >= ESTABLISHED and track.area >= 2 * self.config.min_area
        return known and area >= 0.3 * track.area

    def _associate(
        self,
        timestamp: float,
        objects: list[NDArray[np.int64]],
        centroids: list[NDArray[np.float64]],
        boxes: list[NDArray[np.float64]],
        predicted_id: NDArray[np.int32],
    ) -> list[_Track]:
        """Track of each object, greedily by increasing cost: distance from the prediction - max_jump * shared pixels.

        Candidates share more than 0.3 of the pixels, lie closer than ``max_jump`` or have overlapping boxes.
        """
        candidates, max_jump = [], MAX_JUMP * self.reference_depth
        if self._tracks:
            ids = [track.id for track in self._tracks]
            shifts = np.array([track.velocity * (timestamp - track.last_seen) for track in self._tracks])
            expected = np.array([track.centroid for track in self._tracks]) + shifts
            expected_boxes = np.array([track.box for track in self._tracks]) + shifts[:, None]
            for i, (indices, centroid, box) in enumerate(zip(objects, centroids, boxes, strict=True)):
                shared = np.bincount(predicted_id[indices], minlength=self._next_id)[ids] / len(indices)
                distances = np.linalg.norm(expected - centroid, axis=1)
                overlapping = np.all((expected_boxes[:, 0] <= box[1]) & (box[0] <= expected_boxes[:, 1]), axis=1)
                possible = np.flatnonzero((shared > 0.3) | (distances < max_jump) | overlapping)
                candidates += [(distances[j] - max_jump * shared[j], i, int(j)) for j in possible]
        tracks: dict[int, _Track] = {}
        assigned: set[int] = set()
        for _, i, j in sorted(candidates):
            if i not in tracks and j not in assigned:
                tracks[i] = self._tracks[j]
                assigned.add(j)
        for i in range(len(objects)):
            if i not in tracks:
                tracks[i] = _Track(self._next_id, timestamp, timestamp, centroids[i], boxes[i])
                self._tracks.append(tracks[i])
                self._next_id += 1
        return [tracks[i] for i in range(len(objects))]

    def _update_velocity(self, track: _Track, measurement: _Measurement) -> None:
        """Velocity: median of estimates from displacements and from slopes of positions."""
        recent = [m for m in track.measurements if measurement.time - m.time < VELOCITY_WINDOW]
        track.measurements = [*recent, measurement]
        estimates = []
        velocities = np.array(
            [m.displacement / m.duration for m in track.measurements if m.displacement is not None and m.duration > 0]
        )
        if len(velocities):
            deviation = np.linalg.norm(velocities - median(velocities), axis=1)
            largest = max(OUTLIER_SPEED * self.reference_depth, float(np.median(deviation)))
            estimates.append(velocities[deviation <= largest].mean(axis=0))
        usable = [m for m in track.measurements if m.fully_visible] if velocities.size else track.measurements
        if len(usable) >= 2 and (measurement.fully_visible or not velocities.size):
            times = np.array([m.time for m in usable])
            times = times - times.mean()
            positions = np.stack([m.positions for m in usable])
            estimates += list(np.einsum("t,tij->ij", times, positions) / np.sum(times**2))
        if estimates:
            track.velocity = median(np.array(estimates))


def _instance_frame(
    timestamp: float, level: Level, pixels: MovingPixels, objects: list[NDArray[np.int64]], tracks: list[_Track]
) -> InstanceFrame:
    """Images of the ids and points of the moving objects of a frame."""
    ids = np.zeros(pixels.shape, dtype=np.int32)
    points = np.zeros((*pixels.shape, 3), dtype=np.float32)
    points.reshape(-1, 3)[pixels.flat] = pixels.points
    for indices, track in zip(objects, tracks, strict=True):
        ids.reshape(-1)[pixels.flat[indices]] = track.id
    return InstanceFrame(timestamp, level.grey, ids, points)
