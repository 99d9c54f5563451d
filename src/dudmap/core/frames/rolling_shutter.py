"""Rectification of rolling-shutter images to the time of the middle row."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu import rectification
from dudmap.core.backends.cpu.filtering import intensity
from dudmap.core.backends.cpu.teams import run_team
from dudmap.core.frames.color_registration import BAND_ROWS, color_projection, typical_depth
from dudmap.core.frames.observation import Observation
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera


def rectified_images(
    depth: NDArray[np.float32],
    camera: Camera,
    readout: float,
    velocity: NDArray[np.float64],
    color: NDArray[np.uint8] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.int32]]:
    """Depth (H, W) and colour (H, W, 3; empty without) at the time of the middle row, and indices (H, W) of the
    recorded pixels.

    A point that the camera sees at X in the middle of the readout is recorded in row v at exp(-tau xi) X with tau =
    readout ((v + 1/2) / H - 1/2).

    Args:
        depth: (H, W), metres, 0 = none.
        camera: Camera of both images, without distortion.
        readout: Time from the first to the last row, seconds.
        velocity: (6,) twist xi per second, camera axes.
        color: (H, W, 3), with the row times of the depth.
    """
    projection = color_projection(Calibration(camera, depth_readout=readout), velocity, 0.0)
    h, w = depth.shape
    words = np.empty(0, np.int32)
    if color is not None:
        words = cv2.cvtColor(color, cv2.COLOR_RGB2RGBA).view(np.int32).reshape(-1)
    out, colors = np.empty((h, w), np.float32), np.empty((0, 0, 3) if color is None else (h, w, 3), np.uint8)
    sources = np.empty((h, w), np.int32)
    run_team(
        rectification.rectify, -(-h // BAND_ROWS), BAND_ROWS, depth, camera.intrinsics, projection,
        np.float32(typical_depth(depth)), (h, h, w), words, out, colors, sources,
    )  # fmt: skip
    return out, colors, sources


def rectified(
    observation: Observation, readout: float, velocity: NDArray[np.float64], *, with_color: bool
) -> Observation:
    """Observation at the time of its middle row.

    Args:
        readout: Readout of the depth image, seconds.
        velocity: (6,) twist per second, camera axes.
        with_color: Whether colour has the row times of the depth; else it is registered later.
    """
    color = observation.rgb if with_color else None
    depth, rgb, sources = rectified_images(observation.depth, observation.camera, readout, velocity, color)
    recorded = observation.rgb if observation.recorded_rgb is None else observation.recorded_rgb
    shown = {"rgb": rgb, "intensity": intensity(rgb)} if with_color else {}
    return replace(
        observation, depth=depth, recorded_rgb=recorded, depth_readout=readout, sources=sources, _halvings=[], **shown
    )


def recorded_mask(mask: NDArray[np.bool_], observation: Observation) -> NDArray[np.bool_]:
    """Mask (H, W) of an observation in the geometry of the recorded image."""
    if observation.sources is None or not mask.any():
        return mask
    out = np.empty_like(mask)
    rectification.recorded_mask(mask, observation.sources, out)
    return out
