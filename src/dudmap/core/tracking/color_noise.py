"""Noise of the intensity residual that grows with the camera's motion."""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.median import median
from dudmap.core.frames.observation import Level

RESOLUTION = 0.5
"""Displacement, in voxels or pixels, below which intensities cannot tell two images apart: half a sampling distance."""
STRIDE = 8
"""Every so many pixels, across and down, enter the median."""


def motion_discount(level: Level, velocity: NDArray[np.float64], time_sigma: float, voxel_size: float) -> float:
    """Factor in (0, 1] of the weight of the intensity residual while the camera moves.

    Colour and depth of one pixel are not taken at one time: the rows of a rolling shutter are read out one after the
    other, exposure takes time, and the two cameras are not synchronised. With a standard deviation ``s`` of that time
    and an image that moves by ``u`` pixels per second, the colour of a reading is displaced by ``s u`` pixels, and its
    residual has the variance

        sigma^2 + |grad I|^2 (s u)^2 = sigma^2 (1 + (s u / r)^2),   r = sigma / |grad I|,

    where r is the displacement that the intensities resolve at all: half a pixel of the level, or half a voxel, since
    the map holds no finer detail. The weight is divided by the bracket with the median of u / r over the image. The
    motion field of a twist (v, omega) is, per unit of the image at depth 1 (Longuet-Higgins and Prazdny 1980),

        (-v_x + x v_z) / z - omega_y + y omega_z + x (y omega_x - x omega_y),
        (-v_y + y v_z) / z + omega_x - x omega_z + y (y omega_x - x omega_y):

    a camera that moves forwards shifts the middle of its image less than one that moves sideways.

    Args:
        level: Finest level of the registration.
        velocity: (6,) twist per second of the camera, camera axes.
        time_sigma: Standard deviation of the time between the colour and the depth of a pixel, seconds.
        voxel_size: Metres.
    """
    camera, part = level.camera, np.s_[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
    v, u = np.nonzero(level.depth[part] > 0)
    if len(u) == 0:
        return 1.0
    z = level.depth[part][v, u].astype(np.float64)
    x = (STRIDE * u + STRIDE // 2 - camera.cx) / camera.fx
    y = (STRIDE * v + STRIDE // 2 - camera.cy) / camera.fy
    (vx, vy, vz), (wx, wy, wz) = velocity[:3], velocity[3:]
    tilt = y * wx - x * wy
    across, down = (x * vz - vx) / z - wy + y * wz + x * tilt, (y * vz - vy) / z + wx - x * wz + y * tilt
    resolved = RESOLUTION * np.maximum(1 / camera.fx, voxel_size / z)
    return 1 / (1 + (time_sigma * float(median(np.hypot(across, down) / resolved))) ** 2)
