"""Label images: mixture of residuals, mean field, region growing, upsampling; formulas come first."""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.teams import NO_BAND, done, finish, first_band, run_team, take, wait_for_all
from dudmap.core.backends.threads import kernel, scalar

f64, exp, sqrt = np.float64, np.exp, np.sqrt
UPSAMPLING_BAND = 60
DISTANCE_COST = np.float32(1e-4)
"""Cost per low-resolution pixel of distance in upsampling, metres: decides between equal depths."""
SMALLEST = np.float64(1e-300)
"""Smallest sum of two densities."""
MISSING_COST = np.float32(64)
"""Cost of pairing pixels with and without depth, metres."""


@scalar
def half_normal(square, prior, sigma):
    """Density of a component without sqrt(2 / pi) (thesis eq. 4.56).

    Args:
        square: Squared normalised residual.
        prior, sigma: Of the component.
    """
    return prior / sigma * exp(f64(-0.5) * square / (sigma * sigma))


@scalar
def dynamic_responsibility(square, prior, static, dynamic):
    """Posterior of the dynamic component (E-step; thesis eq. 4.53).

    Args:
        square: Squared normalised residual.
        prior: Prior of the dynamic component.
        static, dynamic: Standard deviations of the components.
    """
    p = half_normal(square, f64(1) - prior, static)
    q = half_normal(square, prior, dynamic)
    return q / max(p + q, SMALLEST)


@scalar
def bounded_sigma(squares, mass, low, high):
    """Maximum-likelihood half-normal standard deviation within bounds (M-step; thesis eq. 4.55).

    Args:
        squares: Squared residuals times responsibilities.
        mass: Sum of the responsibilities.
        low, high: Bounds.
    """
    return min(max(sqrt(squares / max(mass, f64(1e-9))), low), high)


@scalar
def tanh(x):
    """Hyperbolic tangent for |x| <= 5 within 3e-4 (Lambert's continued fraction), vectorisable."""
    square = x * x
    top = x * (np.float32(135135) + square * (np.float32(17325) + square * (np.float32(378) + square)))
    bottom = np.float32(135135) + square * (np.float32(62370) + square * (np.float32(3150) + square * np.float32(28)))
    return top / bottom


@scalar
def mean_spin(log_odds):
    """Expected spin (static = 1, dynamic = -1) of log odds static : dynamic: tanh(log_odds / 2)."""
    return tanh(np.float32(0.5) * log_odds)


@scalar
def same_surface(z, z_neighbour, tolerance):
    """Whether two pixels have depths that differ by at most ``tolerance``."""
    zero = np.float32(0)
    return (z_neighbour > zero) & (z > zero) & (abs(z_neighbour - z) <= tolerance)


@scalar
def depth_cost(z, z_low):
    """Cost of a low-resolution label for depth ``z``: difference, metres, or ``MISSING_COST``."""
    zero = np.float32(0)
    return abs(z_low - z) if (z > zero) == (z_low > zero) else MISSING_COST


@scalar
def fit_mixture(counts, centers, iterations, start, prior_bounds, static_bounds, separation, max_sigma):
    """Expectation maximisation of two half-normal densities on a histogram (thesis eq. 4.52-4.56).

    Args:
        counts: (n,) float64.
        centers: (n,) float64.
        iterations: Limit.
        start: Prior of the dynamic density, standard deviations, static and dynamic.
        prior_bounds: Of the dynamic prior.
        static_bounds: Of the static standard deviation.
        separation: Smallest ratio of standard deviations.
        max_sigma: Largest dynamic standard deviation.

    Returns:
        As ``start``, which is returned without counts.
    """
    total = counts.sum()
    prior, static, dynamic = start
    if total == 0:
        return prior, static, dynamic
    for _ in range(iterations):
        mass, static_squares, dynamic_squares = 0.0, 0.0, 0.0
        for n in range(len(counts)):
            square = centers[n] * centers[n]
            share = dynamic_responsibility(square, prior, static, dynamic)
            mass += share * counts[n]
            dynamic_squares += share * counts[n] * square
            static_squares += (1 - share) * counts[n] * square
        new_prior = min(max(mass / total, prior_bounds[0]), prior_bounds[1])
        new_static = bounded_sigma(static_squares, total - mass, static_bounds[0], static_bounds[1])
        new_dynamic = bounded_sigma(dynamic_squares, mass, separation * new_static, max_sigma)
        step = max(abs(new_static - static), abs(new_dynamic - dynamic))
        converged = abs(new_prior - prior) < 1e-4 and step < 1e-3
        prior, static, dynamic = new_prior, new_static, new_dynamic
        if converged:
            break
    return prior, static, dynamic


