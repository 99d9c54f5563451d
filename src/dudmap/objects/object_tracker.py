"""What moves, as things: connected bodies with a name that lasts, a place, an extent and a velocity (thesis 7.1).

No classifier: a body is what the labels call moving and what hangs together in space. Nothing here reaches the pose.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dudmap.config import MoversConfig
from dudmap.frames.observation import Level
from dudmap.geometry import se3
from dudmap.geometry.camera import Camera
from dudmap.kernels import labeling
from dudmap.kernels.median import median
from dudmap.objects.scene_flow import Seen, displacements

SAMPLES = 60
"""Points per region that measure the gap to another region."""
MOST_REGIONS = 24
"""Larger regions that are looked at; the rest is noise."""
HIDES = 0.1
"""What is nearer than a body's border by more than this hides a part of it, metres."""
CREDIBLE = 0.7
"""A motion that differs from the median of its neighbours by more than this is a change of the mask, m/s."""
SPECK = 12
"""Regions of fewer pixels are noise."""
SEPARATE = 0.5
"""Bodies that were two for this long stay two when they touch, seconds."""


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


@dataclass(frozen=True)
class _Step:
    """A body's way (3,) since the last frame by its pixels, if known, its places now, and whether it is all in view."""

    time: float
    duration: float
    way: NDArray[np.float64] | None
    middles: NDArray[np.float64]  # (2, 3) centroid and middle of the box
    whole: bool


@dataclass(eq=False)
class _Track:
    """What is remembered of a body."""

    id: int
    first_seen: float
    last_seen: float
    centroid: NDArray[np.float64]
    box: NDArray[np.float64]
    area: float = 0.0
    velocity: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    steps: list[_Step] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class _Pixels:
    """The moving pixels of a frame that lie in regions worth a look, region after region."""

    flat: NDArray[np.int64]  # (n,) index into the image
    points: NDArray[np.float32]  # (n, 3) world
    area: NDArray[np.float32]  # (n,) m^2
    before: NDArray[np.int32]  # (n,) id the pixel is expected to have, 0 = none
    ranges: list[tuple[int, int]]  # of each region, the largest first


@dataclass(frozen=True, eq=False)
class _Part:
    """A connected region: visible surface in m^2, whose it was in the last frame (0 = none), points, their box."""

    area: float
    before: int
    sample: NDArray[np.float32]
    box: NDArray[np.float32]


