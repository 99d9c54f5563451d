"""Sensors: noise models of depth and colour, and five common RGB-D cameras.

An unknown name raises a ``ConfigError``.
"""

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
        nearest, fade, farthest: Range, metres; the share of missing depth grows between fade and farthest.
        grazing: Cosine of the angle of incidence below which depth is lost.
        edge_loss: Share of depth lost at a depth edge: on its far side, for time of flight on both.
        correlation: Standard deviation of the Gaussian that correlates neighbouring errors, pixels.
        color_noise: Standard deviation of the colour noise, grey values.
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
    """Sensor with noise in the disparity ``d = fx b / z``, so that sigma_z = sigma z^2 / (fx b) (thesis eq. 3.91).

    Attributes:
        baseline: Distance from the camera to the projector or second camera on its right, metres.
        depth_noise: Standard deviation of the depth at 1 m including the quantisation by ``step``, metres.
        step: Quantisation step of the disparity, pixels.
        fatten: Width by which near surfaces are dilated (foreground fattening of window matching), pixels.
    """

    baseline: float
    depth_noise: float
    step: float
    fatten: int

    def row(self, focal: float) -> NDArray[np.float64]:
        """Parameters in the order of the kernel, for a focal length in pixels.

        The variance step^2 / 12 of the quantisation is part of ``depth_noise``.
        """
        total = self.depth_noise * focal * self.baseline
        sigma = np.sqrt(max(total**2 - self.step**2 / 12, (0.3 * total) ** 2))
        numbers = (self.baseline, sigma, self.step, self.lateral, self.nearest, self.fade, self.farthest)
        return np.array([*numbers, self.fatten, self.grazing, self.edge_loss, self.speckle])


@dataclass(frozen=True, kw_only=True)
class TimeOfFlightModel(NoiseModel):
    """Sensor that measures the range, so that its noise does not follow z^2.

    The standard deviation of the depth is noise[0] + noise[1] z + noise[2] z^2 + slant z^1.5 (theta / (pi/2 - theta))^2
    in metres. theta is the angle of incidence (form of Fankhauser et al. 2015).

    Attributes:
        noise: Coefficients of 1, z and z^2, metres.
        slant: Coefficient of the term that grows with the angle of incidence, metres.
        native_width: Width in pixels of the measurement, from which wider images are interpolated. 0: any.
    """

    noise: tuple[float, float, float]
    slant: float
    native_width: int = 0

    def row(self) -> NDArray[np.float64]:
        """Parameters in the order of the kernel."""
        numbers = (*self.noise, self.slant, self.lateral, self.nearest, self.fade, self.farthest)
        return np.array([*numbers, self.grazing, self.edge_loss, self.speckle])


def _model(row: dict[str, Any]) -> SensorModel | TimeOfFlightModel | None:
    return None if not row else TimeOfFlightModel(**row) if "noise" in row else SensorModel(**row)


SENSORS = {name: _model(row) for name, row in tables("synthetic/sensors.toml")["noise"].items()}
"""Noise models by name; None is an ideal sensor. ``sensors.toml`` has the values and their sources."""


class Sensor:
    """Sensor, one of ``SENSORS``, that adds noise to ideal images; equal seeds and frame numbers give equal errors."""

    def __init__(self, name: str, seed: int) -> None:
        self.model = find(name, SENSORS, "noise model")
        self._seed = seed

    def measure(self, rendering: Rendering, focal: float, index: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Depth (H, W) float32 in metres, 0 = missing, and colour (H, W, 3) uint8 of frame ``index``."""
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
    """Depth (H, W) of a time-of-flight sensor at its native resolution, interpolated where valid."""
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
    """Periodic correlated noise (S, S) of unit variance, and 65536 samples of the unit Gaussian."""
    rng = np.random.default_rng(7)
    frequency = np.fft.fftfreq(NOISE_SIZE)
    gain = np.exp(-2 * (np.pi * correlation) ** 2 * (frequency[:, None] ** 2 + frequency[None, :] ** 2))
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal((NOISE_SIZE, NOISE_SIZE))) * gain).real
    return (field / field.std()).astype(np.float32), rng.standard_normal(65536).astype(np.float32)


@dataclass(frozen=True)
class CameraModel:
    """One camera as its driver delivers it: colour registered to depth.

    ``faults`` holds only the errors that registration leaves; add ``color_translation`` and the like for unregistered
    streams. ``field_of_view`` is the horizontal one of a 4:3 depth image, degrees. ``motion_blur`` is the exposure time
    of the colour as a share of the frame interval.
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
