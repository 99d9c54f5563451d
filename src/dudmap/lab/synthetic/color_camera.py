"""Colour camera of a synthetic sensor, and systematic errors of its depth."""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.camera import Camera
from dudmap.errors import FrameError
from dudmap.lab.synthetic.faults import SensorFaults

Image = NDArray[np.float32]
TARGET_LEVEL = 110.0
"""Mean grey value of automatic exposure; assumed."""
LARGEST_GAIN = 4.0
"""Range of the exposure, factor up and down: assumed."""
WHITE_BALANCE_PERIOD = 8.0
"""Period of white balance drift, seconds; assumed."""


class ColorCamera:
    """Colour camera beside a depth camera, with true intrinsics ``camera``.

    A row is exposed for ``exposure_time`` (0: no blur), seconds.
    """

    def __init__(self, faults: SensorFaults, depth_camera: Camera, exposure_time: float, frame_interval: float) -> None:
        self.camera = faults.color_camera(depth_camera)
        self._faults = faults
        # Moments of the exposure: three for short ones, five for half the frame interval or more.
        count = int(np.clip(round(10 * exposure_time / frame_interval), 3, 5)) if exposure_time > 0 else 1
        self._moments = (np.arange(count) - (count - 1) / 2) / count * exposure_time
        self._step = exposure_time / count

    def view(self, t: float, render: Callable[[float, Camera], Image]) -> Image:
        """Light on the sensor (H, W, 3), 0..255, in the frame at ``t``.

        Args:
            t: Seconds.
            render: Ideal image at a time in seconds.
        """
        margin = self._lens.margin if self.camera.distortion else 0
        height, width = self.camera.height + 2 * margin, self.camera.width + 2 * margin
        wide = replace(
            self.camera, cx=self.camera.cx + margin, cy=self.camera.cy + margin, width=width, height=height,
            distortion=(),
        )  # fmt: skip
        color = np.zeros((height, width, 3), dtype=np.float32)
        for first, last, offset in self._faults.row_bands(self.camera.height, margin, self._step):
            low, high = max(first - 1, 0), min(last + 1, height)  # pixels at a border use their neighbours
            band = replace(wide, cy=wide.cy - low, height=high - low)
            for moment in self._moments:
                seen = render(t + offset + moment, band)
                color[first:last] += seen[first - low : last - low] / np.float32(len(self._moments))
        return self._lens.distort(color) if margin else color

    def exposed(self, color: Image, t: float, gain: float) -> Image:
        """Image (H, W, 3) after exposure ``gain``, white balance at ``t``, vignetting."""
        if self._faults.auto_exposure:
            color = color * np.float32(gain)
        if self._faults.white_balance_drift:
            color = color * white_balance(self._faults, t)
        if self._faults.vignetting:
            color = color * self._vignette
        return color

    @cached_property
    def _lens(self) -> "Lens":
        return Lens(self.camera)

    @cached_property
    def _vignette(self) -> Image:
        v, u = (np.asarray(axis) for axis in np.indices(self.camera.shape, dtype=np.float32))
        middle_u, middle_v = (self.camera.width - 1) / 2, (self.camera.height - 1) / 2
        squared = ((u - middle_u) ** 2 + (v - middle_v) ** 2) / (middle_u**2 + middle_v**2)
        return (1 - self._faults.vignetting * squared)[..., None].astype(np.float32)


def exposure_gains(levels: NDArray[np.float64], times: NDArray[np.float64], lag: float) -> NDArray[np.float64]:
    """Factors (N,) of an automatic exposure with a lag in seconds, from mean grey values (N,) at factor 1.

    Each frame moves by 1 - exp(-dt / lag), in the logarithm, towards ``TARGET_LEVEL`` for the previous frame; the first
    is settled.
    """
    wanted = np.clip(np.log(TARGET_LEVEL / np.maximum(levels, 1.0)), -np.log(LARGEST_GAIN), np.log(LARGEST_GAIN))
    gains = np.empty(len(times))
    gains[0] = wanted[0]
    for k in range(1, len(times)):
        gains[k] = gains[k - 1] + (1 - np.exp((times[k - 1] - times[k]) / lag)) * (wanted[k - 1] - gains[k - 1])
    return np.exp(gains)


def white_balance(faults: SensorFaults, t: float) -> NDArray[np.float32]:
    """Factors (3,) on red, green and blue at time ``t`` in seconds."""
    swing = faults.white_balance_drift * np.sin(2 * np.pi * t / WHITE_BALANCE_PERIOD)
    return np.array([1 + swing, 1, 1 - swing], dtype=np.float32)


class Lens:
    """Lens on an ideal image with ``margin`` more pixels on every side."""

    def __init__(self, camera: Camera) -> None:
        rows, columns = np.indices(camera.shape, dtype=np.float64)
        pixels = np.stack([columns, rows], axis=-1)
        ideal = cv2.undistortPoints(pixels.reshape(-1, 1, 2), camera.K, np.array(camera.distortion), P=camera.K)
        ideal = ideal.reshape(pixels.shape)
        self.margin = int(np.ceil(np.abs(ideal - pixels).max())) + 3
        self._at = (ideal + self.margin).astype(np.float32)

    def distort(self, wide: NDArray[np.float32]) -> NDArray[np.float32]:
        """Distorted image (H, W, 3) of an ideal one (H + 2 margin, W + 2 margin, 3)."""
        return np.asarray(cv2.remap(wide, self._at, np.empty(0), cv2.INTER_CUBIC), dtype=np.float32)