class ObjectTracker:
    """Bodies of a frame, matched to those of the frames before.

    The moving pixels of the last frame, carried along by their bodies' velocities, tell whose a region is. Where two
    bodies that were apart touch, the region is shared out between them by the nearest carried pixel.

    A body's velocity is that of the last ``velocity_window`` seconds. While it is wholly in view, it is the slope of a
    line through the places of its middle: the surface of a rolling ball does not move like the ball. A body that is cut
    off by the image's border or by something nearer has no middle; there it is the mean of its credible motions from
    frame to frame, each the median displacement in the world of its pixels, paired by optical flow there and back
    (Lucas and Kanade 1981).

    Args:
        config: Sizes and times.
    """

    def __init__(self, config: MoversConfig) -> None:
        self.config = config
        self._tracks: list[_Track] = []
        self._last: Seen | None = None
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
        pixels = self._pixels(timestamp, dynamic, level, T_world_camera)
        bodies = [] if pixels is None else self._bodies(pixels, dynamic.shape)
        if pixels is None or not bodies:
            self._last = None
            return []
        ids = np.zeros(dynamic.shape, dtype=np.int32)
        points = np.zeros((*dynamic.shape, 3), dtype=np.float32)
        points.reshape(-1, 3)[pixels.flat] = pixels.points
        boxes = [_box(pixels.points[body]) for body in bodies]
        centroids = [pixels.points[body].mean(axis=0, dtype=np.float64) for body in bodies]
        tracks = self._matched(timestamp, bodies, centroids, boxes, pixels.before)
        for body, track in zip(bodies, tracks, strict=True):
            ids.reshape(-1)[pixels.flat[body]] = track.id
        seen = Seen(timestamp, np.clip(255 * level.intensity, 0, 255).astype(np.uint8), ids, points)
        ways: dict[int, NDArray[np.float64]] = {}
        if self._last is not None and self._last.ids.shape == ids.shape:
            known = [track.id for track in self._tracks if track.last_seen == self._last.timestamp]
            ways = displacements(self._last, seen, known, self.config.max_jump)
        movers = []
        for body, track, centroid, box in zip(bodies, tracks, centroids, boxes, strict=True):
            mask = ids == track.id
            step = _Step(
                timestamp, timestamp - track.last_seen, ways.get(track.id), np.stack([centroid, box.mean(axis=0)]),
                _is_whole(mask, level.depth),
            )  # fmt: skip
            self._take_step(track, step)
            track.centroid, track.box, track.last_seen = centroid, box, timestamp
            track.area = float(pixels.area[body].sum())
            age = timestamp - track.first_seen
            movers.append(Mover(track.id, mask, points[mask], centroid, box, track.velocity.copy(), age))
        self._last = seen
        return sorted(movers, key=lambda mover: mover.id)

    def _pixels(
        self, timestamp: float, dynamic: NDArray[np.bool_], level: Level, T_world_camera: NDArray[np.float64]
    ) -> _Pixels | None:
        """The moving pixels by connected region, None if there is no region of some size."""
        moving = dynamic & (level.depth > 0)
        tolerance = np.float32(0.02) + np.float32(0.02) * level.depth
        regions, count = labeling.grow_regions(moving, moving, level.depth, tolerance)
        number = regions.reshape(-1)
        sizes = np.bincount(number, minlength=count + 1)
        sizes[0] = 0
        area = np.square(level.depth.reshape(-1)) / np.float32(level.camera.fx * level.camera.fy)
        areas = np.bincount(number, area, minlength=count + 1)
        areas[sizes < SPECK] = 0
        kept = np.argsort(-areas, kind="stable")[:MOST_REGIONS]
        kept = kept[areas[kept] > 0]
        if len(kept) == 0:
            return None
        rank = np.full(count + 1, len(kept), dtype=np.int64)
        rank[kept] = np.arange(len(kept))
        flat = np.flatnonzero(moving)
        flat = flat[np.argsort(rank[number[flat]], kind="stable")][: sizes[kept].sum()]
        stops = np.cumsum(sizes[kept])
        ranges = [(int(stop - size), int(stop)) for stop, size in zip(stops, sizes[kept], strict=True)]
        camera, z = level.camera, level.depth.reshape(-1)[flat]
        v, u = np.divmod(flat, moving.shape[1])
        T = T_world_camera.astype(np.float32)
        points = camera.points(u, v, z) @ T[:3, :3].T + T[:3, 3]
        before = self._carried(timestamp, camera, T_world_camera)[v // 2, u // 2]
        return _Pixels(flat, np.asarray(points, np.float32), np.asarray(area[flat], np.float32), before, ranges)

    def _carried(self, timestamp: float, camera: Camera, T_world_camera: NDArray[np.float64]) -> NDArray[np.int32]:
        """Whose each 2x2 pixels are if all bodies went on as they did: (h + 1) // 2 by (w + 1) // 2, 0 = nobody's."""
        h, w = (camera.height + 1) // 2, (camera.width + 1) // 2
        out = np.zeros((h, w), dtype=np.int32)
        last = self._last
        if last is None or last.ids.shape != camera.shape:
            return out
        number = last.ids[::2, ::2]
        own = number > 0
        number = number[own]
        shift = np.zeros((self._next_id, 3), dtype=np.float32)
        for track in self._tracks:
            shift[track.id] = track.velocity * (timestamp - last.timestamp)
        T = se3.inverse(T_world_camera).astype(np.float32)
        x, y, z = ((last.points[::2, ::2][own] + shift[number]) @ T[:3, :3].T + T[:3, 3]).T
        order = np.argsort(-z)
        order = order[: np.count_nonzero(z > 0)]  # the nearest is written last
        x, y, z, number = x[order], y[order], z[order], number[order]
        u = ((x / z * camera.fx + camera.cx + 0.5) / 2).astype(np.int64)
        v = ((y / z * camera.fy + camera.cy + 0.5) / 2).astype(np.int64)
        inside = (u >= 0) & (v >= 0) & (u < w) & (v < h)
        out[v[inside], u[inside]] = number[inside]
        return out

    def _bodies(self, pixels: _Pixels, shape: tuple[int, ...]) -> list[NDArray[np.int64]]:
        """Pixels of each body: regions connected in depth, shared out where two touch, small ones joined."""
        parts: list[tuple[_Part, NDArray[np.int64]]] = []
        for start, stop in pixels.ranges:
            for body in self._shared_out(np.arange(start, stop), pixels, shape):
                parts.append((_part(pixels, body), body))
        parts.sort(key=lambda item: -item[0].area)
        groups: list[list[tuple[_Part, NDArray[np.int64]]]] = []
        for item in parts:  # the largest first
            own = [group for group in groups if item[0].before and group[0][0].before == item[0].before]
            near = [g for g in own + groups if self._belongs(item[0], [part for part, _ in g])]
            near[0].append(item) if near else groups.append([item])
        return [
            np.concatenate([body for _, body in group])
            for group in groups
            if sum(part.area for part, _ in group) >= self.config.min_area
        ]

    def _shared_out(
        self, region: NDArray[np.int64], pixels: _Pixels, shape: tuple[int, ...]
    ) -> list[NDArray[np.int64]]:
        """A region cut between the bodies that were apart before and touch in it."""
        before = pixels.before[region]
        counts = np.bincount(before)
        known = [
            track.id
            for track in self._tracks
            if track.id < len(counts)
            and counts[track.id] >= SPECK
            and self._is_body(track, float(pixels.area[region[before == track.id]].sum()))
        ]
        if len(known) < 2:
            return [region]
        import cv2

        seeds = np.ones(shape, dtype=np.uint8)
        sure = np.isin(before, known)
        seeds.reshape(-1)[pixels.flat[region[sure]]] = 0
        _, nearest = cv2.distanceTransformWithLabels(seeds, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
        nearest = np.asarray(nearest, dtype=np.int64).reshape(-1)
        owner = np.zeros(int(nearest.max()) + 1, dtype=np.int32)
        owner[nearest[pixels.flat[region[sure]]]] = before[sure]
        own = owner[nearest[pixels.flat[region]]]
        return [region[own == number] for number in known]

    def _belongs(self, region: _Part, body: list[_Part]) -> bool:
        """Whether a region is a fragment of a body: close to it, and of the same body before or much smaller."""
        if region.before == 0 or region.before != body[0].before:
            other = next((track for track in self._tracks if track.id == region.before), None)
            if region.area >= 0.5 * sum(part.area for part in body) or (other and self._is_body(other, region.area)):
                return False
        return any(_nearer(region, part, self.config.merge_distance) for part in body)

    def _is_body(self, track: _Track, area: float) -> bool:
        """Whether a surface in m^2 is enough of a body that has been seen for some time to stand for it."""
        known = track.last_seen - track.first_seen >= SEPARATE and track.area >= 2 * self.config.min_area
        return known and area >= 0.3 * track.area

    def _matched(
        self,
        timestamp: float,
        bodies: list[NDArray[np.int64]],
        centroids: list[NDArray[np.float64]],
        boxes: list[NDArray[np.float64]],
        before: NDArray[np.int32],
    ) -> list[_Track]:
        """The track of each body: old ones by the nearest prediction and shared pixels first, or a new one."""
        candidates = []
        for i, (body, place, box) in enumerate(zip(bodies, centroids, boxes, strict=True)):
            counts = np.bincount(before[body], minlength=self._next_id)
            for j, track in enumerate(self._tracks):
                shift = track.velocity * (timestamp - track.last_seen)
                distance = float(np.linalg.norm(track.centroid + shift - place))
                shared = counts[track.id] / len(body)
                if shared > 0.3 or distance < self.config.max_jump or _overlap(track.box + shift, box):
                    candidates.append((distance - self.config.max_jump * shared, i, j))
        tracks: dict[int, _Track] = {}
        taken: set[int] = set()
        for _, i, j in sorted(candidates):
            if i not in tracks and j not in taken:
                tracks[i] = self._tracks[j]
                taken.add(j)
        for i in range(len(bodies)):
            if i not in tracks:
                tracks[i] = _Track(self._next_id, timestamp, timestamp, centroids[i], boxes[i])
                self._tracks.append(tracks[i])
                self._next_id += 1
        return [tracks[i] for i in range(len(bodies))]

    def _take_step(self, track: _Track, step: _Step) -> None:
        """Velocity from the steps of the last while."""
        track.steps = [s for s in track.steps if step.time - s.time < self.config.velocity_window] + [step]
        estimates = []
        velocities = np.array([s.way / s.duration for s in track.steps if s.way is not None and s.duration > 0])
        if len(velocities):
            off = np.linalg.norm(velocities - median(velocities), axis=1)
            estimates.append(velocities[off <= max(CREDIBLE, float(np.median(off)))].mean(axis=0))
        whole = [s for s in track.steps if s.whole] if velocities.size else track.steps
        if len(whole) >= 2 and (step.whole or not velocities.size):
            times = np.array([s.time for s in whole])
            times = times - times.mean()
            middles = np.stack([s.middles for s in whole])
            slopes = np.einsum("t,tij->ij", times, middles) / np.sum(times**2)
            estimates += list(slopes)
        if estimates:
            track.velocity = median(np.array(estimates))


def _part(pixels: _Pixels, body: NDArray[np.int64]) -> _Part:
    """What is needed to tell of which body some pixels are a part."""
    before = int(np.argmax(np.bincount(pixels.before[body])))
    sample = pixels.points[body[:: max(1, len(body) // SAMPLES)]]
    return _Part(float(pixels.area[body].sum()), before, sample, np.stack([sample.min(axis=0), sample.max(axis=0)]))


def _box(points: NDArray[np.float32]) -> NDArray[np.float64]:
    """Extent (2, 3) of points (n, 3) without the outermost 1 % on each side, where readings of two surfaces mix."""
    cut = len(points) // 100
    order = np.partition(points, (cut, len(points) - 1 - cut), axis=0)
    return np.stack([order[cut], order[-1 - cut]]).astype(np.float64)


def _is_whole(mask: NDArray[np.bool_], depth: NDArray[np.float32]) -> bool:
    """Whether a body is neither cut off by the image's border nor by something nearer than it."""
    import cv2

    if mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any():
        return False
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    crop = np.s_[max(rows[0] - 2, 0) : rows[-1] + 3, max(columns[0] - 2, 0) : columns[-1] + 3]
    mask, depth = mask[crop], depth[crop]
    nearest = cv2.erode(np.where(mask, depth, np.float32(100)), np.ones((5, 5), np.uint8))
    ring = (nearest < 100) & ~mask
    cut = ring & (depth > 0) & (depth < nearest - HIDES - np.float32(0.03) * depth)
    return bool(np.count_nonzero(cut) <= 0.1 * np.count_nonzero(ring))


def _nearer(a: _Part, b: _Part, distance: float) -> bool:
    """Whether two regions come nearer to each other than a distance, metres."""
    if max((a.box[0] - b.box[1]).max(), (b.box[0] - a.box[1]).max()) > distance:
        return False
    p, q = a.sample - a.box[0], b.sample - a.box[0]
    squared = np.einsum("ij,ij->i", p, p)[:, None] + np.einsum("ij,ij->i", q, q) - 2 * p @ q.T
    return float(squared.min()) < distance**2


def _overlap(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """Whether two boxes (2, 3) share a point."""
    return bool(np.all(a[0] <= b[1]) and np.all(b[0] <= a[1]))
