"""Median of few values, ten times as fast as NumPy's, and selection."""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.threads import scalar


def median(rows: NDArray) -> NDArray:
    """Median of (n,), or of columns of (n, m); the upper one of an even number. NaN sorts last."""
    rows, middle = rows.copy(), len(rows) // 2
    rows.partition(middle, axis=0)
    return rows[middle]


@scalar
def nth(values: NDArray[np.floating], k: int) -> float:
    """Value ``k`` of finite values (n,), ascending, by Hoare's selection, which compiles faster than NumPy's
    partition."""
    left, right, v = 0, len(values) - 1, values.copy()
    while left < right:
        pivot, i, j = v[(left + right) // 2], left, right
        while i <= j:
            while v[i] < pivot:
                i += 1
            while v[j] > pivot:
                j -= 1
            if i <= j:
                v[i], v[j] = v[j], v[i]
                i += 1
                j -= 1
        if k <= j:
            right = j
        elif k >= i:
            left = i
        else:
            break
    return v[k]
