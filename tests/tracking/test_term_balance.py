import numpy as np
import pytest

from dudmap.config import Config
from dudmap.frames.observation import Level
from dudmap.geometry import se3
from dudmap.geometry.camera import Camera
from dudmap.kernels.parameters import SensorNoise, TruncationBand
from dudmap.mapping.volume import TsdfVolume
from dudmap.synthetic import sequence
from dudmap.tracking import term_balance
from dudmap.tracking.term_balance import Comparison, smooth_covariances, variance_components
from dudmap.tracking.tracker import Tracker

PARAMETERS = Tracker(Config().tracker, Config().sensor).parameters(
    TruncationBand(0.04, 0.04, 3.0, 0.3, SensorNoise(Config().sensor.sigma_base, Config().sensor.sigma_scale))
)
CAMERA = Camera(131.0, 131.0, 79.5, 59.5, 160, 120)


@pytest.fixture(scope="module")
def room():
    """Map of one exact image of a furnished room, and the image."""
    frame = sequence(scene="room", movers=(), frames=2, camera=CAMERA, noise="none", seed=3)[0]
    config = Config()
    volume = TsdfVolume(CAMERA, config.volume, config.sensor, config.preprocess.depth_max)
    for _ in range(4):
        volume.integrate(frame, np.eye(4))
    return volume, frame


def _level(frame, depth=None, intensity=None):
    grey = (frame.color.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)) / 255
    return Level(CAMERA, frame.depth if depth is None else depth, grey if intensity is None else intensity)


def _fields(rng, orders):
    """Random smooth fields: products of cosines of unit variance in total, by plain loops."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    out = np.zeros((CAMERA.height, CAMERA.width))
    for i in range(orders[0]):
        for j in range(orders[1]):
            gain = (2 if i else 1) * (2 if j else 1)
            wave = np.cos(np.pi * i * u / CAMERA.width) * np.cos(np.pi * j * v / CAMERA.height)
            out += rng.normal() * np.sqrt(gain) * wave
    return out / np.sqrt(orders[0] * orders[1])


def _registered(room, level, color_weight):
    """Pose error in camera axes of a level registered from the true pose, by one of the two terms."""
    volume, _ = room
    settings = Config().tracker.model_copy(update={"iterations": (30,), "widths": (160,), "color_weight": color_weight})
    tracker = Tracker(settings, Config().sensor)
    T = np.eye(4)
    volume.look_at(T)
    weights = np.ones_like(level.depth)
    for _ in range(30):
        system = tracker.linearize(volume, level, T, weights)
        if color_weight:
            distances = tracker.linearize(volume, level, T, weights, color_weight=0.0)
            H, b = system.H - distances.H, system.b - distances.b
        else:
            H, b = system.H, system.b
        T = se3.retract(T, -np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(6), b))
    return se3.log(T)


@pytest.mark.parametrize("term", ["depth", "color"])
def test_covariance_of_a_smooth_error_is_that_of_registrations_with_such_errors(room, term):
    _, frame = room
    rng = np.random.default_rng(4)
    weights = np.ones_like(frame.depth)
    P_d, P_c = smooth_covariances(_level(frame), weights, PARAMETERS, np.zeros(6), 0.0)
    errors = []
    level = _level(frame)
    at_truth = _registered(room, level, 0.0 if term == "depth" else 0.1)
    for _ in range(25):
        if term == "depth":
            factor = 1 + term_balance.DEPTH_ERROR * _fields(rng, term_balance.COSINES)
            moved = _level(frame, depth=np.asarray(frame.depth * factor, np.float32))
            errors.append(_registered(room, moved, 0.0) - at_truth)
        else:
            import cv2

            v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float32)
            x, y = 2 * (u + 0.5) / CAMERA.width - 1, 2 * (v + 0.5) / CAMERA.height - 1
            shift = term_balance.COLOR_SHIFT * CAMERA.width / 640
            a = rng.normal(size=(3, 2)) * shift
            du, dv = (a[0, k] + a[1, k] * x + a[2, k] * y for k in (0, 1))
            moved = cv2.remap(
                level.intensity,
                np.float32(u + du),
                np.float32(v + dv),
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
            errors.append(_registered(room, _level(frame, intensity=moved), 0.1) - at_truth)
    P = P_d if term == "depth" else P_c
    lengths = [error @ np.linalg.solve(P, error) / 6 for error in errors]
    assert 0.3 < np.mean(lengths) < 3


def test_variance_components_are_found_from_disagreements():
    rng = np.random.default_rng(0)
    true_d, true_c, comparisons = 4.0, 0.25, []
    for _ in range(200):
        A, B = rng.normal(size=(2, 6, 6)) * np.array([[[1, 1, 0.1, 0.1, 1, 1]], [[0.1, 1, 1, 1, 0.1, 1]]]).swapaxes(
            1, 2
        )
        P_d, P_c, N = A @ A.T, B @ B.T, 0.01 * np.eye(6)
        delta = rng.multivariate_normal(np.zeros(6), true_d * P_d + true_c * P_c + N)
        comparisons.append(Comparison(delta, P_d, P_c, N))
    found = variance_components(comparisons, iterations=50)
    assert np.allclose(np.sqrt(found), np.sqrt([true_d, true_c]), rtol=0.15)


def test_a_single_disagreement_hardly_moves_the_prior():
    nothing = Comparison(np.zeros(6), np.eye(6), np.eye(6), 0.01 * np.eye(6))
    s_d, s_c = variance_components([nothing], iterations=50)
    assert s_d == pytest.approx(s_c)
    assert 0.2 < s_d < 1


def test_covariances_have_the_weights_of_the_registration(room):
    """Distances weighted by the noise of the sensor: equally where it is the same at all depths."""
    level, static = _level(room[1]), np.ones(CAMERA.shape, np.float32)

    def covariance(noise, weighting):
        parameters = PARAMETERS._replace(
            band=PARAMETERS.band._replace(noise=noise), sigma_at_one_metre=sum(noise), noise_weighting=weighting
        )
        return smooth_covariances(level, static, parameters, np.zeros(6), 0.0)[0]

    equal = covariance(SensorNoise(0.003, 0.0), 1.0)
    np.testing.assert_allclose(covariance(SensorNoise(0.001, 0.002), 0.0), equal, rtol=1e-5)
    falling = covariance(SensorNoise(0.0, 0.003), 1.0)
    assert np.trace(np.abs(falling - equal)) > 0.1 * np.trace(equal)


def test_covariances_scale_with_speed_only_in_the_colour(room):
    _, frame = room
    weights = np.ones_like(frame.depth)
    still_d, still_c = smooth_covariances(_level(frame), weights, PARAMETERS, np.zeros(6), 0.01)
    velocity = np.array([0.1, 0, -0.2, 0, 1.0, 0])
    fast_d, fast_c = smooth_covariances(_level(frame), weights, PARAMETERS, velocity, 0.01)
    assert np.array_equal(still_d, fast_d)
    # colours late by 10 ms are those of a camera 10 ms further on, which the pose follows; the rest is rolling shutter
    rest = fast_c - still_c - np.outer(velocity, velocity) * 0.01**2
    assert np.linalg.eigvalsh(rest)[0] > -0.01 * np.trace(fast_c)  # the bound of unconstrained directions
    assert np.trace(rest) > 0
