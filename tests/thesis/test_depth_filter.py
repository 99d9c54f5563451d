"""Depth smoothing of section 4.3 against loops over pixels."""

import numpy as np

from dudmap.thesis.depth_filter import bilateral, fill_zeros


def depth_with_holes():
    rng = np.random.default_rng(3)
    D = (1.5 + 0.05 * rng.standard_normal((24, 31))).astype(np.float32)
    D[:, 20:] += 1.0
    D[rng.random(D.shape) < 0.2] = 0
    D[:9, :9] = 0
    return D


def test_zero_pixels_take_the_mean_of_the_valid_pixels_of_their_5x5_window():
    D = depth_with_holes()
    expected = D.copy()
    for v, u in np.argwhere(D == 0):
        window = D[max(v - 2, 0) : v + 3, max(u - 2, 0) : u + 3]
        if (window > 0).any():
            expected[v, u] = window[window > 0].mean()
    assert expected[4, 4] == 0
    np.testing.assert_allclose(fill_zeros(D), expected, rtol=1e-5)


def test_bilateral_filter_is_equation_4_8_with_the_depth_in_the_sum():
    D, alpha, sigma_s, radius = depth_with_holes(), 0.012, 2.0, 3
    expected = np.zeros(D.shape)
    for v, u in np.argwhere(D > 0):
        total = W = 0.0
        for row in range(max(v - radius, 0), min(v + radius + 1, D.shape[0])):
            for column in range(max(u - radius, 0), min(u + radius + 1, D.shape[1])):
                if D[row, column] > 0:
                    w_s = np.exp(-((row - v) ** 2 + (column - u) ** 2) / (2 * sigma_s**2))
                    sigma_c = alpha * float(D[v, u]) ** 2
                    weight = w_s * np.exp(-((float(D[v, u]) - float(D[row, column])) ** 2) / (2 * sigma_c**2))
                    total, W = total + weight * D[row, column], W + weight
        expected[v, u] = total / W
    filtered = bilateral(D, alpha, sigma_s, radius)
    np.testing.assert_allclose(filtered, expected, atol=2e-5)
    assert np.abs(filtered - D)[D > 0].max() > 0.01, "as printed in the thesis the filter changes nothing"
