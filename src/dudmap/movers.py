"""What moves, as things: connected bodies with a name that lasts, a place, an extent and a velocity (thesis 7.1).

No classifier: a body is what the labels call moving and what hangs together in space. Nothing here reaches the pose.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dudmap.config import MoversConfig
from dudmap.kernels import labeling
from dudmap.tracker import Level

SAMPLES = 100
"""Points per region that measure the gap to another region."""
MOST_REGIONS = 24
"""Larger regions that are looked at; the rest is noise."""
PAIRED_PIXELS = 100
"""Pixels of a body that are looked for in the last frame."""
FEWEST_PIXELS = 15
"""Pixels with a known motion that make a velocity."""
WINDOW = 9
"""Width of the patch that is looked for, pixels."""
HIDES = 0.1
"""What is nearer than a body's border by more than this hides a part of it, metres."""
CREDIBLE = 0.7
"""A motion that differs from the median of its neighbours by more than this is a change of the mask, m/s."""
SPECK = 12
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
    whole: bool = False
    velocity: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    steps: list[tuple[float, float, NDArray[np.float64]]] = field(default_factory=list)  # time, duration, way


@dataclass(frozen=True, eq=False)
class _Seen:
    """The last frame: where each of its pixels was in the world, and whose it was."""

    timestamp: float
    grey: NDArray[np.uint8]
    points: NDArray[np.float32]
    ids: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class _Part:
    """A connected region: visible surface in m^2, whose it was in the last frame (0 = none), points, their box."""

    area: float
    before: int
    sample: NDArray[np.float32]
    box: NDArray[np.float32]


class MoverTracker:
    """Bodies of a frame, matched to those of the frames before.

    A body's velocity is the mean of its credible motions during the last ``velocity_window`` seconds. The motion from
    one frame to the next is the median displacement in the world of its pixels, paired by optical flow there and back
    (Lucas and Kanade 1981). While the body is wholly in view, the motions of its centroid and of its box's middle are
    asked too and the median of the three counts: the surface of a rolling ball does not move like the ball. A body that
    is cut off by the image's border or by something nearer has no such middle; with too few paired pixels the centroid
    and the box must do all the same.

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
            centroid, box = body.mean(axis=0, dtype=np.float64), _box(body)
            whole = _is_whole(mask, level.depth)
            if track.last_seen < timestamp:
                ways = [centroid - track.centroid, (box - track.box).mean(axis=0)]
                way = self._way(mask, track, seen)
                if way is not None:
                    ways = [way, *ways] if whole and track.whole else [way]
                self._take_step(track, timestamp, np.median(ways, axis=0))
            track.centroid, track.box, track.whole, track.last_seen = centroid, box, whole, timestamp
            age = timestamp - track.first_seen
            movers.append(Mover(track.id, mask, body, centroid, box, track.velocity.copy(), age))
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
        parts = {number: self._part(regions == number, areas[number], points) for number in kept}
        bodies: list[list[int]] = []
        for number in kept:  # the largest first
            near = [body for body in bodies if self._belongs(parts[number], [parts[other] for other in body])]
            near[0].append(number) if near else bodies.append([number])
        masks = [np.isin(regions, body) for body in bodies if areas[body].sum() >= self.config.min_area]
        return masks

    def _part(self, mask: NDArray[np.bool_], area: float, points: NDArray[np.float32]) -> "_Part":
        """What is needed to tell of which body a region (h, w) bool is a part."""
        before = 0
        if self._last is not None and self._last.ids.shape == mask.shape:
            before = int(np.argmax(np.bincount(self._last.ids[mask])))
        sample = points[mask]
        sample = sample[:: max(1, len(sample) // SAMPLES)]
        return _Part(area, before, sample, np.stack([sample.min(axis=0), sample.max(axis=0)]))

    def _belongs(self, region: "_Part", body: list["_Part"]) -> bool:
        """Whether a region is a fragment of a body: close to it, and much smaller or of the same body before."""
        small = region.area < 0.5 * sum(part.area for part in body)
        if not small and not (region.before and any(region.before == part.before for part in body)):
            return False
        return any(_nearer(region, part, self.config.merge_distance) for part in body)

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
        now = inner[:: max(1, len(inner) // PAIRED_PIXELS)].astype(np.float32, order="C")
        if len(now) < FEWEST_PIXELS:
            return None
        then, found = _flow(seen.grey, last.grey, now)
        back, again = _flow(last.grey, seen.grey, then)
        h, w = mask.shape
        u, v = np.rint(then).astype(np.int64).T
        good = found & again & (np.abs(back - now).max(axis=1) < 0.5)
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
        velocities = np.array([step[2] / step[1] for step in track.steps])
        off = np.linalg.norm(velocities - np.median(velocities, axis=0), axis=1)
        track.velocity = velocities[off <= max(CREDIBLE, float(np.median(off)))].mean(axis=0)


def _flow(
    image: NDArray[np.uint8], other: NDArray[np.uint8], pixels: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Places (n, 2) in another image that look like those in this one, and (n,) whether they were found."""
    import cv2

    there = pixels.copy(order="C")
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        image, other, pixels, there, winSize=(WINDOW, WINDOW), maxLevel=2, minEigThreshold=1e-4
    )
    return np.asarray(there, dtype=np.float32), np.asarray(found)[:, 0] > 0


def _box(points: NDArray[np.float32]) -> NDArray[np.float64]:
    """Extent (2, 3) of points (n, 3) without the outermost 1 % on each side, where readings of two surfaces mix."""
    order = np.sort(points, axis=0)
    cut = len(points) // 100
    return np.stack([order[cut], order[-1 - cut]]).astype(np.float64)


def _is_whole(mask: NDArray[np.bool_], depth: NDArray[np.float32]) -> bool:
    """Whether a body is neither cut off by the image's border nor by something nearer than it."""
    import cv2

    if mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any():
        return False
    nearest = cv2.erode(np.where(mask, depth, np.float32(100)), np.ones((5, 5), np.uint8))
    ring = (nearest < 100) & ~mask
    cut = ring & (depth > 0) & (depth < nearest - HIDES)
    return bool(np.count_nonzero(cut) <= 0.1 * np.count_nonzero(ring))


def _between(points: NDArray[np.float32], pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Points (n, 3) of an image (h, w, 3) at places (n, 2) between its pixels; bilinear within one surface."""
    h, w = points.shape[:2]
    u0 = np.clip(np.floor(pixels[:, 0]).astype(np.int64), 0, w - 2)
    v0 = np.clip(np.floor(pixels[:, 1]).astype(np.int64), 0, h - 2)
    du, dv = (pixels - np.stack([u0, v0], axis=1)).T[:, :, None]
    corners = points[v0, u0], points[v0, u0 + 1], points[v0 + 1, u0], points[v0 + 1, u0 + 1]
    return (1 - dv) * ((1 - du) * corners[0] + du * corners[1]) + dv * ((1 - du) * corners[2] + du * corners[3])


def _nearer(a: _Part, b: _Part, distance: float) -> bool:
    """Whether two regions come nearer to each other than a distance, metres."""
    if np.any(a.box[0] - b.box[1] > distance) or np.any(b.box[0] - a.box[1] > distance):
        return False
    p, q = a.sample - a.box[0], b.sample - a.box[0]
    squared = np.einsum("ij,ij->i", p, p)[:, None] + np.einsum("ij,ij->i", q, q) - 2 * p @ q.T
    return float(squared.min()) < distance**2


def _overlap(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """Whether two boxes (2, 3) share a point."""
    return bool(np.all(a[0] <= b[1]) and np.all(b[0] <= a[1]))
