"""Copies of single rows between an array and a buffer."""

import warp as wp

wp.set_module_options({"enable_backward": False})

Rows = wp.array2d(dtype=wp.int32)


@wp.kernel
def scatter(rows: wp.array(dtype=wp.int32), source: Rows, target: Rows):
    """Copy row n of ``source`` to row ``rows[n]`` of ``target``."""
    n, k = wp.tid()
    target[rows[n], k] = source[n, k]


@wp.kernel
def gather(rows: wp.array(dtype=wp.int32), source: Rows, target: Rows):
    """Copy row ``rows[n]`` of ``source`` to row n of ``target``."""
    n, k = wp.tid()
    target[n, k] = source[rows[n], k]
