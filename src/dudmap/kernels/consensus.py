"""Consensus of point correspondences on a rigid motion: MSAC scores of hypotheses, Gauss-Newton on the inliers."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.kernels.threads import bands, kernel, run_bands

BAND = 64
"""Hypotheses that one thread scores in one go."""


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


@kernel
def inlier_score(squared_error):
    """MSAC score 1 - min(e^2, 1) of a squared error in units of the inlier threshold (Torr and Zisserman 2000)."""
    return 1.0 - min(squared_error, 1.0)


@kernel
def motion_prior(distance):
    """Prior 0.5 + 0.5 / (1 + d^2) of a motion whose image positions lie ``d prior_px`` off the expected ones."""
    return 0.5 + 0.5 / (1.0 + distance * distance)


def msac_scores(
    twists: NDArray[np.floating],
    jacobian: NDArray[np.float64],
    flow: NDArray[np.float64],
    expected_flow: NDArray[np.float64],
    weights: NDArray[np.float64],
    params: ConsensusParams,
) -> NDArray[np.float64]:
    """Scores (g, k) of motion hypotheses at each noise level.

    They are gain * sum_n w_n (1 - min(e_n^2 / inlier_px^2, 1)) times the prior of the motion.

    The error e_n is the distance of the linearised flow ``J_n twist`` from the measured one, the argument of the prior
    the mean distance of ``J_n twist`` from the expected flow.

    Args:
        twists: (g, 6) hypotheses (v, omega), metres and radians.
        jacobian: (n, 2, 6) derivative of the pixels of n points by a twist.
        flow: (n, 2) measured displacement of their pixels.
        expected_flow: (n, 2) displacement by the expected motion, pixels.
        weights: (n,) weight of each point.
        params: Scales of errors and prior.
    """
    by_axis = np.ascontiguousarray(jacobian.transpose(1, 2, 0))
    measured, expected = np.ascontiguousarray(flow.T), np.ascontiguousarray(expected_flow.T)
    twists = np.ascontiguousarray(twists)
    scores = np.empty((len(twists), len(params.gain)))
    run_bands(
        lambda start, stop: _score_band(start, stop, twists, by_axis, measured, expected, weights, params, scores),
        bands(len(twists), BAND),
    )
    return scores


@kernel
def _score_band(start, stop, twists, jacobian, flow, expected_flow, weights, params, scores):
    """Scores of the hypotheses ``start`` to ``stop``; jacobian (2, 6, n), flows (2, n)."""
    levels = scores.shape[1]
    by_square = np.empty(levels)
    for k in range(levels):
        by_square[k] = 1.0 / (params.inlier_px[k] * params.inlier_px[k])
    for g in range(start, stop):
        a, b, c = twists[g, 0], twists[g, 1], twists[g, 2]
        d, e, f = twists[g, 3], twists[g, 4], twists[g, 5]
        distance = 0.0
        scores[g] = 0.0
        for n in range(weights.size):
            u = jacobian[0, 0, n] * a + jacobian[0, 1, n] * b + jacobian[0, 2, n] * c
            u += jacobian[0, 3, n] * d + jacobian[0, 4, n] * e + jacobian[0, 5, n] * f
            v = jacobian[1, 0, n] * a + jacobian[1, 1, n] * b + jacobian[1, 2, n] * c
            v += jacobian[1, 3, n] * d + jacobian[1, 4, n] * e + jacobian[1, 5, n] * f
            du, dv = u - flow[0, n], v - flow[1, n]
            square = du * du + dv * dv
            for k in range(levels):
                scores[g, k] += weights[n] * inlier_score(square * by_square[k])
            du, dv = u - expected_flow[0, n], v - expected_flow[1, n]
            distance += np.sqrt(du * du + dv * dv)
        prior = motion_prior(distance / (params.prior_px * weights.size))
        for k in range(levels):
            scores[g, k] *= params.gain[k] * prior


@kernel
def normal_equations(points, targets, T, intrinsics, inlier_px):
    """Gauss-Newton normal equations of the reprojection error of the inliers of a motion.

    Args:
        points: (n, 3) float64, metres, first camera's frame.
        targets: (n, 2) float64, their pixels in the second image.
        T: (4, 4) float64, the motion.
        intrinsics: (4,) fx, fy, cx, cy.
        inlier_px: Reprojection error from which on a point is left out, pixels.

    Returns:
        H (6, 6) and g (6,), whose solution ``solve(H, g)`` is the twist (v, omega) of the update exp(twist) @ T, and
        the number of inliers.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    H, gradient = np.zeros((6, 6)), np.zeros(6)
    count = 0
    for n in range(points.shape[0]):
        a, b, c = points[n, 0], points[n, 1], points[n, 2]
        z = max(T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3], 1e-6)
        x = (T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]) / z
        y = (T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]) / z
        du, dv = targets[n, 0] - fx * x - cx, targets[n, 1] - fy * y - cy
        if not du * du + dv * dv < inlier_px * inlier_px:
            continue
        count += 1
        along_u = (fx / z, 0.0, -fx * x / z, -fx * x * y, fx * (1.0 + x * x), -fx * y)
        along_v = (0.0, fy / z, -fy * y / z, -fy * (1.0 + y * y), fy * x * y, fy * x)
        for i in range(6):
            gradient[i] += along_u[i] * du + along_v[i] * dv
            for j in range(6):
                H[i, j] += along_u[i] * along_u[j] + along_v[i] * along_v[j]
    return H, gradient, count
