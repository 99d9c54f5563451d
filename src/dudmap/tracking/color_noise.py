"""Noise of the intensity residual that grows with the camera's motion."""

import numpy as np
from numpy.typing import NDArray

from dudmap.frames.observation import Level
from dudmap.kernels.median import median

RESOLUTION = 0.5
"""Displacement, in voxels or pixels, below which intensities cannot tell two images apart: half a sampling distance."""
STRIDE = 4
"""Every so many pixels, across and down, enter the median depth."""


def motion_discount(level: Level, velocity: NDArray[np.float64], time_sigma: float, voxel_size: float) -> float:
    """Factor in (0, 1] of the weight of the intensity residual while the camera moves.

    Colour and depth of one pixel are not taken at one time: the rows of a rolling shutter are read out one after the
    other, exposure takes time, and the two cameras are not synchronised. With a standard deviation ``s`` of that time
    and an image that moves by ``u`` pixels per second, the colour of a reading is displaced by ``s u`` pixels, and its
    residual has the variance

        sigma^2 + |grad I|^2 (s u)^2 = sigma^2 (1 + (s u / r)^2),   r = sigma / |grad I|,

    where r is the displacement that the intensities resolve at all: half a pixel of the level, or half a voxel, since
    the map holds no finer detail. The weight is divided by the bracket, for the median depth of the image.

    Args:
        level: Finest level of the registration.
        velocity: (6,) twist per second of the camera, camera axes.
        time_sigma: Standard deviation of the time between the colour and the depth of a pixel, seconds.
        voxel_size: Metres.
    """
    sample = level.depth[::STRIDE, ::STRIDE]
    readings = sample[sample > 0]
    if len(readings) == 0:
        return 1.0
    z = float(median(readings))
    speed = float(np.linalg.norm(velocity[:3])) / z + float(np.linalg.norm(velocity[3:]))  # rad/s at the median depth
    resolved = RESOLUTION * max(1 / level.camera.fx, voxel_size / z)
    return 1 / (1 + (time_sigma * speed / resolved) ** 2)
