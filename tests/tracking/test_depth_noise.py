"""The noise of a sensor, recovered from readings of four walls with known errors."""

import numpy as np
import pytest

from dudmap.config import SensorConfig, VolumeConfig
from dudmap.core.backends.cpu.backend import CpuBackend
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import Observation
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.tracking.depth_noise import LARGEST, STEPS, DepthNoise, _medians

CAMERA = Camera(80.0, 80.0, 39.5, 29.5, 80, 60)
SENSOR = SensorConfig()
GREY = np.full((60, 80, 3), 128, np.uint8)
EVERYWHERE = np.ones((60, 80), bool)


def walls() -> np.ndarray:
    """Depth of four frontal walls side by side, 1.2 to 4.2 metres away."""
    return np.broadcast_to(np.repeat(np.array([1.2, 2.2, 3.2, 4.2], np.float32), 20), (60, 80)).copy()


@pytest.fixture(scope="module")
def volume() -> TsdfVolume:
    made = TsdfVolume(CAMERA, VolumeConfig(voxel_size=0.02), SENSOR, depth_max=6.0)
    for _ in range(20):
        made.integrate(Frame(0.0, walls(), GREY), np.eye(4))
    return made


def learnt(volume, base: float, scale: float, frames: int, spoil=None) -> DepthNoise:
    """Estimate after frames whose readings have normal errors of standard deviation base + scale z^2."""
    found, rng, exact = DepthNoise(SENSOR, 6.0), np.random.default_rng(5), walls()
    for _ in range(frames):
        depth = exact + ((base + scale * exact**2) * rng.standard_normal(exact.shape)).astype(np.float32)
        if spoil is not None:
            spoil(depth)
        gray = np.zeros_like(depth)
        found.update(volume, Observation(0.0, CAMERA, depth, gray, GREY, CpuBackend()), np.eye(4), EVERYWHERE)
    return found


@pytest.mark.parametrize(("base", "scale"), [(0.001, 0.0019), (0.0005, 0.0006), (0.004, 0.002)])
def test_the_noise_of_simulated_readings_is_recovered(volume, base, scale):
    found = learnt(volume, base, scale, 60).fitted()
    for z in (1.2, 2.2, 4.2):
        assert found.base + found.scale * z**2 == pytest.approx(base + scale * z**2, rel=0.12)


def test_a_few_readings_leave_it_as_configured(volume):
    assert DepthNoise(SENSOR, 6.0).fitted() == pytest.approx((SENSOR.sigma_base, SENSOR.sigma_scale), rel=1e-3)

    def spoiled(depth: np.ndarray) -> None:
        depth[2:] = 0

    found = learnt(volume, 0.0005, 0.0006, 1, spoiled).fitted()
    assert found.scale == pytest.approx(SENSOR.sigma_scale, rel=0.2)


def test_an_exact_sensor_is_found_to_be_exact(volume):
    found = learnt(volume, 0.0, 0.0, 200).fitted()
    assert found.base + found.scale * 9 < 0.25 * SENSOR.sigma(3.0)


def test_what_moves_does_not_count(volume):
    """A tenth of the view stands in front of the walls, unmasked."""

    def spoiled(depth: np.ndarray) -> None:
        depth[:6] -= np.float32(0.05)

    found = learnt(volume, 0.001, 0.0019, 60, spoiled).fitted()
    assert found.base + found.scale * 9 == pytest.approx(SENSOR.sigma(3.0), rel=0.2)


def test_medians_of_histograms():
    rng = np.random.default_rng(1)
    values = np.abs(rng.standard_normal((3, 5000))) * np.array([[0.2], [1.0], [1.5]])
    edges = np.linspace(0, LARGEST, STEPS + 1)
    counts = np.stack([np.histogram(row, edges)[0] for row in values]).astype(float)
    expected = [np.median(row[row < LARGEST]) for row in values]
    assert _medians(counts) * LARGEST / STEPS == pytest.approx(expected, abs=LARGEST / STEPS)
    assert _medians(np.zeros((2, STEPS))).tolist() == [0, 0]
