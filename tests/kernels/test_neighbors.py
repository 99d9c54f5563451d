"""The voxels around points, against indexing into one dense array."""

import numpy as np
import pytest

from dudmap.core.backends.cpu.neighbors import AHEAD, load_corners, load_row

SHAPE = np.array([3, 2, 4], dtype=np.int64)  # blocks


@pytest.fixture(scope="module")
def grid():
    """Random voxels, two fifths of the blocks unknown: window, geometry, and the same as one array (X, Y, Z)."""
    rng = np.random.default_rng(3)
    window = np.full(np.prod(SHAPE), -1, dtype=np.int32)
    known = rng.permutation(len(window))[: 3 * len(window) // 5]
    window[known] = rng.permutation(len(known))
    window[window < 0] = rng.choice([-1, -7], np.count_nonzero(window < 0))  # nothing known; known to be free
    geometry = rng.integers(-(1 << 31), 1 << 31, (len(known), 8, 8, 8), dtype=np.int64).astype(np.int32)
    blocks = np.where(window[:, None, None, None] >= 0, geometry[np.maximum(window, 0)], 0).reshape(*SHAPE, 8, 8, 8)
    dense = blocks.transpose(0, 3, 1, 4, 2, 5).reshape(8 * SHAPE)
    return window, geometry.reshape(-1), dense


def around(dense, x, y, z):
    return dense[x : x + 2, y : y + 2, z : z + 2].reshape(8)


def test_one_point_finds_the_voxels_of_every_block_it_touches(grid):
    window, geometry, dense = grid
    corners = np.empty((8, 1), dtype=np.int32)
    for x, y, z in np.ndindex(*(dense.shape - np.array(1))):
        cell, voxel = np.ravel_multi_index((x >> 3, y >> 3, z >> 3), SHAPE), 64 * (x & 7) + 8 * (y & 7) + (z & 7)
        load_corners(window, geometry, cell, voxel, SHAPE[1], SHAPE[2], corners, 0)
        assert (corners[:, 0] == around(dense, x, y, z)).all(), (x, y, z)


def test_a_row_of_points_finds_what_each_of_them_finds(grid):
    window, geometry, dense = grid
    points = np.stack(np.unravel_index(np.random.default_rng(4).permutation(np.prod(dense.shape)), dense.shape), axis=1)
    points = points[(points < np.array(dense.shape) - 1).all(axis=1)]
    cells, voxels, w = points >> 3, points & 7, len(points)
    words = np.empty((8, w), dtype=np.int32)
    wanted = np.arange(w) % 3 > 0
    load_row(
        window,
        SHAPE,
        geometry,
        np.append(np.ravel_multi_index(tuple(cells.T), tuple(SHAPE)), [0] * AHEAD).astype(np.int32),
        np.append(np.ravel_multi_index(tuple(voxels.T), (8, 8, 8)), [0] * AHEAD).astype(np.int32),
        ((voxels == 7).any(axis=1) & wanted).astype(np.int32),
        np.empty(w, dtype=np.int32),
        words,
    )
    expected = np.array([around(dense, *point) for point in points])
    assert (words.T[wanted] == expected[wanted]).all()