@scalar
def grow_regions(seeds, open_pixels, depth, tolerance):
    """Flood fill from seeds over open pixels within depth edges.

    Args:
        seeds: (h, w) bool.
        open_pixels: (h, w) bool.
        tolerance: (h, w) float32, largest depth step within a surface, metres.

    Returns:
        (h, w) int32 region from 1, 0 = none, and the number of regions.
    """
    h, w = depth.shape
    stack = np.empty(h * w, np.int32)
    labels = np.zeros((h, w), np.int32)
    count = 0
    for v0 in range(h):
        for u0 in range(w):
            if not seeds[v0, u0] or labels[v0, u0] != 0:
                continue
            count += 1
            labels[v0, u0] = count
            stack[0] = v0 * w + u0
            top = 1
            while top > 0:
                top -= 1
                v, u = stack[top] // w, stack[top] % w
                z = depth[v, u]
                for k in range(4):
                    vn = v + (1 if k == 0 else -1 if k == 1 else 0)
                    un = u + (1 if k == 2 else -1 if k == 3 else 0)
                    if vn < 0 or un < 0 or vn >= h or un >= w or labels[vn, un] != 0:
                        continue
                    if not (open_pixels[vn, un] or seeds[vn, un]) or depth[vn, un] <= 0:
                        continue
                    if abs(depth[vn, un] - z) <= tolerance[v, u]:
                        labels[vn, un] = count
                        stack[top] = vn * w + un
                        top += 1
    return labels, count


@scalar
def mean_field(evidence, depth, tolerance, coupling, iterations):
    """Static probabilities with neighbourhood consistency (cliques of thesis algorithm 3), by mean field.

    Each sweep sets the expectation of every spin s (1 = static, -1 = dynamic) to

        <s_i> = tanh((e_i + coupling / 8 * sum_j <s_j>) / 2)

    over the 8 neighbours j on the same surface.

    Args:
        evidence: (h, w) float32 log odds static : dynamic, at most 6; 0 = unknown.
        tolerance: (h, w) float32, largest depth step within a surface, metres.
        coupling: Log odds of all neighbours, at most 4.
        iterations: Sweeps.

    Returns:
        (h, w) float32 static probability.
    """
    h, w = depth.shape
    zero, half = np.float32(0), np.float32(0.5)
    per_neighbour = np.float32(coupling) / np.float32(8)
    # with a border, so that every pixel has eight neighbours
    z = np.zeros((h + 2, w + 2), np.float32)
    spin, new = np.zeros((h + 2, w + 2), np.float32), np.zeros((h + 2, w + 2), np.float32)
    for v in range(h):
        for u in range(w):
            z[v + 1, u + 1] = depth[v, u]
            spin[v + 1, u + 1] = mean_spin(evidence[v, u])
    total = np.empty(w, np.float32)
    for _ in range(iterations):
        for v in range(h):
            for u in range(w):
                total[u] = zero
            for k in range(9):
                dv, du = k // 3, k % 3
                weight = zero if k == 4 else np.float32(1)  # a pixel is not its own neighbour
                for u in range(w):
                    n = np.uintp(u + du)
                    same = same_surface(z[v + 1, np.uintp(u + 1)], z[v + dv, n], tolerance[v, u])
                    total[u] += weight * spin[v + dv, n] if same else zero
            for u in range(w):
                new[v + 1, np.uintp(u + 1)] = mean_spin(evidence[v, u] + per_neighbour * total[u])
        spin, new = new, spin
    probability = np.empty((h, w), np.float32)
    for v in range(h):
        for u in range(w):
            probability[v, u] = half + half * spin[v + 1, np.uintp(u + 1)]
    return probability


