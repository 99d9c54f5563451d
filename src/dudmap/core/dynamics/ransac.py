"""Robust estimation of the rigid motion that most of the visible surface follows (RANSAC, Fischler and Bolles 1981)."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu import consensus
from dudmap.core.backends.cpu.consensus import ConsensusParams
from dudmap.core.geometry.camera import Camera

REFERENCE_WIDTH = 320
"""Image width that distances in pixels are given for; they grow in proportion to the width of an image."""
NOISE_PX = 0.7
"""Inlier threshold t of the reprojection error, pixels: t^2 = 5.99 sigma^2 holds 95 % of the errors (chi-square, two
degrees of freedom) of corners measured with sigma = 0.29 px per coordinate."""
NOISE_LEVELS = 1.0, 0.5, 0.25
"""Noise of the corners that is considered, as multiples of the largest one, the sigma of NOISE_PX: in sharp images
corners of a right motion are measured with 0.07 px per coordinate."""
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
    return consensus.best_motion(draws, found, _params(camera), T_expected)


def pixels_at_width(distance: float, camera: Camera) -> float:
    """Distance in pixels of an image, given that in an image of REFERENCE_WIDTH with the same view."""
    return distance * camera.width / REFERENCE_WIDTH


@lru_cache(maxsize=8)
def _params(camera: Camera) -> ConsensusParams:
    levels = np.array(NOISE_LEVELS)
    gain = OUTLIER_GAIN - 2 * np.log(levels)  # the density of errors without noise grows with 1 / sigma^2
    limits = pixels_at_width(NOISE_PX, camera) * levels * np.sqrt(gain / OUTLIER_GAIN)
    return ConsensusParams(tuple(limits), tuple(gain), pixels_at_width(NEAR_PX, camera))


def reproject(T: NDArray[np.float64], points: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Pixels (n, 2) of points (n, 3) after a motion T (4, 4); points behind the camera land far outside the image."""
    moved = points @ T[:3, :3].T + T[:3, 3]
    return camera.focal * moved[:, :2] / np.maximum(moved[:, 2:], 1e-6) + camera.centre
