"""Loops over label images: neighbourhood consistency, growing over depth, transfer to full resolution."""

import numpy as np

from dudmap.kernels.threads import kernel


@kernel
def fit_mixture(counts, centers, iterations, largest):
    """Expectation maximisation of two half-normal densities on a histogram (thesis eq. 4.52-4.56).

    Args:
        counts: (n,) float64.
        centers: (n,) float64, normalised residuals.
        iterations: Most iterations.
        largest: Largest standard deviation of the dynamic density.

    Returns:
        Prior of the dynamic density, standard deviations of the static and of the dynamic one.
    """
    total = counts.sum()
    prior, static, dynamic = 0.1, 1.0, 6.0
    if total == 0:
        return prior, static, dynamic
    for _ in range(iterations):
        mass, static_squares, dynamic_squares = 0.0, 0.0, 0.0
        for n in range(len(counts)):  # E-step: responsibility of the dynamic density for each bin
            square = centers[n] * centers[n]
            p = (1 - prior) / static * np.exp(-0.5 * square / (static * static))
            q = prior / dynamic * np.exp(-0.5 * square / (dynamic * dynamic))
            share = q / max(p + q, 1e-300)
            mass += share * counts[n]
            dynamic_squares += share * counts[n] * square
            static_squares += (1 - share) * counts[n] * square
        new_prior = min(max(mass / total, 0.02), 0.98)  # M-step
        new_static = min(max(np.sqrt(static_squares / max(total - mass, 1e-9)), 0.5), 2.0)
        new_dynamic = min(max(np.sqrt(dynamic_squares / max(mass, 1e-9)), 3 * new_static), largest)
        moved = max(abs(new_static - static), abs(new_dynamic - dynamic))
        done = abs(new_prior - prior) < 1e-4 and moved < 1e-3
        prior, static, dynamic = new_prior, new_static, new_dynamic
        if done:
            break
    return prior, static, dynamic


@kernel
def grow(seeds, open_pixels, depth, tolerance, labels):
    """Regions that grow from seeds over open pixels without crossing a depth edge.

    Args:
        seeds: (h, w) bool.
        open_pixels: (h, w) bool, pixels a region may take.
        depth: (h, w) float32, 0 = none.
        tolerance: (h, w) float32, largest depth step to a neighbour, metres.
        labels: (h, w) int32 out, 0 = none, else the region's number from 1.

    Returns:
        Number of regions.
    """
    h, w = depth.shape
    stack = np.empty(h * w, np.int32)
    labels[:] = 0
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
    return count


@kernel
def _tanh(x):
    """Hyperbolic tangent for |x| <= 5 within 3e-4 (Lambert's continued fraction), in arithmetic that vectorises."""
    square = x * x
    top = x * (np.float32(135135) + square * (np.float32(17325) + square * (np.float32(378) + square)))
    bottom = np.float32(135135) + square * (np.float32(62370) + square * (np.float32(3150) + square * np.float32(28)))
    return top / bottom


