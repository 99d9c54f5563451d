"""Rigid motion of the static world between two images, and the corners that do not follow it.

Corners are tracked between images (Lucas and Kanade 1981); RANSAC (Fischler and Bolles 1981) finds the rigid motion of
most of the visible surface. Errors are measured in pixels, so that a near person weighs no more than a far wall.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu import consensus
from dudmap.core.backends.cpu.consensus import ConsensusParams
from dudmap.core.dynamics.segments import Segmentation
from dudmap.core.frames.observation import FLOW_WIDTH, WINDOW, Level, Pyramid, is_majority_dynamic, scaled_window
from dudmap.core.frames.optical_flow import (
    RETURN_PX,
    consistent_with_static,
    equally_exposed,
    lengths,
    track_forward_backward,
)
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera

NOISE_PX = 0.7
"""Inlier threshold t of the reprojection error, pixels: t^2 = 5.99 sigma^2 (95 %, chi-square, two degrees of freedom)
with sigma = 0.29 px per coordinate."""
NOISE_LEVELS = 1.0, 0.5, 0.25
"""Tested noise levels, multiples of sigma: corners of sharp images have 0.07 px."""
LEAST_SIGMA_PX = NOISE_LEVELS[-1] * NOISE_PX / np.sqrt(5.99)
"""Smallest sigma of the inliers, pixels per coordinate."""
OUTLIER_GAIN = 2.996
"""Log-likelihood ratio of an error-free corner to an outlier, 5.99 / 2: both are equally likely at the inlier
threshold."""
NEAR_PX = 5.0
"""Scale of the prior on the distance from the expected motion, pixels: 1.1 degrees at a focal length of 262 pixels, the
prediction error if a rotation of 33 degrees/s begins within 1/30 s."""
HYPOTHESES = 150
"""Hypotheses from uniform samples, and from samples weighted by area. At an inlier share of 1/3, all fail with
probability (1 - 1/27)^150 = 0.3 %."""


def rigid_motion(
    points: NDArray[np.float64],
    targets: NDArray[np.float64],
    camera: Camera,
    T_expected: NDArray[np.float64],
    near_px: float = NEAR_PX,
) -> NDArray[np.float64]:
    """Motion T_after_before (4, 4) with the highest score among hypotheses from samples of three correspondences.

    Three correspondences determine a small twist linearly (Longuet-Higgins and Prazdny 1980). The score is MSAC's (Torr
    and Zisserman 2000), weighted by squared depth (surface per correspondence), times a prior:

        score(T, sigma) = gain sum_n z_n^2 (1 - min(e_n^2 / (2 gain sigma^2), 1)) * (0.5 + 0.5 / (1 + (d / NEAR_PX)^2))
        gain = log(A / (2 pi sigma^2))

    e_n is the reprojection error, and d the mean distance in pixels between points reprojected by this and by the
    expected motion. The sum is the log-likelihood of normal errors against outliers over an area A. The noise sigma is
    maximised with the motion, because a too large one lets a motion between static world and slow people explain both.

    The prior decides between motions of nearly equal surface, such as static world and abreast crowd. It ranges from 1
    to 1/2 only, because the expected motion may be wrong. The REFINED best hypotheses of each noise level and the
    expected motion are refined on their inliers with the exact projection.

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
    """Pixels of an image, from pixels in an image of FLOW_WIDTH with the same view."""
    return distance * camera.width / FLOW_WIDTH


@lru_cache(maxsize=8)
def _params(camera: Camera, near_px: float = NEAR_PX) -> ConsensusParams:
    levels = np.array(NOISE_LEVELS)
    gain = OUTLIER_GAIN - 2 * np.log(levels)  # the density of error-free corners grows with 1 / sigma^2
    limits = pixels_at_width(NOISE_PX, camera) * levels * np.sqrt(gain / OUTLIER_GAIN)
    return ConsensusParams(tuple(limits), tuple(gain), pixels_at_width(near_px, camera))


