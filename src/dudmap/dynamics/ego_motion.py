"""Motion segmentation from two images, for as long as the map cannot tell static from moving.

A new map knows no free space, and whoever is in view is part of it. Corners are tracked from image to image (Lucas and
Kanade 1981) and the rigid motion that most of the visible surface follows is taken for that of the static world
(RANSAC, Fischler and Bolles 1981); corners that do not follow it move. Errors are measured in pixels: a near person
then weighs no more than a far wall.
"""

from collections import deque
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dudmap.dynamics.ransac import NOISE_PX, pixels_at_width, reproject, rigid_motion
from dudmap.dynamics.segments import Segmentation
from dudmap.frames.observation import Level
from dudmap.frames.optical_flow import consistent_with_static, track_forward_backward
from dudmap.frames.pyramid import Pyramid, is_majority_dynamic
from dudmap.geometry import se3

MOVES_PX = 1.0
"""Smallest reprojection error of a moving corner, pixels of an image 320 wide: 3.5 sigma of a static corner."""
MOVES_SIGMAS = 5.0
"""Smallest reprojection error of a moving corner, in standard deviations (per coordinate) of the static corners."""
MOVES_SHARE = 0.08
"""Added to either limit: this share of the length of the corner's own flow (motion blur, rolling shutter)."""
FEWEST = 15
"""Fewest inliers of a motion that is accepted. A wrong motion gathers about one by chance: of 1000 corners with flow
of up to 20 pixels the share (NOISE_PX / 20)^2."""
NEIGHBOURS = 5
"""Nearest corners that vote on a pixel of a segment whose corners disagree."""
FEWEST_MOVING = 3
"""Fewest moving (static) corners of a moving (static) segment: three points determine a rigid motion."""
AGREED = 0.7
"""Smallest share of moving corners of a segment that moves as a whole, and of the neighbours of a moving pixel."""
SHORTEST_BASELINE, LONGEST_BASELINE = 0.1, 0.4
"""Motion too slow to be seen from one image to the next is measured against an image this much older, seconds. While
the map is young, images are kept at intervals of the shorter one."""
NOISE_SHARE = 0.02
"""Moving readings up to this share of all are taken for noise."""


