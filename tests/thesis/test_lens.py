"""The distortion of section 3.3 against OpenCV's model."""

import cv2
import numpy as np

from dudmap.core.geometry.camera import Camera
from dudmap.thesis.lens import Lens, distort

EIGHT = (0.26, -0.95, -0.005, 0.003, 1.16, 0.2, -0.3, 0.1)
"""k1 k2 p1 p2 k3 k4 k5 k6."""


def test_equation_3_87_is_the_rational_model():
    X = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 2))
    k = np.array(EIGHT)
    points = np.column_stack([X, np.ones(len(X))])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), k)
    np.testing.assert_allclose(distort(X, k[[0, 1, 4, 5, 6, 7]], k[2:4]), expected[:, 0], atol=1e-12)


def test_without_the_denominator_it_is_equation_3_88():
    x, y = 0.3, -0.2
    r2, (k1, k2, k3), (p1, p2) = x * x + y * y, (0.1, -0.2, 0.05), (0.01, -0.02)
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    expected = [
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
    ]
    found = distort(np.array([x, y]), np.array([k1, k2, k3, 0, 0, 0]), np.array([p1, p2]))
    np.testing.assert_allclose(found, expected, atol=1e-15)


def test_a_mask_of_a_straight_image_returns_to_the_recorded_one():
    lens = Lens(Camera(60, 62, 39.5, 29.5, 80, 60, distortion=(-0.3, 0.1, 0.002, -0.001, 0.01)))
    recorded = np.zeros((60, 80), bool)
    recorded[10:50, 12:70] = True
    straight = lens.undistort(recorded.astype(np.uint8), nearest=True) > 0
    assert (straight != recorded).sum() > 100
    returned = lens.distorted(straight)
    assert (returned != recorded).sum() < 0.05 * recorded.sum()
