"""What moves, as things: connected bodies with a name that lasts, a place, an extent and a velocity (thesis 7.1).

No classifier: a body is what the labels call moving and what hangs together in space. Nothing here reaches the pose.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dudmap.config import MoversConfig
from dudmap.kernels import labeling
from dudmap.tracker import Level

SAMPLES = 60
"""Points per region that measure the gap to another region."""
MOST_REGIONS = 24
"""Larger regions that are looked at; the rest is noise."""
PAIRED_PIXELS = 150
"""Pixels of a body that are looked for in the last frame."""
FEWEST_PIXELS = 15
"""Pixels with a known motion that make a velocity."""
WINDOW = 9
"""Width of the patch that is looked for, pixels."""
SPECK = 8
"""Regions of fewer pixels are noise."""


@dataclass(frozen=True, eq=False)
class Mover:
    """One moving body in one frame.

    Attributes:
        id: Number from 1 on; stays while the body is visible.
        mask: (h, w) bool, at the resolution of the labels.
        points: (N, 3) float32, metres, world frame, of the pixels in the mask that have a reading.
        centroid: (3,) metres, world frame, mean of the points: of the visible side, not of the body.
        box: (2, 3) metres, world frame, smallest and largest coordinates, without the outermost 1 % of the points.
        velocity: (3,) m/s, world frame; 0 until the body has been seen twice.
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


@dataclass(eq=False)
class _Track:
    """What is remembered of a body."""

    id: int
    first_seen: float
    last_seen: float
    centroid: NDArray[np.float64]
    box: NDArray[np.float64]
    velocity: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    steps: list[tuple[float, float, NDArray[np.float64]]] = field(default_factory=list)  # time, duration, way


@dataclass(frozen=True, eq=False)
class _Seen:
    """The last frame: where each of its pixels was in the world, and whose it was."""

    timestamp: float
    grey: NDArray[np.uint8]
    points: NDArray[np.float32]
    ids: NDArray[np.int32]


