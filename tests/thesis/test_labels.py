"""Algorithm 3 against loops over pixels and known populations."""

import numpy as np

from dudmap.thesis.labels import density, dynamic_labels, expectation_maximisation, neighbourhood_mean, per_voxel
from dudmap.thesis_config import ThesisConfig

CONFIG = ThesisConfig()


def scene():
    """Distances (m) of a static image with a block that moved, and the block."""
    rng = np.random.default_rng(5)
    psi = (0.006 * rng.standard_normal((60, 80))).astype(np.float32)
    moved = np.zeros(psi.shape, bool)
    moved[20:45, 30:55] = True
    psi[moved] = 0.08
    psi[:5] = np.nan
    points = np.stack([*np.meshgrid(0.004 * np.arange(80), 0.004 * np.arange(60)), np.ones((60, 80))], axis=-1)
    return psi, moved, points


def test_the_density_is_a_half_normal():
    d = np.linspace(-1, 3, 400001)
    p = density(d, 0.4)
    assert np.sum(p) * (d[1] - d[0]) == np.float64(1).round() or abs(np.sum(p) * (d[1] - d[0]) - 1) < 1e-4
    assert (p[d < 0] == 0).all()
    assert abs(np.sum(p * d**2) * (d[1] - d[0]) - 0.16) < 1e-4


def test_the_neighbourhood_is_the_union_of_the_cliques_of_a_pixel():
    rng = np.random.default_rng(2)
    u, known = rng.random((7, 9)), rng.random((7, 9)) < 0.7
    found = neighbourhood_mean(u, known)
    for v in range(7):
        for x in range(9):
            members = set()
            for top in (v - 1, v):
                for left in (x - 1, x):  # the four cliques of 2x2 pixels
                    members |= {(row, column) for row in (top, top + 1) for column in (left, left + 1)}
            values = [u[m] for m in members if 0 <= m[0] < 7 and 0 <= m[1] < 9 and known[m]]
            np.testing.assert_allclose(found[v, x], np.mean(values) if values else 0, atol=1e-12)


def test_a_moved_block_is_found_and_noise_is_not():
    psi, moved, points = scene()
    dynamic, posterior = dynamic_labels(psi, points, CONFIG)
    assert (dynamic & moved).sum() / (dynamic | moved).sum() > 0.97
    assert posterior[moved].min() > 0.5
    static, _ = dynamic_labels(np.where(moved, np.float32(0.004), psi), points, CONFIG)
    assert not static.any()


def test_the_likelihood_does_not_fall():
    psi, _, _ = scene()
    known = np.isfinite(psi)
    r = np.where(known, psi, 0).astype(np.float64) ** 2
    start = (r > CONFIG.theta**2).astype(np.float64)
    reached = [expectation_maximisation(r, known, start, n, 1e-9)[1].likelihood for n in (1, 3, 30)]
    assert reached[0] <= reached[1] + 1e-6 <= reached[2] + 2e-6


def test_a_voxel_has_one_label():
    dynamic, known = np.zeros((2, 6), bool), np.ones((2, 6), bool)
    dynamic[0, :2], known[1, 5] = True, False
    points = np.zeros((2, 6, 3))
    points[..., 0] = np.repeat([0.001, 0.011], 3)  # three columns of pixels in each of two voxels
    points[1] -= [0, 0.01, 0]
    labels = per_voxel(dynamic, known, points, 0.01)
    np.testing.assert_array_equal(labels[0], [1, 1, 1, 0, 0, 0])
    assert not labels[1].any()
