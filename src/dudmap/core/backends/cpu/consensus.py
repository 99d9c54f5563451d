"""Consensus on a rigid motion: MSAC scores, Gauss-Newton on inliers."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.teams import NO_BAND, done, finish, first_band, run_team, take, wait_for_all
from dudmap.core.backends.threads import kernel, scalar
from dudmap.core.geometry.se3 import SMALL

BANDS = 12
"""Bands of a search."""
REFINED = 5
"""Refined hypotheses per noise level: three noisy corners seldom give the best motion."""
ROUNDS = 2.0, 1.0, 1.0
"""Inlier thresholds of the rounds, multiples of the usual; the first is wider."""
REGULAR = 1e-9
"""Added to diagonals: absolutely for repeated points, relative to the trace for least squares."""


class ConsensusParams(NamedTuple):
    """Scales of the consensus, pixels.

    Attributes:
        inlier_px: Smallest error of an outlier, per noise level.
        gain: Log-likelihood ratio of an error-free correspondence to an outlier, per noise level.
        prior_px: Mean distance from expected positions at a prior of 3/4.
    """

    inlier_px: tuple[float, ...]
    gain: tuple[float, ...]
    prior_px: float


class Correspondences(NamedTuple):
    """Points and their image positions after a motion.

    Attributes:
        points: (3, n) float64, metres, first camera's frame.
        targets: (2, n) float64, their pixels in the second image.
        expected: (2, n) float64, for the expected motion.
        weights: (n,) float64, of each point.
        intrinsics: (4,) fx, fy, cx, cy.
    """

    points: NDArray[np.float64]
    targets: NDArray[np.float64]
    expected: NDArray[np.float64]
    weights: NDArray[np.float64]
    intrinsics: NDArray[np.float32]


def best_motion(
    draws: NDArray[np.int64], found: Correspondences, params: ConsensusParams, T_expected: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Motion (4, 4) of the highest score among refined hypotheses and the expected motion.

    Args:
        draws: (g, 3) correspondences per hypothesis.
        found: The correspondences.
        params: Scales of the scores.
        T_expected: (4, 4).
    """
    levels = len(params.gain)
    size = levels * (REFINED + 1)
    motions, scores = np.empty((len(draws), 4, 4)), np.empty((len(draws), levels))
    refined, refined_scores = np.empty((size, 4, 4)), np.empty((size, levels))
    return run_team(
        search, BANDS, draws, found, params, np.ascontiguousarray(T_expected), motions, scores, refined, refined_scores
    )


