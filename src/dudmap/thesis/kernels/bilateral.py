"""Loop of the depth-adaptive bilateral filter (thesis eq. 4.8-4.11)."""

import numpy as np

from dudmap.core.backends.cpu.vectors import wide_vectors
from dudmap.core.backends.threads import kernel, scalar


@scalar
def gaussian(x):
    """exp(-x) of x >= 0, vectorisable: the series of degree 6 at x / 16, to the power of 16; errors below 1e-6."""
    y = min(x, np.float32(16)) * np.float32(-1 / 16)
    e = np.float32(1 / 720)
    e = e * y + np.float32(1 / 120)
    e = e * y + np.float32(1 / 24)
    e = e * y + np.float32(1 / 6)
    e = e * y + np.float32(1 / 2)
    e = (e * y + np.float32(1)) * y + np.float32(1)
    e *= e
    e *= e
    e *= e
    return e * e


@scalar
def add(w_s, middle, others, by_sigma, total, W):
    """Add one pixel u_k of the window to the sums of each pixel of a row."""
    for u in range(middle.size):
        other = others[u]
        difference = middle[u] - other
        w_c = gaussian(difference * difference * by_sigma[u])  # eq. 4.10
        weight = w_s * w_c if other > np.float32(0) else np.float32(0)
        total[u] += weight * other
        W[u] += weight


@kernel
def filter_rows(start, stop, D, alpha, sigma_s, radius, out):
    """Filter rows ``start`` to ``stop`` of a depth image D float32, metres, with a border of ``radius`` zeros; see
    ``depth_filter.bilateral``."""
    wide_vectors()
    width = out.shape[1]
    by_sigma, total, W = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    w_s = np.empty(2 * radius + 1, np.float32)
    for step in range(2 * radius + 1):
        w_s[step] = np.exp(-((step - radius) ** 2) / (2 * sigma_s * sigma_s))  # eq. 4.9, a factor per axis
    for v in range(start, stop):
        middle = D[v + radius][radius : radius + width]
        for u in range(width):
            sigma_c = alpha * middle[u] * middle[u] if middle[u] > 0 else 1.0  # eq. 4.11
            by_sigma[u] = 0.5 / (sigma_c * sigma_c)
            total[u] = W[u] = 0
        for row in range(2 * radius + 1):
            for column in range(2 * radius + 1):
                add(w_s[row] * w_s[column], middle, D[v + row][column : column + width], by_sigma, total, W)
        for u in range(width):
            out[v, u] = total[u] / W[u] if middle[u] > 0 else 0
