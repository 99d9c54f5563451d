"""What moves between two images, while the map cannot tell yet.

In the first second nothing is known of free space, and whoever is in view is part of the map. Corners are followed
from image to image (Lucas and Kanade 1981) and explained by one rigid motion (RANSAC, Fischler and Bolles 1981): what
does not follow the motion of most of the visible surface moves. Errors are counted in pixels, so that a near person
counts no more than a far wall.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dudmap.dynamics.ransac import NOISE_PX, reproject, rigid_motion
from dudmap.dynamics.segments import Segmentation
from dudmap.frames.observation import Level
from dudmap.frames.optical_flow import consistent_with_static, track_forward_backward
from dudmap.frames.pyramid import Pyramid
from dudmap.geometry import se3

MOVES_PX = 1.0
"""A corner farther off than this,"""
MOVES_SIGMAS = 5.0
"""and than this many standard deviations (per coordinate) of the corners that follow the motion,"""
MOVES_SHARE = 0.08
"""and by this share of its own path besides (motion blur, rolling shutter), moves."""
FAR_PX = 3.0
"""Corners farther off than this weights nothing of that deviation."""
RAYLEIGH = 1.1774
"""Median length of a vector of two normally distributed coordinates of deviation 1."""
FEWEST = 15
"""With fewer corners no motion is believed."""
LEAST_SHARE = 0.3
"""Nor with a smaller share of the surface that follows it."""
REACH = 0.1
"""A pixel is judged by the corners within this share of its depth, in space."""
NEIGHBOURS = 5
FEWEST_MOVING = 3
"""Corners of a piece that must move for any of it to."""
AGREED = 0.7
"""A piece moves as a whole if at least this share of its corners does."""
COVERED = 0.5
"""Share of the readings that must move for frames to be compared however old the map is: behind a crowd it learns
nothing of free space."""
MOVED_SAY = 0.1
"""What a corner on something known to move counts, against one that is not."""
APART, LONGEST = 0.1, 0.4
"""What is too slow to be seen from one image to the next is seen over this time and more, seconds, and at most that:
the images of a young map are kept at these intervals."""
SEVERAL = 0.02
"""Share of the readings that must move for it to be more than noise."""


@dataclass(frozen=True, eq=False)
class DominantMotion:
    """The rigid motion of most of the visible surface between two images, and what does not follow it.

    Attributes:
        T_after_before: (4, 4) the static world's motion from the first camera's frame to the second's.
        moving_after: (h, w) bool, pixels of the second image with a reading that do not follow it.
        resting_after: (h, w) bool, pieces of surface that do, by their corners; what has no corners is neither.
        share: Share of the corners, each counted by the surface it stands for, that follow it.
        look_back: Finds ``moving_before``, which few ask for.
    """

    T_after_before: NDArray[np.float64]
    moving_after: NDArray[np.bool_]
    resting_after: NDArray[np.bool_]
    share: float
    look_back: Callable[[], NDArray[np.bool_]]

    @cached_property
    def moving_before(self) -> NDArray[np.bool_]:
        """(h, w) pixels of the first image with a reading that do not follow it."""
        return self.look_back()


class EgoMotionSegmenter:
    """Finds movers from image to image while the map is too young to know them, or most of the view is hidden.

    Args:
        seconds: Least time from the first frame on; prolonged, up to twice as long, while movers are found. 0 turns it
            off, later too.

    Attributes:
        active: Whether the next frame is to be compared with the remembered one in any case.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._until, self._longest = -np.inf, -np.inf
        self._before: tuple[Pyramid, Segmentation, NDArray[np.bool_] | None] | None = None
        self._older: deque[tuple[float, NDArray[np.float64], Pyramid, Segmentation]] = deque()
        self._compared: tuple[float, DominantMotion | None] | None = None  # time of the last comparison, and its result
        self.active = False

    def start(self, timestamp: float) -> None:
        """Begin with the first frame of a map."""
        self._until, self._longest = timestamp + self.seconds, timestamp + 2 * self.seconds

    @property
    def started(self) -> bool:
        """Whether there is a map."""
        return bool(np.isfinite(self._longest))

    def young(self, timestamp: float) -> bool:
        """Whether the map cannot know yet what moves."""
        return timestamp < self._until

    def wanted(self, timestamp: float, small: Level, moving: NDArray[np.bool_] | None) -> bool:
        """Whether a tracked frame, in which this (h, w) moves, is to be compared with the next."""
        covered = moving is not None and np.count_nonzero(moving) > COVERED * np.count_nonzero(small.depth)
        return bool(self.young(timestamp) or (covered and self.seconds > 0 and self.started))

    def remember(
        self,
        timestamp: float,
        T_world_camera: NDArray[np.float64],
        pyramid: Pyramid,
        surface: Segmentation,
        moving: NDArray[np.bool_] | None = None,
    ) -> None:
        """Take a tracked frame, and what moves in it (h, w) bool if known, as the one to compare the next with."""
        self._before, self._compared = (pyramid, surface, moving), None
        self.active = self.wanted(timestamp, pyramid.labelled, moving)
        if not self.young(timestamp):
            self._older.clear()
        elif not self._older or timestamp - self._older[-1][0] >= APART:
            self._older.append((timestamp, T_world_camera, pyramid, surface))

    def forget(self) -> None:
        """Compare no more until a frame is remembered again: the last one showed nothing."""
        self._before, self._compared, self.active = None, None, False

    def compare(
        self, timestamp: float, pyramid: Pyramid, surface: Segmentation, T_expected: NDArray[np.float64] | None = None
    ) -> DominantMotion | None:
        """The static world's motion since the remembered frame, and what does not follow it; None if unknown.

        Asked once more for the same time, it answers without looking again.
        """
        if self._before is None:
            return None
        if self._compared is None or self._compared[0] != timestamp:
            before, surface_before, moved = self._before
            motion = dominant_motion(before, pyramid, (surface_before, surface), moved, T_expected)
            self._compared = timestamp, motion
            if (
                motion is not None
                and self.young(timestamp)
                and exceeds_noise_share(motion.moving_after, pyramid.labelled)
            ):
                self._until = min(timestamp + self.seconds, self._longest)
        return self._compared[1]

    def slow(
        self, timestamp: float, T_world_camera: NDArray[np.float64], pyramid: Pyramid, surface: Segmentation
    ) -> NDArray[np.bool_]:
        """What has moved (h, w) since a somewhat older frame, as far as is known, while the map is young.

        Args:
            timestamp: Seconds, of the new frame.
            T_world_camera: (4, 4) first guess of its pose.
            pyramid: The image.
            surface: Its pieces.
        """
        while self._older and timestamp - self._older[0][0] > LONGEST:
            self._older.popleft()
        if not self._older or timestamp - self._older[0][0] < APART or not self.young(timestamp):
            return np.zeros(pyramid.labelled.depth.shape, dtype=bool)
        _, T_world_before, before, surface_before = self._older[0]
        T_expected = se3.inverse(T_world_camera) @ T_world_before
        motion = dominant_motion(before, pyramid, (surface_before, surface), T_expected=T_expected, whole=True)
        return np.zeros(pyramid.labelled.depth.shape, dtype=bool) if motion is None else motion.moving_after