@kernel
def search(leads, team, draws, found, params, T_expected, motions, scores, refined, refined_scores):
    """Loop of ``best_motion`` for a team of threads: score the hypotheses, then refine the best of each noise level and
    the expected motion."""
    step, levels = 0, scores.shape[1]
    while step < 2:
        band, number = first_band(leads, team, step, BANDS)
        if band == NO_BAND and not leads:
            break
        while band != NO_BAND:
            all_motions, all_scores = (motions, scores) if number == 0 else (refined, refined_scores)
            start, stop = len(all_motions) * band // BANDS, len(all_motions) * (band + 1) // BANDS
            for g in range(start, stop):
                if number == 0:
                    hypothesis(draws[g], found, motions[g])
                else:
                    refine(refined[g], found, params.inlier_px[g // (REFINED + 1)])
            score(start, stop, all_motions, found, params, all_scores)
            done(team)
            band, number = take(team, BANDS)
        if leads:
            wait_for_all(team, BANDS)
            if step == 0:
                for k in range(levels):
                    first = k * (REFINED + 1)
                    for n in range(REFINED + 1):
                        best = highest(scores[:, k])
                        T = T_expected if n == 0 else motions[best]
                        for i in range(16):
                            refined[first + n, i // 4, i % 4] = T[i // 4, i % 4]
                        if n > 0:
                            scores[best, k] = -np.inf
            step += 1
    best = 0
    if leads:
        finish(team)
        best = highest(refined_scores.reshape(-1)) // levels
    return refined[best]


@scalar
def highest(scores):
    """Index of the highest score (n,), the first of equal ones; NaN is ignored."""
    best, most = 0, -np.inf
    for n in range(len(scores)):
        if scores[n] > most:
            best, most = n, scores[n]
    return best


@scalar
def solved(A, b):
    """Solution (n,) of A x = b by Gaussian elimination; both are overwritten."""
    n = len(b)
    for i in range(n):
        pivot = i
        for j in range(i + 1, n):
            pivot = j if abs(A[j, i]) > abs(A[pivot, i]) else pivot
        for k in range(n):
            A[i, k], A[pivot, k] = A[pivot, k], A[i, k]
        b[i], b[pivot] = b[pivot], b[i]
        for j in range(i + 1, n):
            share = A[j, i] / A[i, i]
            for k in range(i, n):
                A[j, k] -= share * A[i, k]
            b[j] -= share * b[i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= A[i, k] * b[k]
        b[i] /= A[i, i]
    return b


@scalar
def exponential(twist, T):
    """Write the rigid motion (4, 4) of a twist (6,), see ``se3.exp``."""
    x, y, z = twist[3], twist[4], twist[5]
    square = x * x + y * y + z * z
    a, b, c = 1 - square / 6, 0.5 - square / 24, 1 / 6 - square / 120
    if square >= SMALL:
        theta = np.sqrt(square)
        a, b = np.sin(theta) / theta, (1 - np.cos(theta)) / square
        c = (1 - a) / square
    W, WW = np.zeros((3, 3)), np.zeros((3, 3))
    W[0, 1], W[0, 2], W[1, 0], W[1, 2], W[2, 0], W[2, 1] = -z, y, z, -x, -y, x
    for i in range(4):
        for j in range(4):
            T[i, j] = 1.0 if i == j else 0.0
    for i in range(3):
        T[i, 3] = twist[i]
        for j in range(3):
            for k in range(3):
                WW[i, j] += W[i, k] * W[k, j]
    for i in range(3):
        for j in range(3):
            T[i, j] += a * W[i, j] + b * WW[i, j]
            T[i, 3] += (b * W[i, j] + c * WW[i, j]) * twist[j]


@scalar
def hypothesis(draw, found, T):
    """Write the motion (4, 4) of three correspondences, linear in their flow."""
    points, targets, i = found.points, found.targets, found.intrinsics
    A, b = np.zeros((6, 6)), np.empty(6)
    for k in range(3):
        n = draw[k]
        by_z = 1.0 / max(points[2, n], 1e-6)
        x, y = points[0, n] * by_z, points[1, n] * by_z
        for row in range(2):
            f, m = np.float64(i[row]), 2 * k + row
            ray = y if row == 1 else x
            A[m, row], A[m, 2] = f * by_z, -f * ray * by_z
            A[m, 3] = -f * (1 + y * y) if row == 1 else -f * x * y
            A[m, 4] = f * x * y if row == 1 else f * (1 + x * x)
            A[m, 5] = f * x if row == 1 else -f * y
            b[m] = targets[row, n] - (f * ray + np.float64(i[2 + row]))
    for m in range(6):
        A[m, m] += REGULAR
    exponential(solved(A, b), T)


@scalar
def refine(T, found, inlier_px):
    """Replace a motion (4, 4) by the least-squares motion of its inliers."""
    for scale in ROUNDS:
        H, gradient, inliers = linearized(T, found, scale * inlier_px)
        if inliers < 6:
            continue
        trace = 0.0
        for m in range(6):
            trace += H[m, m]
        for m in range(6):
            H[m, m] += REGULAR * trace
        step, old = np.empty((4, 4)), T.copy()
        exponential(solved(H, gradient), step)
        for i in range(3):
            for j in range(4):
                T[i, j] = step[i, 3] if j == 3 else 0.0
                for k in range(3):
                    T[i, j] += step[i, k] * old[k, j]


@scalar
def score(start, stop, motions, found, params, scores):
    """MSAC scores (g, k) of motions at each noise level (Torr and Zisserman 2000), times a prior.

    gain * sum_n w_n (1 - min(e_n^2 / inlier_px^2, 1)) * (0.5 + 0.5 / (1 + (d / prior_px)^2)), with the reprojection
    error e_n and the mean distance d of the pixels from the expected ones.
    """
    points, targets, expected, weights, intrinsics = found
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


@scalar
def linearized(T, found, inlier_px):
    """Normal equations of the reprojection error at a motion (4, 4), of errors below ``inlier_px``.

    Returns:
        H (6, 6), gradient (6,), number of inliers. ``solve(H, gradient)`` is the twist (v, omega) of exp(twist) @ T.
    """
    points, targets, intrinsics = found.points, found.targets, found.intrinsics
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    size = points.shape[1]
    rows = np.zeros((7, 2, size))  # derivatives of the pixels u, v by the twist, and their errors; 0 for outliers
    products, H, gradient = rows.reshape(7, 2 * size), np.empty((6, 6)), np.empty(6)
    limit, count = inlier_px * inlier_px, 0.0
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
    for i in range(6):
        for j in range(i, 7):
            total = 0.0
            for n in range(2 * size):
                total += products[i, n] * products[j, n]
            if j == 6:
                gradient[i] = total
            else:
                H[i, j] = H[j, i] = total
    return H, gradient, np.int64(count)