def compressed(color: NDArray[np.uint8], quality: float) -> NDArray[np.uint8]:
    """Image (H, W, 3) after JPEG."""
    done, code = cv2.imencode(".jpg", color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, round(quality)])
    if not done:
        raise FrameError("the colour image could not be compressed as JPEG")
    image = cv2.imdecode(code, cv2.IMREAD_COLOR)
    assert image is not None
    return np.ascontiguousarray(image[..., ::-1]).astype(np.uint8, copy=False)


BANDS = 8
"""Vertical bands, assumed."""
MODES = 6
"""Waves of the smooth distortion."""
EDGE = (0.04, 0.02)
"""Depth edge: difference above EDGE[0] z + EDGE[1], metres."""


class DepthFaults:
    """Systematic depth errors of one sensor, by seed."""

    def __init__(self, faults: SensorFaults, camera: Camera, seed: int) -> None:
        self._faults, self._camera, self._seed = faults, camera, seed
        rng = np.random.default_rng([seed, 6])
        bands = rng.standard_normal(BANDS)
        bands -= bands.mean()
        self.bands = faults.depth_bands * bands / np.sqrt(np.mean(bands**2))
        waves = rng.uniform(-2.0, 2.0, (MODES, 2))  # half periods over the width and height of the image
        phases, turns = rng.uniform(0, 2 * np.pi, MODES), rng.uniform(-0.6, 0.6, MODES)  # rad, rad/m
        sizes = rng.uniform(0.5, 1.0, MODES)
        sizes *= faults.depth_distortion / np.sqrt(0.5 * np.sum(sizes**2))
        self.modes = np.column_stack([sizes, waves, phases, turns])

    def __bool__(self) -> bool:
        f = self._faults
        smooth = f.depth_scale_error or f.depth_offset or f.depth_bands or f.depth_distortion
        return bool(smooth or f.flying_pixels)

    def truth(self) -> dict[str, Any]:
        """The patterns and their formula."""
        return {
            "depth_model": "z1 = z (1 + depth_scale_error + z/2 sum_k size_k cos(pi (wave_u_k u / W + wave_v_k v / H) "
            "+ phase_k + turn_k z)) + depth_offset; reading = 1 / (1 / z1 + band(u)), band(u) = bands[int(u n / W)]; "
            "z is the true depth plus the error of flying pixels",
            "depth_distortion_columns": ["size", "wave_u", "wave_v", "phase", "turn_per_m"],
            "depth_distortion_modes": self.modes.tolist(),
            "depth_bands_per_m": self.bands.tolist(),
        }

    def multiplier(self, u: NDArray[Any], v: NDArray[Any], z: NDArray[Any]) -> NDArray[np.float64]:
        """Factor of scale error and distortion at pixels u, v and depths z, metres."""
        total = np.zeros(np.broadcast(u, v, z).shape)
        if self._faults.depth_distortion:
            width, height = self._camera.width, self._camera.height
            for size, wave_u, wave_v, phase, turn in self.modes:
                total += size * np.cos(np.pi * (wave_u * u / width + wave_v * v / height) + phase + turn * z)
        return 1.0 + self._faults.depth_scale_error + 0.5 * z * total

    def apply(self, exact: NDArray[np.float32], index: int) -> NDArray[np.float32]:
        """Noise-free measurement (H, W) of true depth, metres; 0 stays 0."""
        faults, depth = self._faults, exact
        if faults.flying_pixels:
            depth = with_flying_pixels(depth, faults.flying_pixels, np.random.default_rng([self._seed, 7, index]))
        v, u = np.arange(depth.shape[0])[:, None], np.arange(depth.shape[1])
        z = depth.astype(np.float64)
        z = z * self.multiplier(u, v, z) + faults.depth_offset
        if faults.depth_bands:
            z = 1.0 / (1.0 / np.maximum(z, 1e-3) + self.bands[(u * BANDS) // self._camera.width])
        return np.where((depth > 0) & (z > 0), z, 0).astype(np.float32)


def with_flying_pixels(depth: NDArray[np.float32], share: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Depth (H, W) with ``share`` of edge pixels between both surfaces."""
    valid = np.where(depth > 0, depth, np.nan)
    padded = np.pad(valid, 1, constant_values=np.nan)
    around = np.stack([padded[1:-1, :-2], padded[1:-1, 2:], padded[:-2, 1:-1], padded[2:, 1:-1]])
    gaps = np.nan_to_num(around - valid, nan=0.0)
    pick = np.abs(gaps).argmax(axis=0)
    gap = np.take_along_axis(gaps, pick[None], axis=0)[0]
    mixed = (np.abs(gap) > EDGE[0] * depth + EDGE[1]) & (depth > 0) & (rng.random(depth.shape) < share)
    weight = rng.uniform(0.05, 0.95, depth.shape)
    return np.where(mixed, depth + weight * gap, depth).astype(np.float32)
