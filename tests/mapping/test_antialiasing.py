"""The mean colour of the surface that a voxel stands for."""

import numpy as np
import pytest

from dudmap.core.backends.cpu.antialiasing import LARGEST_RADIUS
from dudmap.core.backends.cpu.backend import CpuBackend


def window_means(color, depth, by_depth, tolerance):
    """Plain oracle: half a voxel to each side, shrunk until the corners lie on the surface."""
    h, w = depth.shape
    out = np.empty_like(color)
    for v in range(h):
        for u in range(w):
            z = depth[v, u]
            radius = 0 if z == 0 else int(np.float32(0.5) * np.float32(by_depth) / z + np.float32(0.25))
            radius = min(radius, LARGEST_RADIUS, u, v, w - 1 - u, h - 1 - v)
            while radius > 0:
                corners = depth[[v - radius, v - radius, v + radius, v + radius], [u - radius, u + radius] * 2]
                if np.abs(corners - z).max() < tolerance:
                    break
                radius -= 1
            window = color[v - radius : v + radius + 1, u - radius : u + radius + 1].reshape(-1, 3)
            out[v, u] = np.floor(window.mean(axis=0) + 0.5)
    return out


def test_windows_are_those_of_the_oracle():
    rng = np.random.default_rng(0)
    depth = np.tile(np.linspace(0.4, 4, 80, dtype=np.float32), (60, 1))
    depth[20:40, 30:50] = 0.35  # in front
    depth[5, 7] = depth[50:55, 60:70] = 0
    color = rng.integers(0, 256, (60, 80, 3), dtype=np.uint8)
    found = CpuBackend().footprint_colors(color, depth, 200.0, 0.02)
    assert np.array_equal(found, window_means(color, depth, 4.0, 0.08))


def test_a_silhouette_keeps_its_colours():
    depth = np.full((40, 40), 2.0, np.float32)
    depth[:, 20:] = 1.0
    color = np.where(depth[..., None] == 1.0, 255, 0).astype(np.uint8) * np.ones(3, np.uint8)
    assert np.array_equal(CpuBackend().footprint_colors(color, depth, 800.0, 0.01), color)


def test_pixels_larger_than_voxels_keep_their_colour():
    color = np.random.default_rng(1).integers(0, 256, (30, 40, 3), dtype=np.uint8)
    depth = np.full((30, 40), 5.0, np.float32)
    assert np.array_equal(CpuBackend().footprint_colors(color, depth, 490.0, 0.01), color)


def test_edges_are_where_they_are():
    """A dark half of a wall, voxels of five pixels: single pixels displace the edge by up to 2 pixels, means do not."""
    color = np.zeros((60, 60, 3), np.uint8)
    color[:, 31:] = 200
    means = CpuBackend().footprint_colors(color, np.ones((60, 60), np.float32), 500.0, 0.01)[30, :, 0].astype(float)
    errors = []
    for phase in range(5):
        centres = np.arange(8 + phase, 55, 5)
        dark, single = (5 * np.sum(200 - row[centres]) / 200 for row in (means, color[30, :, 0].astype(float)))
        start = centres[0] - 2.5  # the first voxel reaches so far to the left
        assert start + dark == pytest.approx(30.5, abs=0.05)
        errors.append(abs(start + single - 30.5))
    assert max(errors) == pytest.approx(2.0)