@dataclass(frozen=True, eq=False)
class LabelledCorners:
    """Corners of an image, each labelled as static or moving.

    Attributes:
        level: The image, at the resolution of the labels.
        segmentation: Its segments.
        points: (n, 3) the corners, metres, camera frame.
        pixels: (n, 2) int, their pixels u, v in ``level``.
        moving: (n,) bool.
    """

    level: Level
    segmentation: Segmentation
    points: NDArray[np.float64]
    pixels: NDArray[np.int64]
    moving: NDArray[np.bool_]

    def count_by_segment(self, chosen: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
        """Corners (count + 1,) in each segment, all or the chosen (n,) of them; entry 0: in none."""
        segment = self.segment_of if chosen is None else self.segment_of[chosen]
        return np.bincount(segment, minlength=self.segmentation.count + 1)

    @cached_property
    def segment_of(self) -> NDArray[np.int32]:
        """Segment (n,) that each corner lies in."""
        return self.segmentation.labels[self.pixels[:, 1], self.pixels[:, 0]]


@dataclass(frozen=True, eq=False)
class DominantMotion:
    """Rigid motion of most of the visible surface between two images, and what does not follow it.

    Attributes:
        T_after_before: (4, 4) motion of the static world from the first camera's frame to the second's.
        share: Share of the surface not known to move, as sampled by the corners, that follows it.
        before, after: The corners in the first and in the second image; moving are those that do not follow it.
    """

    T_after_before: NDArray[np.float64]
    share: float
    before: LabelledCorners
    after: LabelledCorners

    @cached_property
    def moving_before(self) -> NDArray[np.bool_]:
        """Moving pixels (h, w) of the first image."""
        return propagate_to_segments(self.before)

    @cached_property
    def moving_after(self) -> NDArray[np.bool_]:
        """Moving pixels (h, w) of the second image."""
        return propagate_to_segments(self.after)

    @cached_property
    def static_after(self) -> NDArray[np.bool_]:
        """Pixels (h, w) of the second image in segments seen to be static; segments without corners are neither."""
        return static_segments(self.after)


@dataclass(eq=False)
class OlderImage:
    """A tracked image that later ones are compared with.

    Attributes:
        timestamp: Seconds.
        T_world_camera: (4, 4).
        pyramid: Its images.
        segmentation: Its segments, at the resolution of the labels.
        moving: (h, w) bool, its pixels that are known to move; None for none.
    """

    timestamp: float
    T_world_camera: NDArray[np.float64]
    pyramid: Pyramid
    segmentation: Segmentation
    moving: NDArray[np.bool_] | None = None

    def motion_to(
        self, pyramid: Pyramid, segmentation: Segmentation, T_world_camera: NDArray[np.float64], intervals: float
    ) -> DominantMotion | None:
        """Motion of the static world to a later image, and what moves too slowly to be seen from image to image.

        What is seen to move in this image is left out of the estimates of the next comparisons.

        Args:
            pyramid: The later image.
            segmentation: Its segments.
            T_world_camera: (4, 4) prediction of its pose.
            intervals: Number of intervals between consecutive images that lie between the two.

        Returns:
            None if it cannot be determined.
        """
        T_expected = se3.inverse(T_world_camera) @ self.T_world_camera
        segmentations = self.segmentation, segmentation
        motion = dominant_motion(self.pyramid, pyramid, segmentations, self.moving, T_expected, intervals)
        if motion is not None:
            moving = propagate_to_segments(motion.before, whole_only=True)
            self.moving = moving if self.moving is None else self.moving | moving
        return motion


@dataclass(frozen=True, eq=False)
class SlowMotion:
    """What an image and an older one tell.

    Attributes:
        T_world_camera: (4, 4) pose of the new image, from that of the older one.
        moving: (h, w) bool, pixels of the new image in segments that moved as a whole in between.
        moving_first: (h, w) bool, the same of the older image if that is the first one of the map; else None.
    """

    T_world_camera: NDArray[np.float64]
    moving: NDArray[np.bool_]
    moving_first: NDArray[np.bool_] | None


class EgoMotionSegmenter:
    """Segments moving objects by comparing images, while the map is young or most of the view moves.

    Args:
        seconds: Duration of the comparison from the first frame of a map on; extended, up to twice that, while moving
            objects are found. 0 turns the comparison off for good.

    Attributes:
        active: Whether the next frame is to be compared with the last one.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.active = False
        self._young_until, self._latest_end = -np.inf, -np.inf
        self._started = self._last_timestamp = -np.inf
        self._last: tuple[Pyramid, Segmentation, NDArray[np.bool_] | None] | None = None
        self._older: deque[OlderImage] = deque()
        self._compared: tuple[float, DominantMotion | None] | None = None  # time and result of the last comparison

    def start(self, timestamp: float) -> None:
        """Begin with the first frame of a map."""
        self._young_until, self._latest_end = timestamp + self.seconds, timestamp + 2 * self.seconds
        self._started = timestamp
        self._older.clear()

    @property
    def started(self) -> bool:
        """Whether ``start`` was called."""
        return bool(np.isfinite(self._started))

    def map_is_young(self, timestamp: float) -> bool:
        """Whether the map cannot tell static from moving yet."""
        return timestamp < self._young_until

    def slow_motion_is_hidden(self, timestamp: float) -> bool:
        """Whether the map is younger than the longest baseline over which slow motion is looked for."""
        return timestamp < self._started + min(LONGEST_BASELINE, self.seconds)

    def update(
        self,
        timestamp: float,
        T_world_camera: NDArray[np.float64],
        pyramid: Pyramid,
        segmentation: Segmentation,
        moving: NDArray[np.bool_] | None = None,
    ) -> None:
        """Take over a tracked frame as the one that the next is compared with.

        Args:
            timestamp: Seconds.
            T_world_camera: (4, 4) its pose.
            pyramid: Its images.
            segmentation: Its segments, at the resolution of the labels.
            moving: (h, w) bool, its moving pixels, if known.
        """
        self._last, self._last_timestamp, self._compared = (pyramid, segmentation, moving), timestamp, None
        young = self.map_is_young(timestamp)
        hidden = moving is not None and is_majority_dynamic(moving, pyramid.labelled)
        self.active = young or (hidden and self.seconds > 0 and self.started)
        if not young:
            self._older.clear()
        elif not self._older or timestamp - self._older[-1].timestamp >= SHORTEST_BASELINE:
            self._older.append(OlderImage(timestamp, T_world_camera, pyramid, segmentation, moving))

    def reset(self) -> None:
        """Drop the last frame: nothing is compared before the next ``update``."""
        self._last, self._compared, self.active = None, None, False

    def compare(
        self,
        timestamp: float,
        pyramid: Pyramid,
        segmentation: Segmentation,
        T_expected: NDArray[np.float64] | None = None,
    ) -> DominantMotion | None:
        """Motion of the static world since the last frame; None if it cannot be determined.

        The result is kept: a second call with the same timestamp returns the same object.

        Args:
            timestamp: Seconds, of the new frame.
            pyramid: Its images.
            segmentation: Its segments, at the resolution of the labels.
            T_expected: (4, 4) predicted motion of the static world; None: none.
        """
        if self._last is None:
            return None
        if self._compared is None or self._compared[0] != timestamp:
            last, segmentation_last, moving = self._last
            motion = dominant_motion(last, pyramid, (segmentation_last, segmentation), moving, T_expected)
            self._compared = timestamp, motion
            if (
                motion is not None
                and self.map_is_young(timestamp)
                and exceeds_noise_share(motion.moving_after, pyramid.labelled)
            ):
                self._young_until = min(timestamp + self.seconds, self._latest_end)
        return self._compared[1]

    def slow_motion(
        self, timestamp: float, T_world_camera: NDArray[np.float64], pyramid: Pyramid, segmentation: Segmentation
    ) -> SlowMotion | None:
        """Comparison with an older image; None once the map is not young, or where they follow no common motion.

        Where that shows something to move, the newest of the older images is compared, too: what came into view since
        the oldest one was taken moves in neither comparison otherwise.

        Args:
            timestamp: Seconds, of the new frame.
            T_world_camera: (4, 4) prediction of its pose.
            pyramid: Its images.
            segmentation: Its segments, at the resolution of the labels.
        """
        while self._older and timestamp - self._older[0].timestamp > LONGEST_BASELINE:
            self._older.popleft()
        older = [image for image in self._older if timestamp - image.timestamp >= SHORTEST_BASELINE]
        if not older or not self.map_is_young(timestamp):
            return None
        oldest, newest = older[0], older[-1]
        interval = timestamp - self._last_timestamp
        ages = [(timestamp - image.timestamp) / interval for image in (oldest, newest)]
        motion = oldest.motion_to(pyramid, segmentation, T_world_camera, ages[0])
        if motion is None:
            return None
        T_world_camera = oldest.T_world_camera @ se3.inverse(motion.T_after_before)
        moving = propagate_to_segments(motion.after, whole_only=True)
        first = oldest.moving if oldest.timestamp == self._started else None
        if newest is not oldest and exceeds_noise_share(moving, pyramid.labelled):
            motion = newest.motion_to(pyramid, segmentation, T_world_camera, ages[1])
            if motion is not None:
                moving = moving | propagate_to_segments(motion.after, whole_only=True)
        return SlowMotion(T_world_camera, moving, first)


def exceeds_noise_share(moving: NDArray[np.bool_], level: Level) -> bool:
    """Whether the moving pixels (h, w) are a larger share of the readings of an image than noise produces."""
    return bool(np.count_nonzero(moving) > NOISE_SHARE * np.count_nonzero(level.depth))


def dominant_motion(
    before: Pyramid,
    after: Pyramid,
    segmentations: tuple[Segmentation, Segmentation],
    moving: NDArray[np.bool_] | None = None,
    T_expected: NDArray[np.float64] | None = None,
    intervals: float = np.inf,
) -> DominantMotion | None:
    """Motion of the static world between two images, and the corners that do not follow it.

    The static world is the largest *surface* that moves rigidly: each corner counts by its depth squared, since a crowd
    may fill half of the image, but hardly ever half of the visible square metres. A corner is moving if its
    reprojection error e exceeds

        max(MOVES_PX, MOVES_SIGMAS sigma) + MOVES_SHARE |flow|,   sigma = median{e : e < MOVES_SIGMAS t} / sqrt(2 ln 2)

    with the inlier threshold t of the estimate, and the image does not match at its static position as well; it is
    dropped if it does. (The length of a vector of two normally distributed coordinates has the median sqrt(2 ln 2)
    sigma.) The median is by surface: corners on slow people may be more than half of all, and near enough to count.

    Args:
        before, after: Both images; corners are tracked in the finest levels.
        segmentations: Segments of both, at the resolution of the labels.
        moving: (h, w) bool at that resolution, pixels of the first image known to move; corners on them are left out of
            the estimate of the motion.
        T_expected: (4, 4) predicted motion: the search for the corners starts there, and it is the prior of the
            estimate. None: the identity.
        intervals: Corners that are off by more than so many times the limit are dropped. Between images so many
            intervals apart, slower motion is hidden from image to image; what seems faster was confused with something
            else, or is known.

    Returns:
        None if too few corners follow one motion.
    """
    fine, fine_after, first, second = before.fine, after.fine, before.grey, after.grey
    camera = fine.camera
    T_expected = np.eye(4) if T_expected is None else T_expected
    expected = reproject(T_expected, _points(fine, before.corners), camera)
    pixels, targets, difference = track_forward_backward(first, second, before.corners, expected)
    points = _points(fine, pixels)
    candidate = np.ones(len(points), dtype=bool)
    if moving is not None:
        columns, rows = _pixels_of_level(pixels, fine, before.labelled).T
        candidate = ~moving[rows, columns]
    if np.count_nonzero(candidate) < FEWEST:
        return None
    T = rigid_motion(points[candidate], targets[candidate], camera, T_expected)
    predicted = reproject(T, points, camera)
    error = np.linalg.norm(predicted - targets, axis=1)
    threshold = pixels_at_width(NOISE_PX, camera)
    inlier, areas = error < threshold, points[:, 2] ** 2
    if np.count_nonzero(candidate & inlier) < FEWEST:
        return None
    share = float(areas[candidate & inlier].sum() / areas[candidate].sum())
    near = error < MOVES_SIGMAS * threshold
    sigma = weighted_median(error[near], areas[near]) / np.sqrt(2 * np.log(2))
    least = np.maximum(pixels_at_width(MOVES_PX, camera), MOVES_SIGMAS * sigma)
    limit = least + MOVES_SHARE * np.linalg.norm(targets - pixels, axis=1)
    moves = error > limit
    kept = ~moves
    moves &= error <= intervals * limit
    kept[moves] = ~consistent_with_static(
        first, second, pixels[moves], predicted[moves], limit[moves], difference[moves]
    )
    pixels, targets, points, moves = pixels[kept], targets[kept], points[kept], moves[kept]
    columns, rows = np.clip(np.rint(targets), 0, np.array(fine_after.depth.shape[::-1]) - 1).astype(np.int64).T
    z = fine_after.depth[rows, columns].astype(np.float64)
    seen = z > 0
    points_after = fine_after.camera.points(targets[:, 0], targets[:, 1], z)[seen]
    return DominantMotion(
        T,
        share,
        LabelledCorners(
            before.labelled, segmentations[0], points, _pixels_of_level(pixels, fine, before.labelled), moves
        ),
        LabelledCorners(
            after.labelled,
            segmentations[1],
            points_after,
            _pixels_of_level(targets[seen], fine_after, after.labelled),
            moves[seen],
        ),
    )


def weighted_median(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Smallest of the values (n,), n > 0, that together with the smaller ones has half of the weight (n,)."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])


def propagate_to_segments(corners: LabelledCorners, *, whole_only: bool = False) -> NDArray[np.bool_]:
    """Moving pixels (h, w) of an image: the labels of the corners carried over to the segments they lie in.

    A segment moves as a whole if at least AGREED of its corners move. Where its corners disagree, a pixel of it moves
    if at least AGREED of the NEIGHBOURS nearest corners of the same segment do, by distance in space.

    Args:
        corners: The labelled corners.
        whole_only: Leave out the segments whose corners disagree.
    """
    from scipy.spatial import KDTree

    level, labels, moving = corners.level, corners.segmentation.labels, corners.moving
    if np.count_nonzero(moving) < FEWEST_MOVING:
        return np.zeros(level.depth.shape, dtype=bool)
    num_moving, num_all = corners.count_by_segment(moving), corners.count_by_segment()
    enough = num_moving >= FEWEST_MOVING
    whole = enough & (num_moving >= AGREED * num_all)
    mixed = enough & ~whole
    whole[0] = mixed[0] = False
    out = whole[labels]
    if whole_only:
        return out
    rows, columns = np.nonzero(mixed[labels] & (level.depth > 0))
    if len(rows) == 0:
        return out
    z = level.depth[rows, columns].astype(np.float64)
    # the segment is a fourth coordinate, so that corners of other segments are far away
    known = np.column_stack([corners.points, 1e3 * corners.segment_of])
    queries = np.column_stack([level.camera.points(columns, rows, z), 1e3 * labels[rows, columns]])
    _, nearest = KDTree(known).query(queries, k=NEIGHBOURS)  # a segment of 3 moving and other corners has 5 and more
    out[rows, columns] = moving[nearest].mean(axis=1) >= AGREED
    return out


def static_segments(corners: LabelledCorners) -> NDArray[np.bool_]:
    """Pixels (h, w) of segments with enough static corners, and a share of more than 1 - AGREED of such corners."""
    num_static, num_all = corners.count_by_segment(~corners.moving), corners.count_by_segment()
    static = (num_static >= FEWEST_MOVING) & (num_static > (1 - AGREED) * num_all)
    static[0] = False
    return static[corners.segmentation.labels]


def _points(level: Level, pixels: NDArray[np.int64]) -> NDArray[np.float64]:
    """Points (n, 3) at pixels (n, 2) u, v of an image, metres, camera frame."""
    u, v = pixels.T
    return level.camera.points(u, v, level.depth[v, u].astype(np.float64))


def _pixels_of_level(pixels: NDArray[np.number], level: Level, other: Level) -> NDArray[np.int64]:
    """Pixels (n, 2) int u, v of another level that show the positions (n, 2) of a level."""
    scale = other.camera.width / level.camera.width
    last = np.array(other.depth.shape[::-1]) - 1
    return np.clip(np.rint((pixels + 0.5) * scale - 0.5), 0, last).astype(np.int64)
