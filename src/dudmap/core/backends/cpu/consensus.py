"""Consensus of point correspondences on a rigid motion: MSAC scores of hypotheses, Gauss-Newton on the inliers, and
votes of the nearest ones."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.threads import bands, kernel, run_bands

BAND, LINEARIZED_BAND = 64, 6
"""Motions that one thread scores, and linearises, in one go."""


class ConsensusParams(NamedTuple):
    """Scales of the consensus, pixels.

    Attributes:
        inlier_px: Reprojection errors from which on a correspondence is an outlier, one per noise level.
        gain: Log-likelihood ratio of a correspondence without error to an outlier, one per noise level.
        prior_px: Mean distance from the expected image positions at which the prior of a motion is 3/4.
    """

    inlier_px: tuple[float, ...]
    gain: tuple[float, ...]
    prior_px: float


class Correspondences(NamedTuple):
    """Points and where they are found after a motion.

    Attributes:
        points: (3, n) float64, metres, first camera's frame.
        targets: (2, n) float64, their pixels in the second image.
        expected: (2, n) float64, their pixels there by the expected motion.
        weights: (n,) float64, weight of each point in a score.
        intrinsics: (4,) fx, fy, cx, cy.
    """

    points: NDArray[np.float64]
    targets: NDArray[np.float64]
    expected: NDArray[np.float64]
    weights: NDArray[np.float64]
    intrinsics: NDArray[np.float32]


def msac_scores(motions: NDArray[np.float64], found: Correspondences, params: ConsensusParams) -> NDArray[np.float64]:
    """MSAC scores (g, k) of motions (g, 4, 4) at each noise level (Torr and Zisserman 2000), times a prior.

    They are gain * sum_n w_n (1 - min(e_n^2 / inlier_px^2, 1)) * (0.5 + 0.5 / (1 + (d / prior_px)^2)), where e_n is the
    reprojection error and d the mean distance of the pixels from the expected ones.
    """
    scores = np.empty((len(motions), len(params.gain)))
    run_bands(
        lambda start, stop: _score_band(start, stop, motions, *found, params, scores),
        bands(len(motions), BAND),
    )
    return scores


def linearized(
    motions: NDArray[np.float64], found: Correspondences, inlier_px: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Normal equations of the reprojection error of motions (g, 4, 4), linearised at each of them.

    Points are left out of them from an error of ``inlier_px`` (g,) on, pixels.

    Returns:
        H (g, 6, 6) and gradient (g, 6), whose solution ``solve(H, gradient)`` is the twist (v, omega) of the update
        exp(twist) @ T; number of the inliers (g,).
    """
    g = len(motions)
    H, gradient, inliers = np.zeros((g, 6, 6)), np.zeros((g, 6)), np.zeros(g, np.int64)
    run_bands(
        lambda start, stop: _linearize_band(
            start, stop, motions, inlier_px, found.points, found.targets, found.intrinsics, H, gradient, inliers
        ),
        bands(g, LINEARIZED_BAND),
    )
    return H, gradient, inliers


@kernel
def _score_band(start, stop, motions, points, targets, expected, weights, intrinsics, params, scores):
    """Scores of the motions ``start`` to ``stop``."""
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    square = np.empty(weights.size)
    for g in range(start, stop):
        T, distance = motions[g], 0.0
        for n in range(weights.size):
            a, b, c = points[0, n], points[1, n], points[2, n]
            by_z = 1.0 / max(T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3], 1e-6)
            u = fx * (T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]) * by_z + cx
            v = fy * (T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]) * by_z + cy
            du, dv = u - targets[0, n], v - targets[1, n]
            square[n] = du * du + dv * dv
            du, dv = u - expected[0, n], v - expected[1, n]
            distance += np.sqrt(du * du + dv * dv)
        distance /= params.prior_px * weights.size
        prior = 0.5 + 0.5 / (1.0 + distance * distance)
        for k in range(scores.shape[1]):
            by_square, total = 1.0 / (params.inlier_px[k] * params.inlier_px[k]), 0.0
            for n in range(weights.size):
                total += weights[n] * (1.0 - min(square[n] * by_square, 1.0))
            scores[g, k] = total * params.gain[k] * prior


@kernel
def _linearize_band(start, stop, motions, inlier_px, points, targets, intrinsics, H, gradient, inliers):
    """Normal equations and numbers of inliers of the motions ``start`` to ``stop``."""
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    size = points.shape[1]
    rows = np.zeros((7, 2, size))  # derivatives of the pixels u, v by the twist, and their errors; of outliers 0
    products = rows.reshape(7, 2 * size)
    for g in range(start, stop):
        T, limit, count = motions[g], inlier_px[g] * inlier_px[g], 0.0
        for n in range(size):
            a, b, c = points[0, n], points[1, n], points[2, n]
            by_z = 1.0 / max(T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3], 1e-6)
            x = (T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]) * by_z
            y = (T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]) * by_z
            du, dv = targets[0, n] - fx * x - cx, targets[1, n] - fy * y - cy
            inlier = 1.0 if du * du + dv * dv < limit else 0.0
            count += inlier
            p, q = inlier * fx, inlier * fy
            rows[0, 0, n], rows[2, 0, n], rows[3, 0, n] = p * by_z, -p * x * by_z, -p * x * y
            rows[4, 0, n], rows[5, 0, n], rows[6, 0, n] = p * (1.0 + x * x), -p * y, du
            rows[1, 1, n], rows[2, 1, n], rows[3, 1, n] = q * by_z, -q * y * by_z, -q * (1.0 + y * y)
            rows[4, 1, n], rows[5, 1, n], rows[6, 1, n] = q * x * y, q * x, dv
        inliers[g] = np.int64(count)
        for i in range(6):
            for j in range(i, 7):
                total = 0.0
                for n in range(2 * size):
                    total += products[i, n] * products[j, n]
                if j == 6:
                    gradient[g, i] = total
                else:
                    H[g, i, j] = H[g, j, i] = total


@kernel
def neighbour_votes(queries, groups, points, group_of, moving, neighbours):
    """Number (q,) of the nearest points of the same group that move.

    Args:
        queries, groups: (q, 3) float64 positions, and the group (q,) of each, which has ``neighbours`` points or more.
        points, group_of, moving: (n, 3) float64, (n,) int32, (n,) bool: the points, their groups, and which move.
        neighbours: Number of points that vote.
    """
    votes = np.empty(len(queries), np.int64)
    distances, voters = np.empty(neighbours), np.empty(neighbours, np.int64)
    for q in range(len(queries)):
        distances[:] = np.inf
        for n in range(len(points)):
            if group_of[n] != groups[q]:
                continue
            x, y, z = points[n, 0] - queries[q, 0], points[n, 1] - queries[q, 1], points[n, 2] - queries[q, 2]
            square = x * x + y * y + z * z
            if square >= distances[neighbours - 1]:
                continue
            place = neighbours - 1
            while place > 0 and distances[place - 1] > square:
                distances[place], voters[place] = distances[place - 1], voters[place - 1]
                place -= 1
            distances[place], voters[place] = square, n
        count = 0
        for place in range(neighbours):
            count += 1 if moving[voters[place]] else 0
        votes[q] = count
    return votes