def exceeds_noise_share(moving: NDArray[np.bool_], level: Level) -> bool:
    """Whether so many readings of an image move (h, w) that it is more than noise."""
    return bool(np.count_nonzero(moving) > SEVERAL * np.count_nonzero(level.depth))


def dominant_motion(
    before: Pyramid,
    after: Pyramid,
    surfaces: tuple[Segmentation, Segmentation],
    moved: NDArray[np.bool_] | None = None,
    T_expected: NDArray[np.float64] | None = None,
    whole: bool = False,
) -> DominantMotion | None:
    """Explain the corners' paths from one image to the next by one rigid motion; None where too few are left.

    The static world is what covers most *surface*, so that each corner counts by its depth squared: a crowd may fill
    half of the image, but hardly ever half of the visible square metres.

    Args:
        before, after: Both images; corners are followed in the finest levels.
        surfaces: Segmentation of surface of both, at the size of the labels.
        moved: (h, w) bool at that size, what is known to move in the first image; it has little weights in what the
            static world is.
        T_expected: (4, 4) what the motion should be: where corners are looked for first, and what decides between
            two motions that explain much. None: no motion.
        whole: Only pieces most of whose corners move.
    """
    fine, fine_after, first, second = before.fine, after.fine, before.grey, after.grey
    T_expected = np.eye(4) if T_expected is None else T_expected
    expected = reproject(T_expected, _points(fine, before.corners), fine.camera)
    pixels, targets, unlike = track_forward_backward(first, second, before.corners, expected)
    if len(pixels) < FEWEST:
        return None
    points = _points(fine, pixels)
    z, (columns, rows) = points[:, 2], pixels.T
    weights, rests = np.ones(len(z)), np.ones(len(z), dtype=bool)
    if moved is not None:
        factor = fine.depth.shape[1] // moved.shape[1]
        rests = ~moved[rows // factor, columns // factor]
        weights[~rests] = MOVED_SAY
    T, surface = rigid_motion(points, targets, weights, fine.camera, T_expected), weights * z**2
    error = np.linalg.norm(reproject(T, points, fine.camera) - targets, axis=1)
    if np.count_nonzero(rests & (error < NOISE_PX)) < FEWEST:
        return None
    share = float(surface[error < NOISE_PX].sum() / surface.sum())
    if share < LEAST_SHARE:
        return None
    path = np.linalg.norm(targets - pixels, axis=1)
    sigma = np.median(error[error < FAR_PX]) / RAYLEIGH
    allowed = np.maximum(MOVES_PX, MOVES_SIGMAS * sigma) + MOVES_SHARE * path
    moves = error > allowed
    certain = ~moves
    certain[moves] = ~consistent_with_static(
        first, second, pixels[moves], reproject(T, points[moves], fine.camera), allowed[moves], unlike[moves]
    )
    pixels, targets, points, moves = pixels[certain], targets[certain], points[certain], moves[certain]
    depth_after = fine_after.depth[
        _inside(targets[:, 1], fine_after.depth.shape[0]), _inside(targets[:, 0], fine_after.depth.shape[1])
    ]
    seen = depth_after > 0
    points_after = fine_after.camera.points(targets[:, 0], targets[:, 1], depth_after.astype(np.float64))
    scale = before.labelled.camera.width / fine.camera.width
    limit = np.array(before.labelled.depth.shape[::-1]) - 1
    places = [np.clip(np.rint((p + 0.5) * scale - 0.5), 0, limit).astype(np.int64) for p in (pixels, targets[seen])]
    return DominantMotion(
        T,
        _spread(after.labelled, surfaces[1], points_after[seen], places[1], moves[seen], whole),
        _rest(surfaces[1], places[1], moves[seen]),
        share,
        lambda: _spread(before.labelled, surfaces[0], points, places[0], moves, whole),
    )


def _spread(
    level: Level,
    surface: Segmentation,
    points: NDArray[np.float64],
    pixels: NDArray[np.int64],
    moves: NDArray[np.bool_],
    only_whole: bool = False,
) -> NDArray[np.bool_]:
    """Moving pixels (h, w): those of pieces of surface whose corners move.

    Where corners of one piece disagree, a pixel goes with most of its neighbours in space among the piece's corners.

    Args:
        level: The image.
        surface: Its pieces.
        points: (n, 3) the corners in space, metres.
        pixels: (n, 2) int, their pixels u, v.
        moves: (n,).
        only_whole: Leave the pieces whose corners disagree.
    """
    from scipy.spatial import KDTree

    if np.count_nonzero(moves) < FEWEST_MOVING:
        return np.zeros(level.depth.shape, dtype=bool)
    piece = surface.labels[pixels[:, 1], pixels[:, 0]]
    moving = np.bincount(piece[moves], minlength=surface.count + 1)
    total = np.bincount(piece, minlength=surface.count + 1)
    solid = moving >= FEWEST_MOVING
    whole = solid & (moving >= AGREED * total)
    mixed = solid & ~whole & (moving >= 0.1 * total)
    whole[0] = mixed[0] = False
    out = whole[surface.labels]
    if only_whole:
        return out
    rows, columns = np.nonzero(mixed[surface.labels] & (level.depth > 0))
    if len(rows) == 0:
        return out
    z = level.depth[rows, columns].astype(np.float64)
    apart = 1e3 * piece  # corners of other pieces are far away
    corners = np.column_stack([points, apart])
    places = np.column_stack([level.camera.points(columns, rows, z), 1e3 * surface.labels[rows, columns]])
    distance, index = KDTree(corners).query(places, k=min(NEIGHBOURS, len(points)))
    near = distance < REACH * z[:, None]
    votes = np.where(near, np.append(np.where(moves, 1, -1), 0)[np.minimum(index, len(moves))], 0).sum(axis=1)
    out[rows, columns] = votes >= 2
    return out


def _rest(surface: Segmentation, pixels: NDArray[np.int64], moves: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels (h, w) of pieces that hold enough corners at rest, and not too many others; arguments as above."""
    piece = surface.labels[pixels[:, 1], pixels[:, 0]]
    resting = np.bincount(piece[~moves], minlength=surface.count + 1)
    total = np.bincount(piece, minlength=surface.count + 1)
    rest = (resting >= FEWEST_MOVING) & (resting > (1 - AGREED) * total)
    rest[0] = False
    return rest[surface.labels]


def _points(level: Level, pixels: NDArray[np.int64]) -> NDArray[np.float64]:
    """Points (n, 3) in the camera's frame, metres, at pixels (n, 2) u, v of an image."""
    u, v = pixels.T
    return level.camera.points(u, v, level.depth[v, u].astype(np.float64))


def _inside(coordinate: NDArray[np.float64], size: int) -> NDArray[np.int64]:
    return np.clip(np.rint(coordinate), 0, size - 1).astype(np.int64)
