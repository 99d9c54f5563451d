"""Noise of the depth readings, estimated from the distances of static readings to the map."""

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SensorConfig
from dudmap.core.backends.parameters import SensorNoise
from dudmap.core.frames.observation import Observation
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume

SAMPLED_WIDTH = 80
"""Width of the grid of sampled readings: neighbours eight pixels apart (of 640) are independent after the filter."""
CORRELATED_READINGS = 16.0
"""Sampled readings that count as one: those of one surface share the error of the pose and of the map there."""
BIN = 0.5
"""Width of a depth interval, metres."""
STEPS, LARGEST = 200, 4.0
"""Number of histogram steps, and the largest distance in them, standard deviations of the configured noise. Beyond are
edges and moving objects, which the median tolerates."""
PRIOR_READINGS = 20.0
"""Weight of the configured noise in each depth interval, independent readings."""
INTERVAL = 10
"""Every so many tracked frames are compared: the readings of a surface err alike from frame to frame."""
MEMORY = 30.0
"""Compared frames after which the weight of one has fallen to 1/e."""
SMALLEST = 1e-6
"""Smallest base (m) and scale (1/m): a tenth of a step of the distances that a map stores."""
MEDIAN_OF_NORMAL = 0.6745
"""Median of |x| of a standard normal x."""


class DepthNoise:
    """Estimates sigma(z) = base + scale z^2 of a sensor (thesis eq. 3.91) while it is used.

    A static reading lies off the map by its own error and by that of the map, an average of n readings, so that the
    variance of the distance is sigma^2 (1 + 1 / n). In each interval of depth the standard deviation s is the median
    absolute distance over 0.6745. It is combined with the configured sigma_0 as with a scaled inverse chi-square prior
    of PRIOR_READINGS degrees of freedom,

        v = (n_0 sigma_0^2 + n s^2) / (n_0 + n),

    and base and scale are fitted to the sqrt(v) of all intervals by least squares of the logarithms. What the sensor
    and the poses get wrong systematically is part of the result: it is how far a static reading lies from the map,
    after the filter of the depth image.

    Args:
        sensor: The configured noise.
        depth_max: Farthest reading, metres.
    """

    def __init__(self, sensor: SensorConfig, depth_max: float) -> None:
        self.sensor = sensor
        bins = int(np.ceil(depth_max / BIN))
        self._counts = np.zeros((bins, STEPS))
        self._depths = BIN * (np.arange(bins) + 0.5)

    def update(
        self,
        volume: TsdfVolume,
        observation: Observation,
        T_world_camera: NDArray[np.float64],
        static: NDArray[np.bool_],
    ) -> None:
        """Add the readings of a frame that is not yet part of the map.

        Args:
            volume: The map.
            observation: The frame.
            T_world_camera: (4, 4).
            static: (H, W) bool, static pixels.
        """
        stride = max(1, round(observation.camera.width / SAMPLED_WIDTH))
        rows, columns = (slice(stride // 2, None, stride),) * 2
        depth = np.ascontiguousarray(np.where(static[rows, columns], observation.depth[rows, columns], 0), np.float32)
        intensity = np.zeros_like(depth)
        volume.look_at(T_world_camera)
        distance = volume.sample(depth, intensity, _strided(observation.camera, stride), T_world_camera).distance
        valid = np.isfinite(distance) & (depth > 0)
        z = depth[valid].astype(np.float64)
        readings = min(max(volume.num_integrated, 1), volume.config.max_readings)
        ratio = np.abs(distance[valid]) / self.sensor.sigma(z) / np.sqrt(1 + 1 / readings)
        row = np.minimum((z / BIN).astype(int), len(self._depths) - 1)
        step = (ratio * (STEPS / LARGEST)).astype(int)
        inside = step < STEPS
        counts = np.bincount(row[inside] * STEPS + step[inside], minlength=self._counts.size)
        self._counts += counts.reshape(self._counts.shape) - self._counts / MEMORY

    def fitted(self) -> SensorNoise:
        """Base in metres and scale in 1/m."""
        prior = self.sensor.sigma(self._depths)
        count = self._counts.sum(axis=1) / CORRELATED_READINGS
        measured = prior * _medians(self._counts) * (LARGEST / STEPS) / MEDIAN_OF_NORMAL
        weight = PRIOR_READINGS + count
        sigma = np.sqrt((PRIOR_READINGS * prior**2 + count * measured**2) / weight)
        return _fit(self._depths, sigma, weight)


def _strided(camera: Camera, stride: int) -> Camera:
    """Intrinsics of the image of every ``stride``-th pixel from ``stride // 2`` on; its size is not used."""
    first = stride // 2
    return Camera(
        camera.fx / stride, camera.fy / stride, (camera.cx - first) / stride, (camera.cy - first) / stride,
        camera.width, camera.height,
    )  # fmt: skip


def _medians(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Medians (bins,) in steps of the histograms ``counts`` (bins, STEPS), linear within a step; 0 where empty."""
    total = counts.cumsum(axis=1)
    half = total[:, -1:] / 2
    step = (total < half).sum(axis=1)
    step = np.minimum(step, counts.shape[1] - 1)
    rows = np.arange(len(counts))
    within = counts[rows, step]
    before = total[rows, step] - within
    return np.where(within > 0, step + (half[:, 0] - before) / np.maximum(within, 1e-12), 0.0)


def _fit(z: NDArray[np.floating], sigma: NDArray[np.floating], weight: NDArray[np.floating]) -> SensorNoise:
    """base, scale >= 0 that minimise sum weight log^2((base + scale z^2) / sigma)."""
    from scipy.optimize import least_squares

    start = np.maximum([sigma.min(), sigma[-1] / z[-1] ** 2], SMALLEST)
    fit = least_squares(
        lambda x: np.sqrt(weight) * np.log((x[0] + x[1] * z**2) / np.maximum(sigma, SMALLEST)),
        start, bounds=(SMALLEST, np.inf), x_scale=start,
    )  # fmt: skip
    return SensorNoise(float(fit.x[0]), float(fit.x[1]))