@kernel
def smooth(evidence, depth, tolerance, coupling, iterations):
    """Static probabilities with neighbourhood consistency: mean field over 8-neighbourhoods (cliques of algorithm 3).

    Args:
        evidence: (h, w) float32 log odds static : dynamic of each pixel alone, at most 6; 0 = nothing known.
        depth: (h, w) float32.
        tolerance: (h, w) float32, largest depth step to a neighbour of the same surface, metres.
        coupling: Log odds that all neighbours together can add, at most 4.
        iterations: Sweeps.

    Returns:
        (h, w) float32 static probability.
    """
    h, w = depth.shape
    zero, half = np.float32(0), np.float32(0.5)
    by_eight = coupling / np.float32(8)
    # with a border, so that every pixel has eight neighbours; spins are 2 p - 1 = tanh(log odds / 2)
    z = np.zeros((h + 2, w + 2), np.float32)
    spin, new = np.zeros((h + 2, w + 2), np.float32), np.zeros((h + 2, w + 2), np.float32)
    for v in range(h):
        for u in range(w):
            z[v + 1, u + 1] = depth[v, u]
            spin[v + 1, u + 1] = _tanh(half * evidence[v, u])
    total = np.empty(w, np.float32)
    for _ in range(iterations):
        for v in range(h):
            for u in range(w):
                total[u] = zero
            for k in range(9):
                dv, du = k // 3, k % 3
                weight = zero if k == 4 else np.float32(1)  # a pixel is no neighbour of its own
                for u in range(w):
                    n = np.uintp(u + du)
                    zn, here = z[v + dv, n], z[v + 1, np.uintp(u + 1)]
                    same = (zn > zero) & (here > zero) & (abs(zn - here) <= tolerance[v, u])
                    total[u] += weight * spin[v + dv, n] if same else zero
            for u in range(w):
                new[v + 1, np.uintp(u + 1)] = _tanh(half * (evidence[v, u] + by_eight * total[u]))
        spin, new = new, spin
    probability = np.empty((h, w), np.float32)
    for v in range(h):
        for u in range(w):
            probability[v, u] = half + half * spin[v + 1, np.uintp(u + 1)]
    return probability


@kernel
def upsample(row_start, row_stop, low, low_depth, depth, stride, out):
    """Label of each full-size pixel: that of the nearby low-size pixel whose depth is most alike, else of the nearest.

    Args:
        row_start, row_stop: Rows of the band.
        low: (h, w) uint8.
        low_depth: (h, w) float32.
        depth: (H, W) float32.
        stride: Full-size pixels per low-size pixel.
        out: (H, W) uint8 out.
    """
    h, w = low.shape
    width = depth.shape[1]
    zero, mismatch = np.float32(0), np.float32(64)
    # a tenth of a millimetre for each low-size pixel of distance: among equals the nearest
    apart = np.empty((2, width), np.float32)
    for u in range(width):
        apart[0, u] = np.float32(1e-4) * np.float32((2 * u + 1 - stride) % (2 * stride)) / np.float32(2 * stride)
        apart[1, u] = np.float32(1e-4) - apart[0, u]
    # depth and label of the four low-size pixels whose centres surround each pixel, from above left to below right
    around, marks = np.empty((4, width), np.float32), np.empty((4, width), np.float32)
    last = np.int64(-(2**31))
    marked = False
    for v in range(row_start, row_stop):
        y = (2 * v + 1 - stride) // (2 * stride)
        if y != last:
            last = y
            upper, lower = min(max(y, 0), h - 1), min(max(y + 1, 0), h - 1)
            marked = low[upper].any() or low[lower].any()
            for u in range(width if marked else 0):
                x = (2 * u + 1 - stride) // (2 * stride)
                left, right = min(max(x, 0), w - 1), min(max(x + 1, 0), w - 1)
                around[0, u], marks[0, u] = low_depth[upper, left], np.float32(low[upper, left])
                around[1, u], marks[1, u] = low_depth[upper, right], np.float32(low[upper, right])
                around[2, u], marks[2, u] = low_depth[lower, left], np.float32(low[lower, left])
                around[3, u], marks[3, u] = low_depth[lower, right], np.float32(low[lower, right])
        target = out[v]
        if not marked:
            target[:] = 0
            continue
        row = depth[v]
        below = np.float32(1e-4) * np.float32((2 * v + 1 - stride) % (2 * stride)) / np.float32(2 * stride)
        for u in range(width):
            z = row[u]
            best, label = np.float32(1e9), zero
            for k in range(4):
                zn, candidate = around[k, u], marks[k, u]
                gap = abs(zn - z) if (z > zero) == (zn > zero) else mismatch
                gap += apart[k & 1, u] + (below if k < 2 else np.float32(1e-4) - below)
                better = gap < best
                best = gap if better else best
                label = candidate if better else label
            target[u] = np.uint8(label)
