"""Noise models of depth and colour sensors."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import ConfigError
from dudmap.synthetic.kernels import depth_noise as kernels
from dudmap.synthetic.render import Rendering, over_rows

NOISE_SIZE = 1024


@dataclass(frozen=True)
class SensorModel:
    """Sensor with noise in the disparity ``d = fx b / z``, so that sigma_z = sigma z^2 / (fx b) (thesis eq. 3.91).

    Attributes:
        baseline: Distance from the camera to the projector or second camera on its right, metres.
        depth_noise: Standard deviation of the depth at 1 m including the quantisation by ``step``, metres.
        step: Quantisation step of the disparity, pixels.
        lateral: Standard deviation of the lateral noise, pixels.
        nearest, fade, farthest: Range, metres; the share of missing readings grows between fade and farthest.
        fatten: Width by which near surfaces are dilated (foreground fattening of window matching), pixels.
        grazing: Cosine of the angle of incidence below which readings are lost.
        edge_loss: Share of readings lost on the far side of a depth edge.
        speckle: Share of readings lost at random.
        correlation: Standard deviation of the Gaussian that correlates neighbouring errors, pixels.
        color_noise: Standard deviation of the colour noise, grey values.
    """

    baseline: float
    depth_noise: float
    step: float
    lateral: float
    nearest: float
    fade: float
    farthest: float
    fatten: int
    grazing: float
    edge_loss: float
    speckle: float
    correlation: float
    color_noise: float

    def row(self, focal: float) -> NDArray[np.float64]:
        """Parameters in the order of the kernel, for a focal length in pixels.

        The variance step^2 / 12 of the quantisation is part of ``depth_noise``.
        """
        total = self.depth_noise * focal * self.baseline
        sigma = np.sqrt(max(total**2 - self.step**2 / 12, (0.3 * total) ** 2))
        numbers = (self.baseline, sigma, self.step, self.lateral, self.nearest, self.fade, self.farthest)
        return np.array([*numbers, self.fatten, self.grazing, self.edge_loss, self.speckle])


SENSORS: dict[str, SensorModel | None] = {
    "kinect": SensorModel(0.075, 1.425e-3, 1 / 8, 0.35, 0.5, 4.5, 7.0, 0, 0.20, 0.35, 0.002, 1.2, 2.0),
    "realsense": SensorModel(0.050, 1.9e-3, 1 / 32, 0.6, 0.3, 5.0, 9.0, 2, 0.12, 0.15, 0.004, 2.5, 2.5),
    "none": None,
}


class Sensor:
    """Simulated sensor that adds noise to ideal images; equal seeds and frame numbers give equal errors.

    Args:
        name: One of ``SENSORS``.
        seed: Seed of the noise.

    Raises:
        ConfigError: The name is unknown.
    """

    def __init__(self, name: str, seed: int) -> None:
        if name not in SENSORS:
            raise ConfigError(f"unknown noise model {name!r}; known models: {', '.join(SENSORS)}")
        self.model = SENSORS[name]
        self._seed = seed

    def measure(self, rendering: Rendering, focal: float, index: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Depth (H, W) float32 in metres, 0 = no reading, and colour (H, W, 3) uint8 of frame ``index``."""
        exact, color, cosine = rendering.depth, rendering.color, rendering.cosine
        assert color is not None
        assert cosine is not None
        if self.model is None:
            return exact, np.clip(np.rint(color), 0, 255).astype(np.uint8)
        rng = np.random.default_rng([self._seed, 3, index])
        offsets = rng.integers(0, NOISE_SIZE, (4, 2))
        key = np.uint64(rng.integers(0, 2**63))
        smooth, table = _noise(self.model.correlation)
        depth = np.empty_like(exact)
        out = np.empty(color.shape, dtype=np.uint8)
        rows = len(exact)
        over_rows(rows, kernels.measure_depth, exact, cosine, smooth, offsets, key, focal, self.model.row(focal), depth)
        over_rows(rows, kernels.measure_color, color, table, key, np.float32(self.model.color_noise), out)
        return depth, out


@lru_cache(maxsize=2)
def _noise(correlation: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Periodic correlated noise (S, S) of unit variance, and 65536 samples of the unit Gaussian."""
    rng = np.random.default_rng(7)
    frequency = np.fft.fftfreq(NOISE_SIZE)
    gain = np.exp(-2 * (np.pi * correlation) ** 2 * (frequency[:, None] ** 2 + frequency[None, :] ** 2))
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal((NOISE_SIZE, NOISE_SIZE))) * gain).real
    return (field / field.std()).astype(np.float32), rng.standard_normal(65536).astype(np.float32)
