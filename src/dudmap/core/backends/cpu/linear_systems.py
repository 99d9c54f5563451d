"""Dense linear systems of a few hundred unknowns, on one thread."""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.vectors import wide_vectors
from dudmap.core.backends.threads import kernel


def solved(H: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solution (n,) or (n, k) of ``H x = right``, H (n, n) symmetric positive definite.

    No BLAS, whose threads keep the cores busy for 50 ms.
    """
    columns = np.array(right.T.reshape(-1, len(H)), order="C")
    solve(np.array(H, order="C"), columns)
    return columns.reshape(right.T.shape).T


@kernel
def solve(H, columns):
    """Replace ``columns`` (k, n) by solutions, and H by its Cholesky factor."""
    wide_vectors()
    for i in range(len(H)):
        for j in range(i + 1):
            total = H[i, j]
            for k in range(j):
                total -= H[i, k] * H[j, k]
            H[i, j] = np.sqrt(total) if i == j else total / H[j, j]
    for n in range(len(columns)):
        for i in range(len(H)):
            total = columns[n, i]
            for k in range(i):
                total -= H[i, k] * columns[n, k]
            columns[n, i] = total / H[i, i]
        for i in range(len(H) - 1, -1, -1):
            columns[n, i] /= H[i, i]
            for k in range(i):
                columns[n, k] -= H[i, k] * columns[n, i]