def upsample_labels(
    low: NDArray[np.bool_], low_depth: NDArray[np.float32], depth: NDArray[np.float32], stride: int
) -> NDArray[np.bool_]:
    """Labels at full resolution, of the adjacent low-resolution pixel with the nearest depth.

    Args:
        low: (h, w) bool.
        low_depth: (h, w) float32, metres, 0 = none.
        depth: (H, W) float32, metres, 0 = none.
        stride: Full pixels per low pixel k, which covers columns (rows) k * stride to (k + 1) * stride - 1.

    Returns:
        (H, W) bool.
    """
    out = np.empty(depth.shape, dtype=np.uint8)
    num_bands = -(-depth.shape[0] // UPSAMPLING_BAND)
    run_team(upsample, num_bands, low.view(np.uint8), low_depth, depth, stride, out)
    return out.view(np.bool_)


@kernel
def upsample(leads, team, low, low_depth, depth, stride, out):
    """Loop of ``upsample_labels`` for a team of threads; ``low`` and ``out`` are uint8."""
    height = depth.shape[0]
    num_bands = -(-height // UPSAMPLING_BAND)
    band, _ = first_band(leads, team, 0, num_bands)
    while band != NO_BAND:
        start = band * UPSAMPLING_BAND
        upsample_rows(start, min(start + UPSAMPLING_BAND, height), low, low_depth, depth, stride, out)
        done(team)
        band, _ = take(team, num_bands)
    if leads:
        wait_for_all(team, num_bands)
        finish(team)


@scalar
def opened(mask, half):
    """Opening of a mask (h, w) bool by a square of 2 ``half`` + 1 pixels, without pixels outside."""
    h, w = mask.shape
    across, out = np.empty((h, w), np.bool_), mask.copy()
    for turn in range(2):  # the outside is dilated, then the inside
        for v in range(h):
            for u in range(w):
                across[v, u] = out[v, u] == (turn == 1)
            for k in range(1, half + 1):
                for u in range(w - k):
                    n = np.uintp(u + k)
                    across[v, u] |= out[v, n] == (turn == 1)
                    across[v, n] |= out[v, u] == (turn == 1)
        for v in range(h):
            first, last = max(v - half, 0), min(v + half, h - 1)
            for u in range(w):
                out[v, u] = across[first, u]
            for n in range(first + 1, last + 1):
                for u in range(w):
                    out[v, u] |= across[n, u]
            if turn == 0:
                for u in range(w):
                    out[v, u] = not out[v, u]
    return out


@scalar
def upsample_rows(row_start, row_stop, low, low_depth, depth, stride, out):
    """Rows ``row_start`` to ``row_stop`` of ``upsample_labels``; ``low`` and ``out`` are uint8."""
    h, w = low.shape
    width = depth.shape[1]
    zero = np.float32(0)
    # cost of the image distance to the low-resolution columns on the left and on the right of each pixel
    across = np.empty((2, width), np.float32)
    for u in range(width):
        across[0, u] = DISTANCE_COST * np.float32((2 * u + 1 - stride) % (2 * stride)) / np.float32(2 * stride)
        across[1, u] = DISTANCE_COST - across[0, u]
    # depth and label of the four low-resolution pixels around each pixel, starting at the upper left
    adjacent, marks = np.empty((4, width), np.float32), np.empty((4, width), np.float32)
    last = np.int64(-(2**31))
    first, stop = 0, 0
    for v in range(row_start, row_stop):
        y = (2 * v + 1 - stride) // (2 * stride)
        if y != last:
            last = y
            upper, lower = min(max(y, 0), h - 1), min(max(y + 1, 0), h - 1)
            first, stop = w, 0  # the marked columns
            for x in range(w):
                if low[upper, x] | low[lower, x]:
                    first, stop = min(first, x), x + 1
            first, stop = max(first - 1, 0) * stride, min((stop + 1) * stride, width)
            for u in range(first, stop):
                x = (2 * u + 1 - stride) // (2 * stride)
                left, right = min(max(x, 0), w - 1), min(max(x + 1, 0), w - 1)
                adjacent[0, u], marks[0, u] = low_depth[upper, left], np.float32(low[upper, left])
                adjacent[1, u], marks[1, u] = low_depth[upper, right], np.float32(low[upper, right])
                adjacent[2, u], marks[2, u] = low_depth[lower, left], np.float32(low[lower, left])
                adjacent[3, u], marks[3, u] = low_depth[lower, right], np.float32(low[lower, right])
        target = out[v]
        target[:] = 0  # pixels without a marked neighbour
        row = depth[v]
        below = DISTANCE_COST * np.float32((2 * v + 1 - stride) % (2 * stride)) / np.float32(2 * stride)
        for u in range(first, stop):
            n = np.uintp(u)
            z = row[n]
            best, label = np.float32(1e9), zero
            for k in range(4):
                candidate = marks[k, n]
                cost = depth_cost(z, adjacent[k, n]) + (across[k & 1, n] + (below if k < 2 else DISTANCE_COST - below))
                better = cost < best
                best = cost if better else best
                label = candidate if better else label
            target[n] = np.uint8(label)