class MoverTracker:
    """Bodies of a frame, matched to those of the frames before.

    A body's velocity is the mean of its motions during the last ``velocity_window`` seconds. The motion from one frame
    to the next is the median displacement in the world of its pixels, paired by optical flow there and back (Lucas and
    Kanade 1981), because the centroid of the visible part also moves when more or less of the body comes into view. Where
    too few pixels can be paired, the centroid's motion is taken.

    Args:
        config: Sizes and times.
    """

    def __init__(self, config: MoversConfig) -> None:
        self.config = config
        self._tracks: list[_Track] = []
        self._last: _Seen | None = None
        self._next_id = 1

    def update(
        self, timestamp: float, dynamic: NDArray[np.bool_], level: Level, T_world_camera: NDArray[np.float64]
    ) -> list[Mover]:
        """Movers of a tracked frame, by id.

        Args:
            timestamp: Seconds.
            dynamic: (h, w) bool, moving pixels.
            level: The image they were found in.
            T_world_camera: (4, 4).
        """
        self._tracks = [track for track in self._tracks if timestamp - track.last_seen <= self.config.memory]
        bodies = self._bodies(dynamic, level)
        if not bodies:
            self._last = None
            return []
        T = T_world_camera.astype(np.float32)
        points = level.camera.backproject(level.depth) @ T[:3, :3].T + T[:3, 3]
        ids = np.zeros(dynamic.shape, dtype=np.int32)
        seen = _Seen(timestamp, np.clip(255 * level.intensity, 0, 255).astype(np.uint8), points, ids)
        movers = []
        for mask, track in self._matched(timestamp, bodies, points):
            ids[mask] = track.id
            body = points[mask]
            centroid = body.mean(axis=0, dtype=np.float64)
            way = self._way(mask, track, seen)
            if way is None and track.last_seen < timestamp:
                way = centroid - track.centroid
            if way is not None:
                self._take_step(track, timestamp, way)
            track.centroid, track.last_seen = centroid, timestamp
            track.box = _box(body)
            age = timestamp - track.first_seen
            movers.append(Mover(track.id, mask, body, centroid, track.box, track.velocity.copy(), age))
        self._last = seen
        return sorted(movers, key=lambda mover: mover.id)

    def _bodies(self, dynamic: NDArray[np.bool_], level: Level) -> list[NDArray[np.bool_]]:
        """Masks of the bodies: regions connected in depth, small ones joined to larger ones close by."""
        moving = dynamic & (level.depth > 0)
        if not moving.any():
            return []
        regions = np.empty(moving.shape, dtype=np.int32)
        count = labeling.grow(moving, moving, level.depth, np.float32(0.02) + np.float32(0.02) * level.depth, regions)
        pixel = level.depth.astype(np.float64) ** 2 / (level.camera.fx * level.camera.fy)
        areas = np.bincount(regions.reshape(-1), pixel.reshape(-1), minlength=count + 1).astype(np.float64)
        areas[np.bincount(regions.reshape(-1), minlength=count + 1) < SPECK] = 0
        areas[0] = 0
        kept = [int(number) for number in np.argsort(-areas, kind="stable")[:MOST_REGIONS] if areas[number] > 0]
        points = level.camera.backproject(level.depth)
        samples = {number: _thinned(points[regions == number]) for number in kept}
        bodies: list[list[int]] = []
        for number in kept:  # the largest first
            near = [body for body in bodies if self._belongs(number, body, areas, samples)]
            near[0].append(number) if near else bodies.append([number])
        masks = [np.isin(regions, body) for body in bodies if areas[body].sum() >= self.config.min_area]
        return masks

    def _belongs(
        self, number: int, body: list[int], areas: NDArray[np.float64], samples: dict[int, NDArray[np.float32]]
    ) -> bool:
        """Whether a region is a fragment of a body: much smaller, and close to a part of it."""
        if areas[number] > 0.5 * areas[body].sum():
            return False
        return any(_gap(samples[number], samples[part]) < self.config.merge_distance for part in body)

    def _matched(
        self, timestamp: float, bodies: list[NDArray[np.bool_]], points: NDArray[np.float32]
    ) -> list[tuple[NDArray[np.bool_], _Track]]:
        """Each body with its track, old ones by the nearest prediction first, or a new one."""
        places = [points[mask].mean(axis=0, dtype=np.float64) for mask in bodies]
        boxes = [_box(points[mask]) for mask in bodies]
        candidates = []
        for i, (place, box) in enumerate(zip(places, boxes, strict=True)):
            for j, track in enumerate(self._tracks):
                shift = track.velocity * (timestamp - track.last_seen)
                distance = float(np.linalg.norm(track.centroid + shift - place))
                if distance < self.config.max_jump or _overlap(track.box + shift, box):
                    candidates.append((distance, i, j))
        tracks: dict[int, _Track] = {}
        taken: set[int] = set()
        for _, i, j in sorted(candidates):
            if i not in tracks and j not in taken:
                tracks[i] = self._tracks[j]
                taken.add(j)
        for i in range(len(bodies)):
            if i not in tracks:
                tracks[i] = _Track(self._next_id, timestamp, timestamp, places[i], boxes[i])
                self._tracks.append(tracks[i])
                self._next_id += 1
        return [(bodies[i], tracks[i]) for i in range(len(bodies))]

    def _way(self, mask: NDArray[np.bool_], track: _Track, seen: _Seen) -> NDArray[np.float64] | None:
        """Median displacement (3,) of a body's pixels since the last frame, metres; None if too few can be paired."""
        last = self._last
        if last is None or track.last_seen != last.timestamp or last.grey.shape != seen.grey.shape:
            return None
        import cv2

        inner = np.argwhere(cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)))[:, ::-1]
        now = inner[:: max(1, len(inner) // PAIRED_PIXELS)].astype(np.float32)
        if len(now) < FEWEST_PIXELS:
            return None
        parameters = {"winSize": (WINDOW, WINDOW), "maxLevel": 2, "minEigThreshold": 1e-4}
        then, found, _ = cv2.calcOpticalFlowPyrLK(seen.grey, last.grey, now, None, **parameters)
        back, again, _ = cv2.calcOpticalFlowPyrLK(last.grey, seen.grey, then, None, **parameters)
        h, w = mask.shape
        u, v = np.rint(then).astype(np.int64).T
        good = (found[:, 0] > 0) & (again[:, 0] > 0) & (np.abs(back - now).max(axis=1) < 0.5)
        good &= (u >= 0) & (v >= 0) & (u < w) & (v < h)
        good[good] = last.ids[v[good], u[good]] == track.id
        u_now, v_now = now[good].astype(np.int64).T
        way = seen.points[v_now, u_now] - _between(last.points, then[good])
        way = way[np.linalg.norm(way, axis=1) < self.config.max_jump]
        if len(way) < FEWEST_PIXELS:
            return None
        return np.median(way, axis=0).astype(np.float64)

    def _take_step(self, track: _Track, timestamp: float, way: NDArray[np.float64]) -> None:
        track.steps = [step for step in track.steps if timestamp - step[0] < self.config.velocity_window]
        track.steps.append((timestamp, timestamp - track.last_seen, way))
        durations = np.array([step[1] for step in track.steps])
        track.velocity = np.sum([step[2] for step in track.steps], axis=0) / max(float(durations.sum()), 1e-6)


def _box(points: NDArray[np.float32]) -> NDArray[np.float64]:
    """Extent (2, 3) of points (n, 3) without the outermost 1 % on each side, where readings of two surfaces mix."""
    order = np.sort(points, axis=0)
    cut = len(points) // 100
    return np.stack([order[cut], order[-1 - cut]]).astype(np.float64)


def _between(points: NDArray[np.float32], pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Points (n, 3) of an image (h, w, 3) at places (n, 2) between its pixels; bilinear within one surface."""
    h, w = points.shape[:2]
    u0 = np.clip(np.floor(pixels[:, 0]).astype(np.int64), 0, w - 2)
    v0 = np.clip(np.floor(pixels[:, 1]).astype(np.int64), 0, h - 2)
    du, dv = (pixels - np.stack([u0, v0], axis=1)).T[:, :, None]
    corners = points[v0, u0], points[v0, u0 + 1], points[v0 + 1, u0], points[v0 + 1, u0 + 1]
    return (1 - dv) * ((1 - du) * corners[0] + du * corners[1]) + dv * ((1 - du) * corners[2] + du * corners[3])


def _thinned(points: NDArray[np.float32]) -> NDArray[np.float32]:
    return points[:: max(1, len(points) // SAMPLES)]


def _gap(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    """Smallest distance between two sets of points, metres."""
    return float(np.sqrt(np.square(a[:, None] - b[None]).sum(axis=-1).min()))


def _overlap(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """Whether two boxes (2, 3) share a point."""
    return bool(np.all(a[0] <= b[1]) and np.all(b[0] <= a[1]))
