"""Algorithm 2 on an analytic scene, and its formulas against numerical derivatives and loops."""

import numpy as np
import pytest

from dudmap.core.geometry import se3
from dudmap.thesis.registration import Registration, chain, exponential, residuals, robust_weight, sobel
from dudmap.thesis_config import ThesisConfig
from textured_corner import CAMERA, corner, corner_map, level_of

CONFIG = ThesisConfig(levels=1, iterations=20, stop=1e-6)
STILL = np.eye(4)


@pytest.fixture(scope="module")
def volume():
    return corner_map()


def test_chain_is_the_derivative_of_a_function_of_the_moved_point():
    X, gradient, h = np.array([[0.4, -0.3, 2.1], [1.0, 0.2, 0.5]]), np.array([[0.3, 0.9, -0.2], [-1.1, 0.4, 0.7]]), 1e-6
    numerical = np.empty((2, 6))
    for k in range(6):
        xi = h * np.eye(6)[k]
        moved = [X @ exponential(s * xi)[:3, :3].T + exponential(s * xi)[:3, 3] for s in (1, -1)]
        numerical[:, k] = ((moved[0] - moved[1]) * gradient).sum(axis=1) / (2 * h)
    np.testing.assert_allclose(chain(gradient, X), numerical, atol=1e-9)


def test_robust_weights_are_equations_4_44_and_4_45():
    psi = np.array([-0.03, -0.01, 0.0, 0.005, 0.02])
    np.testing.assert_allclose(robust_weight(psi, "huber", 0.01), [1 / 3, 1, 1, 1, 0.5])
    np.testing.assert_allclose(robust_weight(psi, "tukey", 0.02), [0, 0.5625, 1, (1 - 1 / 16) ** 2, 0])


def test_sobel_gives_derivatives_of_a_ramp_per_pixel():
    ramp = (0.01 * np.arange(20)[None] + 0.03 * np.arange(15)[:, None]).astype(np.float32)
    x, y = sobel(ramp)
    np.testing.assert_allclose(x[1:-1, 1:-1], 0.01, atol=1e-6)
    np.testing.assert_allclose(y[1:-1, 1:-1], 0.03, atol=1e-6)


@pytest.mark.parametrize("upsilon", [0.0, 0.1325])
def test_right_hand_side_is_the_gradient_of_the_error(volume, upsilon):
    """J^T f of eq. 4.47 is half of the derivative of eq. 4.40 where all weights are 1."""
    level, T = level_of(corner()), se3.exp(np.array([0.004, -0.003, 0.002, 0.002, 0.001, -0.002]))
    registration = Registration(CONFIG.model_copy(update={"rho": 10.0, "upsilon": upsilon}))
    _, g = registration.normal_equations(volume, level, T, residuals(volume, level, T, CONFIG.d_max), None)
    h, numerical = 2e-4, np.empty(6)
    count = np.isfinite(residuals(volume, level, T, CONFIG.d_max).psi).sum()
    for k in range(6):
        xi = h * np.eye(6)[k]
        ahead, behind = (
            registration.error(residuals(volume, level, exponential(s * xi) @ T, 0.1), None) for s in (1, -1)
        )
        numerical[k] = (ahead - behind) / (2 * h) * count / 2
    assert g @ numerical > 0.95 * np.linalg.norm(g) * np.linalg.norm(numerical)


def test_damping_by_the_gramian_shortens_the_step_and_by_the_identity_turns_it():
    rng = np.random.default_rng(1)
    J = rng.standard_normal((40, 6))
    H, g = J.T @ J, rng.standard_normal(6)
    newton = -np.linalg.solve(H, g)
    np.testing.assert_allclose(Registration(CONFIG).step(H, g, 0.5), newton / 1.5, atol=1e-12)
    identity = Registration(CONFIG.model_copy(update={"damping": "identity"}))
    np.testing.assert_allclose(identity.step(H, g, 0.5), -np.linalg.solve(H + 0.5 * np.eye(6), g), atol=1e-12)


@pytest.mark.parametrize(
    "options", [{}, {"estimator": "tukey", "rho": 0.05}, {"damping": "identity"}, {"upsilon": 0.0}]
)
def test_pose_of_a_moved_camera_is_found(volume, options):
    true = se3.exp(np.array([0.012, -0.008, 0.01, 0.006, -0.009, 0.005]))
    level = level_of(corner(np.array([0.012, -0.008, 0.01, 0.006, -0.009, 0.005])))
    T, found = Registration(CONFIG.model_copy(update=options)).align(volume, [level], STILL)
    error = se3.log(se3.inverse(true) @ T)
    assert np.linalg.norm(error[:3]) < 0.004, "a quarter of the displacement; the map of one view is biased by 1 mm"
    assert np.linalg.norm(error[3:]) < 0.004
    assert np.nanmedian(np.abs(found.psi)) < 0.003


def test_dynamic_pixels_do_not_count(volume):
    """Pixels moved by 5 cm over a third of the image change nothing once they are labelled."""
    level = level_of(corner())
    level.depth[:, :30] -= np.float32(0.05)
    labels = np.zeros(CAMERA.shape, bool)
    labels[:, :30] = True
    free, _ = Registration(CONFIG).align(volume, [level], STILL)
    labelled, _ = Registration(CONFIG).align(volume, [level], STILL, labels)
    assert np.linalg.norm(se3.log(labelled)) < 0.004
    assert np.linalg.norm(se3.log(free)) > 0.04


def test_too_few_pixels_leave_the_pose_as_it_is(volume):
    level = level_of(corner())
    level.depth[:] = 0
    T, _ = Registration(CONFIG).align(volume, [level], STILL)
    np.testing.assert_array_equal(T, STILL)
