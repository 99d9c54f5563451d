"""Loop of the depth-adaptive bilateral filter (thesis eq. 4.8-4.11)."""

import numpy as np

from dudmap.core.backends.threads import kernel


@kernel
def filter_rows(start, stop, D, alpha, sigma_s, radius, out):
    """Filter rows ``start`` to ``stop`` of a depth image D (H, W) float32, metres; see ``depth_filter.bilateral``."""
    height, width = D.shape
    w_s = np.empty(radius + 1, np.float32)
    for step in range(radius + 1):
        w_s[step] = np.exp(-(step * step) / (2 * sigma_s * sigma_s))  # eq. 4.9, one factor per axis
    for v in range(start, stop):
        for u in range(width):
            depth = D[v, u]
            if depth == 0:
                out[v, u] = 0
                continue
            sigma_c = alpha * depth * depth  # eq. 4.11
            by_sigma = np.float32(0.5 / (sigma_c * sigma_c))
            total = W = np.float32(0)
            for row in range(max(v - radius, 0), min(v + radius + 1, height)):
                for column in range(max(u - radius, 0), min(u + radius + 1, width)):
                    other = D[row, column]
                    difference = depth - other
                    w_c = np.exp(-difference * difference * by_sigma)  # eq. 4.10
                    weight = w_s[abs(row - v)] * w_s[abs(column - u)] * w_c if other > 0 else np.float32(0)
                    total += weight * other
                    W += weight
            out[v, u] = total / W
