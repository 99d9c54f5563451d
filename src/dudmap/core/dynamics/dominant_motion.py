"""Rigid motion of the static world between two images, and what does not follow it.

Corners are tracked from image to image (Lucas and Kanade 1981) and the rigid motion that most of the visible surface
follows is taken for that of the static world (RANSAC, Fischler and Bolles 1981); corners that do not follow it move.
Errors are measured in pixels: a near person then weighs no more than a far wall.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.consensus import neighbour_votes
from dudmap.core.dynamics.ransac import NOISE_PX, pixels_at_width, reproject, rigid_motion
from dudmap.core.dynamics.segments import Segmentation
from dudmap.core.frames.observation import Level
from dudmap.core.frames.optical_flow import consistent_with_static, track_forward_backward
from dudmap.core.frames.pyramid import Pyramid

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
SAME_SURFACE = 0.02
"""Change of depth, as a share of it, between neighbouring readings of one surface, and by the noise at 5 m."""
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
        intervals: Corners that are off by more than so many times the limit are dropped, and so are those whose depth
            changed by more than such a motion along the line of sight. Between images so many intervals apart, slower
            motion is hidden from image to image; what seems faster was confused with something else, such as the
            surface that a person uncovers, or is known.

    Returns:
        None if too few corners follow one motion.
    """
    fine, fine_after, first, second = before.fine, after.fine, before.grey, after.grey
    camera = fine.camera
    T_expected = np.eye(4) if T_expected is None else T_expected
    points = before.corner_points
    expected = reproject(T_expected, points, camera)
    pixels, targets, difference, found = track_forward_backward(first, second, before.corners, expected)
    points, labelled = points[found], _pixels_of_level(pixels, fine, before.labelled)
    candidate = np.ones(len(points), bool) if moving is None else ~moving[labelled[:, 1], labelled[:, 0]]
    if np.count_nonzero(candidate) < FEWEST:
        return None
    T = rigid_motion(points[candidate], targets[candidate], camera, T_expected)
    predicted = reproject(T, points, camera)
    error = _lengths(predicted - targets)
    threshold = pixels_at_width(NOISE_PX, camera)
    inlier, areas = error < threshold, points[:, 2] ** 2
    if np.count_nonzero(candidate & inlier) < FEWEST:
        return None
    share = float(areas[candidate & inlier].sum() / areas[candidate].sum())
    near = error < MOVES_SIGMAS * threshold
    sigma = weighted_median(error[near], areas[near]) / np.sqrt(2 * np.log(2))
    least = np.maximum(pixels_at_width(MOVES_PX, camera), MOVES_SIGMAS * sigma)
    limit = least + MOVES_SHARE * _lengths(targets - pixels)
    moves = error > limit
    kept = ~moves
    moves &= (error <= intervals * limit) & (_depth_change(T, points, targets, fine_after) <= intervals * limit)
    kept[moves] = ~consistent_with_static(
        first, second, pixels[moves], predicted[moves], limit[moves], difference[moves]
    )
    targets, points, moves = targets[kept], points[kept], moves[kept]
    columns, rows = _nearest_pixels(targets, fine_after).T
    z = fine_after.depth[rows, columns].astype(np.float64)
    seen = z > 0
    points_after = fine_after.camera.points(targets[:, 0], targets[:, 1], z)[seen]
    return DominantMotion(
        T,
        share,
        LabelledCorners(before.labelled, segmentations[0], points, labelled[kept], moves),
        LabelledCorners(
            after.labelled,
            segmentations[1],
            points_after,
            _pixels_of_level(targets[seen], fine_after, after.labelled),
            moves[seen],
        ),
    )


def _depth_change(
    T: NDArray[np.float64], points: NDArray[np.float64], targets: NDArray[np.float64], level: Level
) -> NDArray[np.float64]:
    """Length (n,) of the change of depth of corners, as pixels of a motion across the line of sight at that depth.

    Args:
        T: (4, 4) motion of the static world.
        points: (n, 3) the corners, metres, first camera's frame.
        targets: (n, 2) where they were found in the second image; without a reading there is no change.
        level: The second image.
    """
    u, v = _nearest_pixels(targets, level).T
    found, expected = level.depth[v, u], points @ T[2, :3] + T[2, 3]
    change = np.maximum(np.abs(found - expected) - SAME_SURFACE * expected, 0) / np.maximum(expected, 1e-6)
    return np.where(found > 0, change * level.camera.fx, 0.0)


def weighted_median(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Smallest of the values (n,), n > 0, that together with the smaller ones has half of the weight (n,)."""
    order = values.argsort()
    total = weights[order].cumsum()
    return float(values[order[total.searchsorted(total[-1] / 2)]])


def propagate_to_segments(corners: LabelledCorners, *, whole_only: bool = False) -> NDArray[np.bool_]:
    """Moving pixels (h, w) of an image: the labels of the corners carried over to the segments they lie in.

    A segment moves as a whole if at least AGREED of its corners move. Where its corners disagree, a pixel of it moves
    if at least AGREED of the NEIGHBOURS nearest corners of the same segment do, by distance in space.

    Args:
        corners: The labelled corners.
        whole_only: Leave out the segments whose corners disagree.
    """
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
    queries = level.camera.points(columns, rows, level.depth[rows, columns].astype(np.float64))
    # a segment of three moving and other corners has five and more
    votes = neighbour_votes(queries, labels[rows, columns], corners.points, corners.segment_of, moving, NEIGHBOURS)
    out[rows, columns] = votes >= AGREED * NEIGHBOURS
    return out


def static_segments(corners: LabelledCorners) -> NDArray[np.bool_]:
    """Pixels (h, w) of segments with enough static corners, and a share of more than 1 - AGREED of such corners."""
    num_static, num_all = corners.count_by_segment(~corners.moving), corners.count_by_segment()
    static = (num_static >= FEWEST_MOVING) & (num_static > (1 - AGREED) * num_all)
    static[0] = False
    return static[corners.segmentation.labels]


def _lengths(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lengths (n,) of vectors (n, 2)."""
    squares = vectors * vectors
    return np.sqrt(squares[:, 0] + squares[:, 1])


def _pixels_of_level(pixels: NDArray[np.number], level: Level, other: Level) -> NDArray[np.int64]:
    """Pixels (n, 2) int u, v of another level that show the positions (n, 2) of a level."""
    scale = other.camera.width / level.camera.width
    return _nearest_pixels((pixels + 0.5) * scale - 0.5, other)


def _nearest_pixels(positions: NDArray[np.float64], level: Level) -> NDArray[np.int64]:
    """Pixels (n, 2) int u, v of a level nearest to positions (n, 2)."""
    last = level.camera.width - 1, level.camera.height - 1
    return np.minimum(np.maximum(np.rint(positions), 0), last).astype(np.int64)