def reproject(T: NDArray[np.float64], points: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Pixels (n, 2) of points (n, 3) after a motion T (4, 4); points behind the camera land far outside."""
    moved = points @ T[:3, :3].T + T[:3, 3]
    return camera.focal * moved[:, :2] / np.maximum(moved[:, 2:], 1e-6) + camera.centre


MOVES_PX = 1.0
"""Smallest error of a moving corner, pixels of an image 320 wide: 3.5 sigma."""
MOVES_SIGMAS = 5.0
"""Smallest error of a moving corner, standard deviations (per coordinate) of static corners."""
MOVES_SHARE = 0.08
"""Share of a corner's flow added to either limit (motion blur, rolling shutter)."""
FEWEST = 15
"""Fewest inliers of a motion. A wrong one has about one by chance: of 1000 corners with flow up to 20 pixels, the share
(NOISE_PX / 20)^2."""
MANY = 4 * FEWEST
"""Corners that leave no doubt about a motion that most follow."""
FEWEST_MOVING = 3
"""Fewest moving (static) corners of a moving (static) segment: three determine a rigid motion."""
AGREED = 0.7
"""Smallest share of moving corners in a moving segment, and of surface that clearly follows one motion."""
CLEARLY = 3.0
"""Smallest difference of two medians of errors, in standard errors. The ratio of the medians of two sets of n corners
each has the standard error 1.02 / sqrt(n)."""
NOISE_SHARE = 0.02
"""Largest share of moving measurements that is noise."""


@dataclass(frozen=True, eq=False)
class LabelledCorners:
    """Corners of an image: static, moving, or unclear.

    Attributes:
        level: The image, label resolution.
        segmentation: Its segments.
        points: (n, 3) metres, camera frame.
        pixels: (n, 2) int u, v in ``level``.
        moving, static: (n,) bool.
    """

    level: Level
    segmentation: Segmentation
    points: NDArray[np.float64]
    pixels: NDArray[np.int64]
    moving: NDArray[np.bool_]
    static: NDArray[np.bool_]

    def count_by_segment(self, which: NDArray[np.bool_] | slice = slice(None)) -> NDArray[np.int64]:
        """Selected corners (n,) in each segment (count + 1,); entry 0: in none."""
        return np.bincount(self.segment_of[which], minlength=self.segmentation.count + 1)

    @cached_property
    def segment_of(self) -> NDArray[np.int32]:
        """Segment (n,) of each corner."""
        return self.segmentation.labels[self.pixels[:, 1], self.pixels[:, 0]]


@dataclass(frozen=True, eq=False)
class DominantMotion:
    """Rigid motion of most of the visible surface between two images, and the labelled corners.

    Attributes:
        T_after_before: (4, 4), from the first camera's frame to the second's.
        covariance: (6, 6) of its twist: m, rad; axes of the second camera.
        share: Share of the surface that follows it.
        before, after: Corners of the first and the second image.
    """

    T_after_before: NDArray[np.float64]
    covariance: NDArray[np.float64]
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
        """Pixels (h, w) of the second image in segments with static corners."""
        return static_segments(self.after)


def exceeds_noise_share(moving: NDArray[np.bool_], level: Level) -> bool:
    """Whether moving pixels (h, w) exceed the share that noise produces."""
    return bool(np.count_nonzero(moving) > NOISE_SHARE * level.num_readings)


def dominant_motion(
    before: Pyramid,
    after: Pyramid,
    segmentations: tuple[Segmentation, Segmentation],
    moving: NDArray[np.bool_] | None = None,
    T_expected: NDArray[np.float64] | None = None,
    *,
    consecutive: bool = True,
    conservative: bool = False,
) -> DominantMotion | None:
    """Motion of the static world between two images, and the corners that do not follow it.

    The static world is the largest *surface* that moves rigidly. Corners count by squared depth, because a crowd may
    fill half of the image, but hardly half of the visible square metres. A corner is moving if its reprojection error e
    exceeds

        max(MOVES_PX, MOVES_SIGMAS sigma) + MOVES_SHARE |flow|,   sigma = median{e : e < MOVES_SIGMAS t} / sqrt(2 ln 2)

    with the inlier threshold t. (The length of a vector of two normal coordinates has the median sqrt(2 ln 2) sigma.)
    The median is weighted by surface.

    Exceptions:

    * The image matches as well at the corner's static position: the corner is dropped.
    * The error is within MOVES_SIGMAS standard deviations by the covariance of the motion, and the corner was not known
      to move: the corner is unclear.

    Args:
        before, after: Both images; corners are tracked in the finest levels.
        segmentations: Segments of both, label resolution.
        moving: (h, w) bool, known moving pixels of the first image, excluded from the estimate.
        T_expected: (4, 4) predicted motion, start of the corner search. None: the identity.
        consecutive: Whether the expected motion is a prior; over longer times a pose may have followed a crowd.
        conservative: If not consecutive, the expected motion is the result unless another fits its static corners
            clearly more tightly (``_tightest``).

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
    near_px = NEAR_PX if consecutive else np.inf
    T = rigid_motion(points[candidate], targets[candidate], camera, T_expected, near_px)
    predicted, flow, areas = reproject(T, points, camera), lengths(targets - pixels), points[:, 2] ** 2
    if conservative and not consecutive:
        limit = pixels_at_width(MOVES_PX, camera) + MOVES_SHARE * flow[candidate]
        T = _tightest(T, T_expected, points[candidate], targets[candidate], limit, camera)
        predicted = reproject(T, points, camera)
    error = lengths(predicted - targets)
    threshold = pixels_at_width(NOISE_PX, camera)
    inlier = error < threshold
    fitted = candidate & inlier
    if np.count_nonzero(fitted) < FEWEST:
        return None
    share = float(areas[fitted].sum() / areas[candidate].sum())
    near = error < MOVES_SIGMAS * threshold
    sigma = weighted_median(error[near], areas[near]) / np.sqrt(2 * np.log(2))
    least = np.maximum(pixels_at_width(MOVES_PX, camera), MOVES_SIGMAS * sigma)
    limit = least + MOVES_SHARE * flow
    rests = error <= limit
    new = ~rests & candidate
    unclear = np.zeros(len(points), bool)
    covariance = _covariance(T, points[fitted], error[fitted], camera)
    unclear[new] = error[new] <= MOVES_SIGMAS * _deviations(T, points[new], covariance, camera)
    kept, moves = np.ones(len(points), bool), ~rests
    kept[moves] = ~consistent_with_static(
        first, second, pixels[moves], predicted[moves], limit[moves], difference[moves]
    )
    moves &= ~unclear
    mostly = moving is not None and is_majority_dynamic(moving, before.labelled)
    if not consecutive or (mostly and np.count_nonzero(rests & ~candidate) > 0.5 * np.count_nonzero(~candidate)):
        moves, rests = moves | ~candidate, rests & candidate  # known motion is too slow for this pair of images
    targets, points, moves, rests = targets[kept], points[kept], moves[kept], rests[kept]
    columns, rows = _nearest_pixels(targets, fine_after).T
    z = fine_after.depth[rows, columns].astype(np.float64)
    seen = z > 0
    points_after = fine_after.camera.points(targets[:, 0], targets[:, 1], z)[seen]
    return DominantMotion(
        T,
        covariance,
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


def _tightest(
    T: NDArray[np.float64],
    T_expected: NDArray[np.float64],
    points: NDArray[np.float64],
    targets: NDArray[np.float64],
    limit: NDArray[np.float64],
    camera: Camera,
) -> NDArray[np.float64]:
    """Motion (4, 4) that its static corners fit best: the expected one, the same refined, or T; the earlier one if no
    later one is clearly better.

    The static world is rigid, and a pose that followed people fits them loosely. The corners (n,) within the limits
    (n,) px of a motion are compared by their median error.
    """

    def clearly_tighter(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
        (num, misfit), (_, other) = (_misfit(lengths(reproject(M, points, camera) - targets), limit) for M in (a, b))
        return num > CLEARLY**2 and misfit <= (1 - CLEARLY / np.sqrt(num)) * other

    T_refined = _refined(T_expected, points, targets, limit, camera)
    T_found = T if clearly_tighter(T, T_refined) else T_refined
    return T_found if clearly_tighter(T_found, T_expected) else T_expected


def _misfit(error: NDArray[np.float64], limit: NDArray[np.float64]) -> tuple[int, float]:
    """Number and median of the errors (n,), px, within their limits (n,)."""
    rests = error <= limit
    return int(np.count_nonzero(rests)), float(np.median(error[rests])) if rests.any() else np.inf


def _refined(
    T: NDArray[np.float64],
    points: NDArray[np.float64],
    targets: NDArray[np.float64],
    limit: NDArray[np.float64],
    camera: Camera,
) -> NDArray[np.float64]:
    """Motion of the corners that rest with T, by reweighted least squares."""
    for _ in range(5):
        residual = targets - reproject(T, points, camera)
        error = lengths(residual)
        rests = error <= limit
        if np.count_nonzero(rests) < FEWEST:
            return T
        weights = np.repeat(1 / (1 + (error[rests] / pixels_at_width(NOISE_PX / 2, camera)) ** 2), 2)
        J = _pixel_jacobian(T, points[rests], camera).reshape(-1, 6)
        step = np.linalg.lstsq(J.T @ (J * weights[:, None]), J.T @ (weights * residual[rests].reshape(-1)), rcond=None)
        T = se3.exp(np.asarray(step[0], np.float64)) @ T
    return T


def _covariance(
    T: NDArray[np.float64], inliers: NDArray[np.float64], error: NDArray[np.float64], camera: Camera
) -> NDArray[np.float64]:
    """sigma^2 (sum J^T J)^-1 of the twist of a motion T, with J (2, 6) the derivative of an inlier's pixel."""
    rows = _pixel_jacobian(T, inliers, camera).reshape(-1, 6)
    sigma = weighted_median(error, inliers[:, 2] ** 2) / np.sqrt(2 * np.log(2))
    sigma = max(sigma, pixels_at_width(LEAST_SIGMA_PX, camera))
    return sigma * sigma * np.linalg.pinv(rows.T @ rows, hermitian=True)


def _deviations(
    T: NDArray[np.float64], points: NDArray[np.float64], covariance: NDArray[np.float64], camera: Camera
) -> NDArray[np.float64]:
    """Standard deviations (n,) px per coordinate of moved points: sigma_n^2 = tr(J_n Sigma J_n^T) / 2."""
    J = _pixel_jacobian(T, points, camera)
    return np.sqrt(np.einsum("nij,nij->n", J @ covariance, J) / 2)


def _pixel_jacobian(T: NDArray[np.float64], points: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Derivatives (n, 2, 6) of moved points' pixels by the twist of T."""
    x, y, z = (points @ T[:3, :3].T + T[:3, 3]).T
    x, y, by_z, none = x / z, y / z, 1 / z, np.zeros_like(z)
    u = np.stack([by_z, none, -x * by_z, -x * y, 1 + x * x, -y], axis=1)
    v = np.stack([none, by_z, -y * by_z, -1 - y * y, x * y, x], axis=1)
    return camera.focal[:, None] * np.stack([u, v], axis=1)


def weighted_median(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Smallest of the values (n,) that has half of the weight (n,) together with smaller values; n > 0."""
    order = values.argsort()
    total = weights[order].cumsum()
    return float(values[order[total.searchsorted(total[-1] / 2)]])


def propagate_to_segments(corners: LabelledCorners) -> NDArray[np.bool_]:
    """Pixels (h, w) of the segments with at least FEWEST_MOVING moving corners, and a share of AGREED."""
    num_moving, num_all = corners.count_by_segment(corners.moving), corners.count_by_segment()
    moves = (num_moving >= FEWEST_MOVING) & (num_moving >= AGREED * num_all)
    moves[0] = False
    return moves[corners.segmentation.labels]


def static_segments(corners: LabelledCorners) -> NDArray[np.bool_]:
    """Pixels (h, w) of segments with enough static corners, and a share of more than 1 - AGREED."""
    num_static, num_all = corners.count_by_segment(corners.static), corners.count_by_segment()
    static = (num_static >= FEWEST_MOVING) & (num_static > (1 - AGREED) * num_all)
    static[0] = False
    return static[corners.segmentation.labels]


def _pixels_of_level(
    pixels: "NDArray[np.int64] | NDArray[np.float64]", level: Level, other: Level
) -> NDArray[np.int64]:
    """Nearest pixels in another level to positions of a level."""
    scale = other.camera.width / level.camera.width
    return _nearest_pixels((pixels + 0.5) * scale - 0.5, other)


def _nearest_pixels(positions: "NDArray[np.floating]", level: Level) -> NDArray[np.int64]:
    last = level.camera.width - 1, level.camera.height - 1
    return np.minimum(np.maximum(np.rint(positions), 0), last).astype(np.int64)
