"""Registration of colour to the depth image of the same frame."""

from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.color_registration import register
from dudmap.core.backends.cpu.filtering import intensity
from dudmap.core.backends.cpu.teams import run_team
from dudmap.core.backends.median import median
from dudmap.core.backends.parameters import ColorProjection
from dudmap.core.frames.observation import Observation
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.se3 import hat

Pixel = TypeVar("Pixel", np.uint8, np.float32)
MEDIAN_STRIDE = 8
BAND_ROWS = 60


def color_projection(calibration: Calibration, twist: NDArray[np.float64], offset: float) -> ColorProjection:
    """Projection of points of the depth camera into the colour image.

    T exp(-tau xi) X in second order of tau: with a = v + omega x X it is T X - tau R a + tau^2 / 2 R (omega x a).

    Args:
        calibration: Colour camera relative to the depth camera.
        twist: (6,) motion of the depth camera per second, its own axes.
        offset: Time stamp of the colour image minus time stamp of the depth image, s.
    """
    T, R, W = calibration.T_color_depth, calibration.T_color_depth[:3, :3], hat(twist[3:])
    speed = np.column_stack([W, twist[:3]])
    return ColorProjection(
        T[:3].astype(np.float32),
        (R @ speed).astype(np.float32),
        (R @ W @ speed).astype(np.float32),
        calibration.camera.intrinsics,
        calibration.lens.astype(np.float32),
        offset + calibration.delay,
        calibration.depth_readout + calibration.readout,
        calibration.camera.height,
        calibration.vignetting,
    )


def recorded_intensity(observation: Observation, halvings: int) -> NDArray[np.float32]:
    """Intensity (h, w) in 0..1 of the recorded colour image, halved by 2x2 blocks."""
    import cv2

    known = observation._recorded_halvings
    if not known:
        recorded = observation.rgb if observation.recorded_rgb is None else observation.recorded_rgb
        known.append(observation.intensity if recorded is observation.rgb else intensity(recorded))
    while len(known) <= halvings:
        h, w = (size // 2 for size in known[-1].shape)
        whole = known[-1][: 2 * h, : 2 * w]
        known.append(np.asarray(cv2.resize(whole, (w, h), interpolation=cv2.INTER_AREA), np.float32))
    return known[halvings]


def typical_depth(depth: NDArray[np.float32]) -> float:
    """Median of sampled depths (H, W), metres; 1 without depth."""
    readings = depth[::MEDIAN_STRIDE, ::MEDIAN_STRIDE]
    readings = readings[readings > 0]
    return float(median(readings)) if len(readings) else 1.0


def register_color(
    color: NDArray[Pixel],
    depth: NDArray[np.float32],
    camera: Camera,
    projection: ColorProjection,
) -> NDArray[Pixel]:
    """Colour (H, W[, 3]) of each depth pixel, interpolated, clamped to the colour image.

    ``color``: (h, w[, 3]) recorded; ``depth``: (H, W) without lens distortion, metres, 0 = none. Occlusion is not
    resolved.
    """
    import cv2

    if color.shape[:2] == depth.shape and _is_in_place(projection, camera):
        gain, kept = _inverse_vignetting(*color.shape, vignetting=projection.vignetting), color.dtype
        return np.asarray(cv2.multiply(color, gain, dtype=cv2.CV_8U if kept == np.uint8 else cv2.CV_32F), kept)
    out, none = np.empty(depth.shape + color.shape[2:], color.dtype), np.empty
    if color.ndim == 3:
        words, outputs = cv2.cvtColor(color, cv2.COLOR_RGB2RGBA), (none((0, 0), np.float32), out)
    else:
        words, outputs = np.ascontiguousarray(color), (out, none((0, 0, 3), np.uint8))
    size = len(depth), *color.shape[:2]
    run_team(
        register, -(-len(depth) // BAND_ROWS), BAND_ROWS, depth, camera.intrinsics, projection,
        np.float32(typical_depth(depth)), size, words.view(np.int32).reshape(-1), *outputs,
    )  # fmt: skip
    return out


def _is_in_place(projection: ColorProjection, camera: Camera) -> bool:
    still = projection.offset == 0 and projection.readout == 0 and not projection.distortion.any()
    same = still and np.array_equal(projection.intrinsics, camera.intrinsics)
    return bool(same and np.array_equal(projection.place, np.eye(3, 4, dtype=np.float32)))


@lru_cache(maxsize=8)
def _inverse_vignetting(height: int, width: int, channels: int = 1, *, vignetting: float) -> NDArray[np.float32]:
    v, u = np.mgrid[:height, :width]
    middle = (height - 1) / 2, (width - 1) / 2
    loss = vignetting * ((v - middle[0]) ** 2 + (u - middle[1]) ** 2) / (middle[0] ** 2 + middle[1] ** 2)
    gain = np.exp(loss).astype(np.float32)
    return gain if channels == 1 else np.repeat(gain[:, :, None], channels, axis=2)
