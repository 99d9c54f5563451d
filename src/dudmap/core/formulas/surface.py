"""Formulas of a mesh vertex on an edge: position, colour, normal."""

import numpy as np

from dudmap.core.backends.threads import written_out

MIN_OFFSET = np.float32(1e-3)
"""Smallest distance of a vertex from a voxel, share of the edge."""


@written_out
def crossing(a, b):
    """Zero crossing between ``a`` and ``b`` of opposite signs, share of the edge."""
    return min(max(a / (a - b), MIN_OFFSET), np.float32(1) - MIN_OFFSET)


@written_out
def mixed_channel(low, high, t):
    """Channel at ``t`` between two voxels, quarters of a grey level; rounds when truncated."""
    return min((low + (high - low) * t) * np.float32(0.25) + np.float32(0.5), np.float32(255))


@written_out
def slope(here, above, below):
    """Derivative of sdf: central difference, one-sided next to unobserved voxels."""
    has_above, has_below = (above & 0xFF00) != 0, (below & 0xFF00) != 0
    high = above >> 16 if has_above else here >> 16
    low = below >> 16 if has_below else here >> 16
    span = np.float32(0.5) if has_above and has_below else np.float32(1)
    return span * np.float32(high - low)
