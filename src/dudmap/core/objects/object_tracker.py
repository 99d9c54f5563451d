"""Moving objects with a lasting identity, position, extent and velocity (thesis section 7.1).

An object is a connected set of moving pixels; it never influences camera pose or map.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dudmap.config import MoversConfig
from dudmap.core.backends.median import median
from dudmap.core.frames.observation import Level
from dudmap.core.geometry import se3
from dudmap.core.objects.regions import (
    MIN_SHARE,
    connected_regions,
    is_fully_visible,
    measured_regions,
    split_between,
    trimmed_box,
)
from dudmap.core.objects.scene_flow import InstanceFrame, displacements
from dudmap.core.state import Remembered, Stateful

OUTLIER_SPEED = 0.7
"""Deviation of a velocity from the median beyond which the mask changed, reference depths per second."""
MERGE_DISTANCE = 0.3
"""Distance below which a small region joins a larger one, reference depths."""
MAX_JUMP = 0.4
"""Largest distance from the predicted position, reference depths; overlapping boxes also match."""
MEMORY = 0.7
"""Seconds out of view for which an object keeps its identity."""
VELOCITY_WINDOW = 0.2
"""Averaging time of the velocity, seconds."""
MAX_TRACKS = 255
"""Tracked objects, whose numbers are bytes."""
ESTABLISHED_SHARE = 0.3
"""Smallest separate part of an established object."""
ESTABLISHED = 0.5
"""Age after which touching objects stay separate, seconds."""


@dataclass(frozen=True, eq=False)
class Mover:
    """One moving object in one frame.

    Attributes:
        id: Number, at least 1, constant while the object is tracked.
        mask: (h, w) bool, at the resolution of the labels.
        points: (N, 3) float32, metres, world frame, of the mask pixels with depth.
        centroid: (3,) metres, world frame, mean of the visible points.
        box: (2, 3) metres, world frame, without the outermost 1 % of the points.
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

    ``velocity``: (3,) m/s since the last frame by optical flow, None if unknown. ``positions``: (2, 3) m, of its
    centroid and of the centre of its box.
    """

    time: float
    velocity: NDArray[np.float64] | None
    positions: NDArray[np.float64]
    fully_visible: bool


@dataclass(eq=False)
class _Track:
    """State of an object over time.

    ``first_seen``, ``last_seen``: seconds. ``size``, ``centroid``, ``box``, ``area``: in its last frame, in pixels, m
    and square metres. ``velocity``: m/s.
    """

    id: int
    first_seen: float
    last_seen: float
    size: int
    centroid: NDArray[np.float64]
    box: NDArray[np.float64]
    area: float
    velocity: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    measurements: list[_Measurement] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class _Shape:
    """An object in one frame: indices of its pixels (n,), its points (n, 3), centroid and box, m, its surface, m^2."""

    pixels: NDArray[np.intp]
    area: float
    points: NDArray[np.float32]
    centroid: NDArray[np.float64]
    box: NDArray[np.float64]

    @classmethod
    def of(cls, pixels: NDArray[np.intp], area: float, level: Level, T_world_camera: NDArray[np.float32]) -> "_Shape":
        v, u = np.divmod(pixels, level.camera.width)
        points = level.camera.points(u, v, level.depth.reshape(-1)[pixels])
        points = points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        return cls(pixels, area, points, points.mean(axis=0, dtype=np.float64), trimmed_box(points))


class ObjectTracker(Stateful):
    """Segments the moving pixels of each frame into objects and associates them with earlier objects.

    The last frame's moving pixels, displaced by their velocities, predict the object of each pixel and split touching
    objects. Velocities over the last ``VELOCITY_WINDOW`` seconds:

    * A fully visible object: slope of its positions.
    * A cut-off object: mean frame-to-frame displacement without outliers, each the median over pixels matched by
      optical flow (Lucas and Kanade 1981).
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
        self._tracks = [track for track in self._tracks if timestamp - track.last_seen <= MEMORY][:MAX_TRACKS]
        predicted = self._predicted(timestamp, level, T_world_camera)
        numbers = self._split(connected_regions(dynamic & (level.depth > 0), level), predicted)
        T = T_world_camera.astype(np.float32)
        objects = [_Shape.of(pixels, area, level, T) for pixels, area in self._joined(numbers, predicted, level)]
        tracks = self._associate(timestamp, objects, predicted)
        frame = InstanceFrame(timestamp, level, T_world_camera, np.zeros(level.camera.shape, dtype=np.int32))
        for shape, track in zip(objects, tracks, strict=True):
            frame.ids.reshape(-1)[shape.pixels] = track.id
        last, moved = self._last, {}
        if objects and last is not None and last.ids.shape == frame.ids.shape:
            seen = {track.id: shape.pixels for shape, track in zip(objects, tracks, strict=True)}
            moved = displacements(last, frame, seen, MAX_JUMP * self.reference_depth)
        self._last = frame if objects else None
        movers = []
        for shape, track in zip(objects, tracks, strict=True):
            mask = frame.ids == track.id
            velocity = moved[track.id] / (timestamp - track.last_seen) if track.id in moved else None
            visible = is_fully_visible(mask, level.depth, self.reference_depth)
            positions = np.stack([shape.centroid, shape.box.mean(axis=0)])
            self._update_velocity(track, _Measurement(timestamp, velocity, positions, visible))
            track.size, track.area = len(shape.pixels), shape.area
            track.centroid, track.box = shape.centroid, shape.box
            track.last_seen, age = timestamp, timestamp - track.first_seen
            movers.append(Mover(track.id, mask, shape.points, shape.centroid, shape.box, track.velocity.copy(), age))
        return sorted(movers, key=lambda mover: mover.id)

    def _predicted(self, timestamp: float, level: Level, T_world_camera: NDArray[np.float64]) -> NDArray[np.uint8]:
        """1 + index of the track predicted in each pixel (h, w) at constant velocity, 0 = none; by blocks of 2x2."""
        last, (h, w) = self._last, level.camera.shape
        if last is None or last.ids.shape != (h, w):
            return np.zeros((h, w), dtype=np.uint8)
        half = level.camera.resized((w + 1) // 2, (h + 1) // 2)
        out, index_of_id = np.zeros(half.shape, dtype=np.uint8), np.zeros(self._next_id, dtype=np.uint8)
        shifts = np.zeros((len(self._tracks) + 1, 3))
        for index, track in enumerate(self._tracks, start=1):
            index_of_id[track.id] = index
            shifts[index] = track.velocity * (timestamp - last.timestamp)
        pixels = 2 * np.stack(np.nonzero(last.ids[::2, ::2])[::-1], axis=1)
        index = index_of_id[last.ids[pixels[:, 1], pixels[:, 0]]]
        T = se3.inverse(T_world_camera)
        points = (last.points(pixels, pixels) + shifts[index]) @ T[:3, :3].T + T[:3, 3]
        order = np.argsort(-points[:, 2])  # the nearest point is written last
        inside, u, v = half.nearest_pixels(points[order])
        out[v, u] = index[order[inside]]
        return out.repeat(2, axis=0).repeat(2, axis=1)[:h, :w]

    def _split(self, numbers: NDArray[np.int32], predicted: NDArray[np.uint8]) -> NDArray[np.int32]:
        """Regions (h, w) of which each contains at most one established object."""
        established = [i + 1 for i, track in enumerate(self._tracks) if self._is_old(track)]
        if len(established) < 2:
            return numbers
        count = int(numbers.max()) + 1
        votes = np.bincount(numbers.reshape(-1) * np.int64(256) + predicted.reshape(-1), minlength=256 * count)
        votes = votes.reshape(count, 256)[:, established]
        sizes = [self._tracks[i - 1].size for i in established]
        contained = votes >= np.maximum(MIN_SHARE * numbers.size, ESTABLISHED_SHARE * np.array(sizes))
        contained[0] = False
        for number in np.flatnonzero(contained.sum(axis=1) > 1):
            region = numbers == number
            owners = split_between(region, predicted, [established[j] for j in np.flatnonzero(contained[number])])
            numbers[region] = numbers.max() + owners
        return numbers

    def _joined(
        self, numbers: NDArray[np.int32], predicted: NDArray[np.uint8], level: Level
    ) -> list[tuple[NDArray[np.intp], float]]:
        """Pixels and surface of each object: a region and its near fragments (same prediction, or much smaller)."""
        regions = measured_regions(numbers, level)
        if regions is None:
            return []
        near = regions.gaps < MERGE_DISTANCE * self.reference_depth
        owners = [int(np.argmax(np.bincount(predicted.reshape(-1)[pixels]))) for pixels in regions.pixels]
        groups: list[list[int]] = []
        areas = regions.areas
        for i in sorted(range(len(areas)), key=lambda i: -areas[i]):
            track = self._tracks[owners[i] - 1] if owners[i] else None
            own = track is not None and self._is_old(track) and areas[i] >= ESTABLISHED_SHARE * track.area
            for group in groups:
                same = owners[i] and owners[i] == owners[group[0]]
                small = not own and areas[i] < 0.5 * sum(areas[j] for j in group)
                if (same or small) and near[i, group].any():
                    group.append(i)
                    break
            else:
                groups.append([i])
        objects = [(np.concatenate([regions.pixels[i] for i in of]), sum(areas[i] for i in of)) for of in groups]
        return [(np.sort(pixels), area) for pixels, area in objects if area >= self.config.min_area]

    def _is_old(self, track: _Track) -> bool:
        return track.last_seen - track.first_seen >= ESTABLISHED and track.area >= 2 * self.config.min_area

    def _associate(self, timestamp: float, objects: list[_Shape], predicted: NDArray[np.uint8]) -> list[_Track]:
        """Track of each object, greedily by increasing distance from the prediction - max_jump * shared pixels, among
        similar places."""
        known, max_jump = list(self._tracks), MAX_JUMP * self.reference_depth
        found: dict[int, _Track] = {}
        if objects and known:
            shifts = np.array([track.velocity * (timestamp - track.last_seen) for track in known])
            boxes = np.array([shape.box for shape in objects])[:, None]
            expected = np.array([track.box for track in known]) + shifts[:, None]
            overlapping = np.all((expected[:, 0] <= boxes[:, :, 1]) & (boxes[:, :, 0] <= expected[:, 1]), axis=2)
            centroids = np.array([shape.centroid for shape in objects])[:, None]
            distance = np.linalg.norm(np.array([track.centroid for track in known]) + shifts - centroids, axis=2)
            votes = [np.bincount(predicted.reshape(-1)[shape.pixels], minlength=len(known) + 1) for shape in objects]
            shared = np.array([vote[1:] / vote.sum() for vote in votes])
            possible = (shared > 0.3) | (distance < max_jump) | overlapping
            cost = np.where(possible, distance - max_jump * shared, np.inf)
            while cost.min() < np.inf:
                i, j = divmod(int(np.argmin(cost)), len(known))
                found[i] = known[j]
                cost[i], cost[:, j] = np.inf, np.inf
        for i, shape in enumerate(objects):
            if i not in found:
                found[i] = _Track(
                    self._next_id, timestamp, timestamp, len(shape.pixels), shape.centroid, shape.box, shape.area
                )
                self._tracks.append(found[i])
                self._next_id += 1
        return [found[i] for i in range(len(objects))]

    def _update_velocity(self, track: _Track, measurement: _Measurement) -> None:
        recent = [m for m in track.measurements if measurement.time - m.time < VELOCITY_WINDOW]
        track.measurements = [*recent, measurement]
        estimates = []
        velocities = np.array([m.velocity for m in track.measurements if m.velocity is not None])
        if len(velocities):
            deviation = np.linalg.norm(velocities - median(velocities), axis=1)
            largest = max(OUTLIER_SPEED * self.reference_depth, float(np.median(deviation)))
            estimates.append(velocities[deviation <= largest].mean(axis=0))
        usable = [m for m in track.measurements if m.fully_visible] if velocities.size else track.measurements
        if len(usable) >= 2 and (measurement.fully_visible or not velocities.size):
            times = np.array([m.time for m in usable])
            times = times - times.mean()
            positions = np.stack([m.positions for m in usable])
            estimates += list(np.tensordot(times, positions, 1) / np.sum(times**2))
        if estimates:
            track.velocity = median(np.array(estimates))
