"""Colour camera of a synthetic sensor: its place, its time of exposure, its lens and its exposure."""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.camera import Camera
from dudmap.errors import FrameError
from dudmap.lab.synthetic.faults import SensorFaults

Image = NDArray[np.float32]
TARGET_LEVEL = 110.0
"""Mean grey value that the automatic exposure aims at; assumed, a little below the middle of the scale."""
LARGEST_GAIN = 4.0
"""Range of the exposure, as a factor up and down: two stops, assumed."""
WHITE_BALANCE_PERIOD = 8.0
"""Period of the drift of the white balance, seconds; assumed."""


class ColorCamera:
    """Colour camera beside a depth camera.

    Args:
        faults: Its place, delay, readout, lens, white balance and vignetting.
        depth_camera: Intrinsics of the depth camera.
        exposure_time: Duration of the exposure of a row, seconds; 0 for no motion blur.
        frame_interval: Time between two frames, seconds.

    Attributes:
        camera: True intrinsics.
    """

    def __init__(self, faults: SensorFaults, depth_camera: Camera, exposure_time: float, frame_interval: float) -> None:
        self.camera = faults.color_camera(depth_camera)
        self._faults = faults
        # Moments of the exposure: three for short ones, five for half the frame interval and more.
        count = int(np.clip(round(10 * exposure_time / frame_interval), 3, 5)) if exposure_time > 0 else 1
        self._moments = (np.arange(count) - (count - 1) / 2) / count * exposure_time
        self._step = exposure_time / count

    def view(self, t: float, render: Callable[[float, Camera], Image]) -> Image:
        """What falls on the sensor (H, W, 3), 0..255, in the frame stamped ``t``.

        Args:
            t: Seconds.
            render: Gives the image of an ideal camera, at the place of this one, at a time in seconds.
        """
        margin = self._lens.margin if self.camera.distortion else 0
        height, width = self.camera.height + 2 * margin, self.camera.width + 2 * margin
        wide = replace(
            self.camera, cx=self.camera.cx + margin, cy=self.camera.cy + margin, width=width, height=height,
            distortion=(),
        )  # fmt: skip
        color = np.zeros((height, width, 3), dtype=np.float32)
        for first, last, offset in self._faults.row_bands(self.camera.height, margin, self._step):
            low, high = max(first - 1, 0), min(last + 1, height)  # pixels at a border look at their neighbours
            band = replace(wide, cy=wide.cy - low, height=high - low)
            for moment in self._moments:
                seen = render(t + offset + moment, band)
                color[first:last] += seen[first - low : last - low] / np.float32(len(self._moments))
        return self._lens.distort(color) if margin else color

    def exposed(self, color: Image, t: float, gain: float) -> Image:
        """Image (H, W, 3) after exposure by the factor ``gain``, white balance at time ``t``, and vignetting."""
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
        """Brightness (H, W, 1) relative to the middle: 1 - vignetting (r / r_corner)^2."""
        v, u = (np.asarray(axis) for axis in np.indices(self.camera.shape, dtype=np.float32))
        middle_u, middle_v = (self.camera.width - 1) / 2, (self.camera.height - 1) / 2
        squared = ((u - middle_u) ** 2 + (v - middle_v) ** 2) / (middle_u**2 + middle_v**2)
        return (1 - self._faults.vignetting * squared)[..., None].astype(np.float32)


def exposure_gains(levels: NDArray[np.float64], times: NDArray[np.float64], lag: float) -> NDArray[np.float64]:
    """Exposure factors (N,) of an automatic exposure with a lag.

    A control loop of first order on the logarithm of the exposure: each frame moves by 1 - exp(-dt / lag) towards the
    factor that would have brought the frame before to ``TARGET_LEVEL``. The first frame is settled.

    Args:
        levels: (N,) mean grey values at factor 1.
        times: (N,) seconds.
        lag: Time constant in seconds, positive.
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
    """Lens that distorts an ideal image of a somewhat larger view.

    Args:
        camera: Intrinsics and distortion of the image to be made.

    Attributes:
        margin: Number of pixels by which the ideal image is larger on every side.
    """

    def __init__(self, camera: Camera) -> None:
        rows, columns = np.indices(camera.shape, dtype=np.float64)
        pixels = np.stack([columns, rows], axis=-1)
        ideal = cv2.undistortPoints(pixels.reshape(-1, 1, 2), camera.K, np.array(camera.distortion), P=camera.K)
        ideal = ideal.reshape(pixels.shape)
        self.margin = int(np.ceil(np.abs(ideal - pixels).max())) + 3
        self._at = (ideal + self.margin).astype(np.float32)

    def distort(self, wide: NDArray[np.float32]) -> NDArray[np.float32]:
        """Distorted image (H, W, 3) of the ideal one (H + 2 margin, W + 2 margin, 3)."""
        return np.asarray(cv2.remap(wide, self._at, np.empty(0), cv2.INTER_CUBIC), dtype=np.float32)


def compressed(color: NDArray[np.uint8], quality: float) -> NDArray[np.uint8]:
    """Image (H, W, 3) after JPEG compression and decompression.

    Raises:
        FrameError: The image cannot be compressed.
    """
    done, code = cv2.imencode(".jpg", color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, round(quality)])
    if not done:
        raise FrameError("the colour image could not be compressed as JPEG")
    image = cv2.imdecode(code, cv2.IMREAD_COLOR)
    assert image is not None
    return np.ascontiguousarray(image[..., ::-1]).astype(np.uint8, copy=False)
