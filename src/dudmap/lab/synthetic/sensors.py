"""Sensors: noise models, and five common cameras. Unknown names raise a ``ConfigError``."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.camera import Camera
from dudmap.lab.data import find, tables
from dudmap.lab.synthetic.faults import SensorFaults
from dudmap.lab.synthetic.kernels import depth_noise as kernels
from dudmap.lab.synthetic.render import Rendering, over_rows

NOISE_SIZE = 1024


@dataclass(frozen=True, kw_only=True)
class NoiseModel:
    """Parameters of all noise models.

    Attributes:
        lateral: Standard deviation of the lateral noise, pixels.
        nearest, fade, farthest: Range, metres; missing depth grows between fade and farthest.
        grazing: Cosine of incidence below which depth is lost.
        edge_loss: Share lost at a depth edge: far side, time of flight both.
        correlation: Gaussian of correlated errors, pixels.
        color_noise: Standard deviation, grey values.
    """

    lateral: float
    nearest: float
    fade: float
    farthest: float
    grazing: float
    edge_loss: float
    speckle: float
    correlation: float
    color_noise: float


@dataclass(frozen=True, kw_only=True)
class SensorModel(NoiseModel):
    """Noise in the disparity ``d = fx b / z``: sigma_z = sigma z^2 / (fx b) (thesis eq. 3.91).

    Attributes:
        baseline: To projector or second camera, metres.
        depth_noise: Standard deviation at 1 m with quantisation by ``step``, metres.
        step: Quantisation of disparity, pixels.
        fatten: Dilation of near surfaces (window matching), pixels.
    """

    baseline: float
    depth_noise: float
    step: float
    fatten: int

    def row(self, focal: float) -> NDArray[np.float64]:
        """Parameters for the kernel, for a focal length in pixels."""
        total = self.depth_noise * focal * self.baseline
        sigma = np.sqrt(max(total**2 - self.step**2 / 12, (0.3 * total) ** 2))
        numbers = (self.baseline, sigma, self.step, self.lateral, self.nearest, self.fade, self.farthest)
        return np.array([*numbers, self.fatten, self.grazing, self.edge_loss, self.speckle])


@dataclass(frozen=True, kw_only=True)
class TimeOfFlightModel(NoiseModel):
    """Noise of the measured range:

    noise[0] + noise[1] z + noise[2] z^2 + slant z^1.5 (theta / (pi/2 - theta))^2, metres, at the angle of incidence
    theta (form of Fankhauser et al. 2015).

    Attributes:
        noise: Of 1, z and z^2, metres.
        slant: Metres.
        native_width: Measured pixels, interpolated to wider images; 0: any.
    """

    noise: tuple[float, float, float]
    slant: float
    native_width: int = 0

    def row(self) -> NDArray[np.float64]:
        """Parameters for the kernel."""
        numbers = (*self.noise, self.slant, self.lateral, self.nearest, self.fade, self.farthest)
        return np.array([*numbers, self.grazing, self.edge_loss, self.speckle])


def _model(row: dict[str, Any]) -> SensorModel | TimeOfFlightModel | None:
    return None if not row else TimeOfFlightModel(**row) if "noise" in row else SensorModel(**row)


SENSORS = {name: _model(row) for name, row in tables("synthetic/sensors.toml")["noise"].items()}
"""Noise models by name; None is ideal; ``sensors.toml`` has values and sources."""


class Sensor:
    """One of ``SENSORS`` on ideal images; equal seeds and frame numbers give equal errors."""

    def __init__(self, name: str, seed: int) -> None:
        self.model = find(name, SENSORS, "noise model")
        self._seed = seed

    def measure(self, rendering: Rendering, focal: float, index: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Depth (H, W) float32, metres, 0 = missing, and colour (H, W, 3) uint8 of frame ``index``."""
        exact, color, cosine = rendering.depth, rendering.color, rendering.cosine
        assert color is not None
        assert cosine is not None
        if self.model is None:
            return exact, np.clip(np.rint(color), 0, 255).astype(np.uint8)
        rng = np.random.default_rng([self._seed, 3, index])
        offsets = rng.integers(0, NOISE_SIZE, (4, 2))
        key = np.uint64(rng.integers(0, 2**63))
        smooth, table = _noise(self.model.correlation)
        out = np.empty(color.shape, dtype=np.uint8)
        over_rows(len(color), kernels.measure_color, color, table, key, np.float32(self.model.color_noise), out)
        if isinstance(self.model, TimeOfFlightModel):
            return _measured_range(self.model, exact, cosine, (smooth, offsets, key)), out
        depth = np.empty_like(exact)
        model = self.model.row(focal)
        over_rows(len(exact), kernels.measure_depth, exact, cosine, smooth, offsets, key, focal, model, depth)
        return depth, out


def _measured_range(
    model: TimeOfFlightModel,
    exact: NDArray[np.float32],
    cosine: NDArray[np.float32],
    noise: tuple[NDArray[np.float32], NDArray[np.int64], np.uint64],
) -> NDArray[np.float32]:
    height, width = exact.shape
    if not 0 < model.native_width < width:
        depth = np.empty_like(exact)
        over_rows(height, kernels.measure_range, exact, cosine, *noise, model.row(), depth)
        return depth
    size = (model.native_width, round(height * model.native_width / width))
    small, facing = (cv2.resize(image, size, interpolation=cv2.INTER_NEAREST_EXACT) for image in (exact, cosine))
    depth = np.empty_like(small)
    over_rows(size[1], kernels.measure_range, small, facing, *noise, model.row(), depth)
    valid = cv2.resize((depth > 0).astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    total = cv2.resize(depth, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(valid > 0.5, total / np.maximum(valid, 0.5), 0).astype(np.float32)


@lru_cache(maxsize=2)
def _noise(correlation: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    rng = np.random.default_rng(7)
    frequency = np.fft.fftfreq(NOISE_SIZE)
    gain = np.exp(-2 * (np.pi * correlation) ** 2 * (frequency[:, None] ** 2 + frequency[None, :] ** 2))
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal((NOISE_SIZE, NOISE_SIZE))) * gain).real
    return (field / field.std()).astype(np.float32), rng.standard_normal(65536).astype(np.float32)


@dataclass(frozen=True)
class CameraModel:
    """One camera as its driver delivers it: colour registered to depth.

    ``faults``: only errors that registration leaves. ``field_of_view``: horizontal, of a 4:3 depth image, degrees.
    ``motion_blur``: exposure time of the colour, share of the frame interval.
    """

    noise: str
    field_of_view: float
    motion_blur: float
    faults: SensorFaults

    def camera(self, width: int, height: int) -> Camera:
        """Intrinsics of an image of this camera's view, with square pixels."""
        focal = width / 2 / np.tan(np.radians(self.field_of_view / 2))
        return Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height, depth_scale=5000.0)


CAMERAS: dict[str, CameraModel] = {
    name: CameraModel(**row | {"faults": SensorFaults(**row["faults"])})
    for name, row in tables("synthetic/sensors.toml")["cameras"].items()
}
