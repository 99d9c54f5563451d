"""Time offset between depth and colour, estimated while the camera moves."""

import numpy as np
from numpy.typing import NDArray

from dudmap.frames.observation import Level
from dudmap.geometry.se3 import retract
from dudmap.kernels.median import median
from dudmap.mapping.volume import TsdfVolume
from dudmap.tracking.tracker import Tracker

PRIOR_SIGMA, MAX_OFFSET = 0.015, 0.06
"""Standard deviation of the offset before anything is known (half a frame period at 30 Hz), and its limit, seconds."""
FORGETTING = 0.95
"""Factor by which the information of the past decreases from frame to frame: an average over 20 frames."""
CORRELATED_READINGS = 400.0
"""Neighbouring readings whose errors are correlated, and which together count as one."""
NEGLIGIBLE_SHIFT = 0.0035
"""Displacement during the offset, metres at the median depth, that is not worth compensating."""
MAX_SPEED = 6.0
"""Displacement per second, metres at the median depth, beyond which a velocity is a wrong pose or a gap."""


class DepthTimeOffset:
    """Estimates the offset of the depth image against the pose at which depth and colour agree best.

    If the two images of a moving camera are taken milliseconds apart, no pose fits both: at half a metre per second,
    20 ms leave a centimetre between them. The offset ``t`` is the one for which the poses ``exp(t v) T`` along the
    camera's velocity ``v`` minimise the distances of the depth readings to the map. Each frame contributes one
    Gauss-Newton step, with H and b the normal equations of the distances at the current offset:

        information = v' H v / sigma^2,   evidence = information t - v' b / sigma^2,
        t = sum(evidence) / (sum(information) + 1 / PRIOR_SIGMA^2),

    summed with exponential forgetting and with a zero-mean Gaussian prior.

    Attributes:
        seconds: The offset; negative where the depth image is older than the colour image.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self._information, self._evidence = 0.0, 0.0

    def depth_pose(
        self, level: Level, T_world_camera: NDArray[np.float64], velocity: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Pose (4, 4) at the time of the depth image.

        Args:
            level: The image.
            T_world_camera: (4, 4), the pose at which depth and colour agree best.
            velocity: (6,) twist per second of the camera, camera axes.
        """
        twist, speed = _apparent_motion(level, T_world_camera, velocity)
        if speed >= MAX_SPEED or abs(self.seconds) * speed < NEGLIGIBLE_SHIFT:
            return T_world_camera
        return retract(T_world_camera, self.seconds * twist)

    def learn(
        self,
        tracker: Tracker,
        volume: TsdfVolume,
        level: Level,
        T_world_camera: NDArray[np.float64],
        velocity: NDArray[np.float64],
        weights: NDArray[np.float32],
    ) -> None:
        """Update the offset with a frame whose pose is accepted.

        Args:
            tracker: Computes the normal equations.
            volume: The map; its window must cover the view.
            level: A coarse level of the image.
            T_world_camera, velocity: As for ``depth_pose``.
            weights: (h, w) float32 static weights in [0, 1].
        """
        twist, speed = _apparent_motion(level, T_world_camera, velocity)
        if not 0 < speed < MAX_SPEED:
            return
        variance = CORRELATED_READINGS * tracker.sensor.sigma(1.0) ** 2
        T_depth = retract(T_world_camera, self.seconds * twist)
        system = tracker.linearize(volume, level, T_depth, weights, color_weight=0.0)
        information = float(twist @ system.H @ twist) / variance
        evidence = information * self.seconds - float(twist @ system.b) / variance
        self._information = FORGETTING * self._information + information
        self._evidence = FORGETTING * self._evidence + evidence
        offset = self._evidence / (self._information + PRIOR_SIGMA**-2)
        self.seconds = float(np.clip(offset, -MAX_OFFSET, MAX_OFFSET))


def _apparent_motion(
    level: Level, T_world_camera: NDArray[np.float64], velocity: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Twist per second (6,) about the camera centre in world axes, and the largest velocity, m/s, that it gives a point
    at the median depth of the image; 0 without readings."""
    twist = (velocity.reshape(2, 3) @ T_world_camera[:3, :3].T).reshape(6)
    readings = level.depth[level.depth > 0]
    if len(readings) == 0:
        return twist, 0.0
    return twist, float(np.linalg.norm(twist[:3]) + float(median(readings)) * np.linalg.norm(twist[3:]))
