"""Rigid motion of the static world between two images, and what does not follow it.

Corners are tracked from image to image (Lucas and Kanade 1981) and the rigid motion that most of the visible surface
follows is taken for that of the static world (RANSAC, Fischler and Bolles 1981); corners that do not follow it move.
Errors are measured in pixels: a near person then weighs no more than a far wall.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu import consensus
from dudmap.core.backends.cpu.consensus import ConsensusParams, neighbour_votes
from dudmap.core.dynamics.segments import Segmentation
from dudmap.core.frames.observation import FLOW_WIDTH, WINDOW, Level, Pyramid, scaled_window
from dudmap.core.frames.optical_flow import (
    RETURN_PX,
    consistent_with_static,
    equally_exposed,
    lengths,
    track_forward_backward,
)
from dudmap.core.geometry.camera import Camera

NOISE_PX = 0.7
"""Inlier threshold t of the reprojection error, pixels: t^2 = 5.99 sigma^2 holds 95 % of the errors (chi-square, two
degrees of freedom) of corners measured with sigma = 0.29 px per coordinate."""
NOISE_LEVELS = 1.0, 0.5, 0.25
"""Noise of the corners that is considered, as multiples of the largest one, the sigma of NOISE_PX: in sharp images
corners of a right motion are measured with 0.07 px per coordinate."""
LEAST_SIGMA_PX = NOISE_LEVELS[-1] * NOISE_PX / np.sqrt(5.99)
"""Smallest sigma of the inliers that is believed, pixels per coordinate."""
OUTLIER_GAIN = 2.996
"""Log-likelihood ratio of a corner without error to an outlier at the largest noise level, 5.99 / 2: a corner is an
inlier up to the error at which both are equally likely."""
NEAR_PX = 5.0
"""Scale of the prior on the distance of a motion from the expected one, pixels: a turn by 1.1 degrees at a focal length
of 262 pixels, by which a prediction at constant velocity errs where a turn of 33 degrees/s begins within 1/30 s."""
HYPOTHESES = 150
"""Hypotheses from uniform samples, and as many from samples weighted by area. With a share of inliers of 1/3, samples
of three miss all of the inliers with probability (1 - 1/27)^150 = 0.3 %."""


def rigid_motion(
    points: NDArray[np.float64],
    targets: NDArray[np.float64],
    camera: Camera,
    T_expected: NDArray[np.float64],
    near_px: float = NEAR_PX,
) -> NDArray[np.float64]:
    """Motion T_after_before (4, 4) with the highest score among hypotheses from samples of three correspondences.

    Three correspondences determine the twist of a small motion linearly (Longuet-Higgins and Prazdny 1980). The score
    of a motion is that of MSAC (Torr and Zisserman 2000), each correspondence weighted by its depth squared, to
    which the surface that it stands for is proportional, times a prior:

        score(T, sigma) = gain sum_n z_n^2 (1 - min(e_n^2 / (2 gain sigma^2), 1)) * (0.5 + 0.5 / (1 + (d / NEAR_PX)^2))
        gain = log(A / (2 pi sigma^2))

    where e_n is the reprojection error and d the mean distance, in pixels, of the reprojected points from where the
    expected motion puts them. The sum is the log-likelihood of normally distributed errors against that of outliers
    spread over an area A. The noise sigma is unknown like the motion, and the pair of the highest score is searched: at
    a noise fixed too large, a motion between that of the static world and that of slow people explains both.

    The prior decides between two motions that explain nearly as much surface: a crowd that
    walks abreast may cover more of it than the static world, and two images alone cannot tell which of the two moves.
    The prior ranges from 1 to 1/2 only, because the expected motion is a prediction and may be wrong.

    The REFINED best hypotheses of each noise level and the expected motion are refined on their inliers with the exact
    projection, and the one of the highest score is returned.

    Args:
        points: (n, 3) metres, first camera's frame.
        targets: (n, 2) their pixels in the second image.
        camera: Camera of both images.
        T_expected: (4, 4) predicted motion.
        near_px: Scale of the prior, pixels; infinite for none.
    """
    areas, n = points[:, 2] ** 2, len(points)
    rng, draws = np.random.default_rng(0), np.empty((2 * HYPOTHESES, 3), np.int64)
    draws[:HYPOTHESES] = rng.integers(0, n, (HYPOTHESES, 3))
    shares = (areas / areas.sum()).cumsum()
    draws[HYPOTHESES:] = (shares / shares[-1]).searchsorted(rng.random((HYPOTHESES, 3)), side="right")
    expected = reproject(T_expected, points, camera)
    found = consensus.Correspondences(
        points.T.copy(), targets.T.copy(), expected.T.copy(), areas, camera.intrinsics
    )  # fmt: skip
    return consensus.best_motion(draws, found, _params(camera, near_px), T_expected)


def pixels_at_width(distance: float, camera: Camera) -> float:
    """Distance in pixels of an image, given that in an image of FLOW_WIDTH with the same view."""
    return distance * camera.width / FLOW_WIDTH


@lru_cache(maxsize=8)
def _params(camera: Camera, near_px: float = NEAR_PX) -> ConsensusParams:
    levels = np.array(NOISE_LEVELS)
    gain = OUTLIER_GAIN - 2 * np.log(levels)  # the density of errors without noise grows with 1 / sigma^2
    limits = pixels_at_width(NOISE_PX, camera) * levels * np.sqrt(gain / OUTLIER_GAIN)
    return ConsensusParams(tuple(limits), tuple(gain), pixels_at_width(near_px, camera))


def reproject(T: NDArray[np.float64], points: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Pixels (n, 2) of points (n, 3) after a motion T (4, 4); points behind the camera land far outside the image."""
    moved = points @ T[:3, :3].T + T[:3, 3]
    return camera.focal * moved[:, :2] / np.maximum(moved[:, 2:], 1e-6) + camera.centre


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
    """Corners of an image, each labelled as static, as moving, or as neither where that is unclear.

    Attributes:
        level: The image, at the resolution of the labels.
        segmentation: Its segments.
        points: (n, 3) the corners, metres, camera frame.
        pixels: (n, 2) int, their pixels u, v in ``level``.
        moving, static: (n,) bool.
    """

    level: Level
    segmentation: Segmentation
    points: NDArray[np.float64]
    pixels: NDArray[np.int64]
    moving: NDArray[np.bool_]
    static: NDArray[np.bool_]

    def count_by_segment(self, which: NDArray[np.bool_] | slice = slice(None)) -> NDArray[np.int64]:
        """Corners (count + 1,) in each segment, of those that are given (n,); entry 0: in none."""
        return np.bincount(self.segment_of[which], minlength=self.segmentation.count + 1)

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
    return bool(np.count_nonzero(moving) > NOISE_SHARE * level.num_readings)


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
    dropped if it does. It is unclear up to MOVES_SIGMAS standard deviations that the covariance of the motion gives its
    pixel, if it was not known to move: a few corners on the far side of a room do not tell where the floor before the
    camera ought to be. (The length of a vector of two normally distributed coordinates has the median sqrt(2 ln 2)
    sigma.) The median is by surface: corners on slow people may be more than half of all, and near enough to count.

    Args:
        before, after: Both images; corners are tracked in the finest levels.
        segmentations: Segments of both, at the resolution of the labels.
        moving: (h, w) bool at that resolution, pixels of the first image known to move; corners on them are left out of
            the estimate of the motion.
        T_expected: (4, 4) predicted motion: the search for the corners starts there, and between consecutive images it
            is the prior of the estimate. None: the identity.
        intervals: Corners that are off by more than so many times the limit are dropped, and so are those whose depth
            changed by more than such a motion along the line of sight. Between images so many intervals apart, slower
            motion is hidden from image to image; what seems faster was confused with something else, such as the
            surface that a person uncovers, or is known.

    Returns:
        None if too few corners follow one motion.
    """
    fine, fine_after = before.fine, after.fine
    first, second = equally_exposed(before, after)
    camera = fine.camera
    T_expected = np.eye(4) if T_expected is None else T_expected
    points = before.corner_points
    expected = reproject(T_expected, points, camera)
    window, limit = scaled_window(WINDOW, camera.width), pixels_at_width(RETURN_PX, camera)
    found_at, differences, found = track_forward_backward(first, second, before.corners, expected, window, 3, limit)
    targets, difference = (values[found].astype(np.float64) for values in (found_at, differences))
    pixels = before.corners[found]
    points, labelled = points[found], _pixels_of_level(pixels, fine, before.labelled)
    candidate = np.ones(len(points), bool) if moving is None else ~moving[labelled[:, 1], labelled[:, 0]]
    if np.count_nonzero(candidate) < FEWEST:
        return None
    near_px = NEAR_PX if np.isinf(intervals) else np.inf  # a pose that followed a crowd expects it to rest
    T = rigid_motion(points[candidate], targets[candidate], camera, T_expected, near_px)
    predicted = reproject(T, points, camera)
    error = lengths(predicted - targets)
    threshold = pixels_at_width(NOISE_PX, camera)
    inlier, areas = error < threshold, points[:, 2] ** 2
    fitted = candidate & inlier
    if np.count_nonzero(fitted) < FEWEST:
        return None
    share = float(areas[fitted].sum() / areas[candidate].sum())
    near = error < MOVES_SIGMAS * threshold
    sigma = weighted_median(error[near], areas[near]) / np.sqrt(2 * np.log(2))
    least = np.maximum(pixels_at_width(MOVES_PX, camera), MOVES_SIGMAS * sigma)
    limit = least + MOVES_SHARE * lengths(targets - pixels)
    rests = error <= limit
    new = ~rests & candidate
    unclear = np.zeros(len(points), bool)
    unclear[new] = error[new] <= MOVES_SIGMAS * _deviations(T, points[new], points[fitted], error[fitted], camera)
    too_fast = (error > intervals * limit) | (_depth_change(T, points, targets, fine_after) > intervals * limit)
    kept, moves = rests | ~too_fast, ~rests & ~too_fast
    kept[moves] = ~consistent_with_static(
        first, second, pixels[moves], predicted[moves], limit[moves], difference[moves]
    )
    moves &= ~unclear
    targets, points, moves, rests = targets[kept], points[kept], moves[kept], rests[kept]
    columns, rows = _nearest_pixels(targets, fine_after).T
    z = fine_after.depth[rows, columns].astype(np.float64)
    seen = z > 0
    points_after = fine_after.camera.points(targets[:, 0], targets[:, 1], z)[seen]
    return DominantMotion(
        T,
        share,
        LabelledCorners(before.labelled, segmentations[0], points, labelled[kept], moves, rests),
        LabelledCorners(
            after.labelled,
            segmentations[1],
            points_after,
            _pixels_of_level(targets[seen], fine_after, after.labelled),
            moves[seen],
            rests[seen],
        ),
    )


def _deviations(
    T: NDArray[np.float64],
    points: NDArray[np.float64],
    inliers: NDArray[np.float64],
    error: NDArray[np.float64],
    camera: Camera,
) -> NDArray[np.float64]:
    """Standard deviations (n,) per coordinate of the pixels that a fitted motion gives points.

    They follow from its covariance by the normal equations of the inliers, sigma^2 (sum J^T J)^-1, where J (2, 6) is
    the derivative of a pixel by the twist of the motion: sigma_n^2 = sigma^2 tr(J_n (sum J^T J)^-1 J_n^T) / 2.

    Args:
        T: (4, 4).
        points: (n, 3) metres, before the motion.
        inliers: (m, 3) the points that it was fitted to.
        error: (m,) their reprojection errors, pixels.
        camera: Camera of the pixels.
    """
    if len(points) == 0:
        return np.empty(0)
    rows = _pixel_jacobian(T, inliers, camera).reshape(-1, 6)
    covariance = np.linalg.pinv(rows.T @ rows, hermitian=True)
    sigma = weighted_median(error, inliers[:, 2] ** 2) / np.sqrt(2 * np.log(2))
    sigma = max(sigma, pixels_at_width(LEAST_SIGMA_PX, camera))
    J = _pixel_jacobian(T, points, camera)
    return sigma * np.sqrt(np.einsum("nij,nij->n", J @ covariance, J) / 2)


def _pixel_jacobian(T: NDArray[np.float64], points: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Derivatives (n, 2, 6) of the pixels of points (n, 3) after a motion T (4, 4) by a twist of it."""
    x, y, z = (points @ T[:3, :3].T + T[:3, 3]).T
    x, y, by_z, none = x / z, y / z, 1 / z, np.zeros_like(z)
    u = np.stack([by_z, none, -x * by_z, -x * y, 1 + x * x, -y], axis=1)
    v = np.stack([none, by_z, -y * by_z, -1 - y * y, x * y, x], axis=1)
    return camera.focal[:, None] * np.stack([u, v], axis=1)


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
    num_static, num_all = corners.count_by_segment(corners.static), corners.count_by_segment()
    static = (num_static >= FEWEST_MOVING) & (num_static > (1 - AGREED) * num_all)
    static[0] = False
    return static[corners.segmentation.labels]


def _pixels_of_level(
    pixels: "NDArray[np.int64] | NDArray[np.float64]", level: Level, other: Level
) -> NDArray[np.int64]:
    """Pixels (n, 2) int u, v of another level that show the positions (n, 2) of a level."""
    scale = other.camera.width / level.camera.width
    return _nearest_pixels((pixels + 0.5) * scale - 0.5, other)


def _nearest_pixels(positions: "NDArray[np.floating]", level: Level) -> NDArray[np.int64]:
    """Pixels (n, 2) int u, v of a level nearest to positions (n, 2)."""
    last = level.camera.width - 1, level.camera.height - 1
    return np.minimum(np.maximum(np.rint(positions), 0), last).astype(np.int64)
