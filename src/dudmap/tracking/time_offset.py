"""How long before or after the colour the depth was taken, learnt while the camera moves."""

import numpy as np
from numpy.typing import NDArray

from dudmap.frames.observation import Level
from dudmap.geometry.se3 import retract
from dudmap.kernels.median import median
from dudmap.mapping.volume import TsdfVolume
from dudmap.tracking.tracker import Tracker

USUAL, LONGEST = 0.015, 0.06
"""Standard deviation of the delays of sensors before anything is known, and the longest, seconds."""
MEMORY = 0.95
"""What a frame's evidence counts one frame later."""
ALIKE = 400.0
"""Readings that err alike and tell as much as one."""
NOISE = 0.0035
"""Motion during the delay that is not worth taking into account, metres in the image's middle distance."""
LARGEST = 6.0
"""Faster motion, metres per second, is no motion but a wrong pose, or a camera that was set down elsewhere."""


class DepthTimeOffset:
    """The delay of the depth against the pose that depth and colour have together.

    No pose fits both images of a moving camera if they are taken milliseconds apart: a hand at half a metre per second
    leaves a centimetre between them, along every edge of a static scene. The delay is one number: that for which the
    poses along the camera's own motion bring the distances nearest to the map, by a Gauss-Newton step per frame whose
    evidence is summed over the last frames, with a Gaussian prior around 0. What moves in the scene does not keep step
    with the camera, and has little say.

    Attributes:
        seconds: The delay; negative where the depth is older.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self._information, self._evidence = 0.0, 0.0

    def depth_pose(
        self, level: Level, T_world_camera: NDArray[np.float64], velocity: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Pose (4, 4) from which the depth was taken.

        Args:
            level: The image.
            T_world_camera: (4, 4), the pose of depth and colour together.
            velocity: (6,) twist per second of the camera on its way to this pose, camera axes.
        """
        twist, speed = _seen_motion(level, T_world_camera, velocity)
        if speed >= LARGEST or abs(self.seconds) * speed < NOISE:
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
        """Take in a frame whose pose is believed.

        Args:
            tracker: Gives the normal equations.
            volume: The map, which has been looked at from near the pose.
            level: A coarse level of the image.
            T_world_camera, velocity: As above.
            weights: (h, w) float32 static weights in [0, 1].
        """
        twist, speed = _seen_motion(level, T_world_camera, velocity)
        if not 0 < speed < LARGEST:
            return
        variance = ALIKE * (tracker.sensor.sigma_base + tracker.sensor.sigma_scale) ** 2
        T_depth = retract(T_world_camera, self.seconds * twist)
        system = tracker.linearize(volume, level, T_depth, weights, color_weight=0.0)
        information = float(twist @ system.H @ twist) / variance
        evidence = information * self.seconds - float(twist @ system.b) / variance
        self._information = MEMORY * self._information + information
        self._evidence = MEMORY * self._evidence + evidence
        self.seconds = float(np.clip(self._evidence / (self._information + USUAL**-2), -LONGEST, LONGEST))


def _seen_motion(
    level: Level, T_world_camera: NDArray[np.float64], velocity: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Twist per second (6,) about the camera's centre, world axes, and how fast what is at the middle distance
    moves in the image at most, m/s; 0 where there are no readings."""
    twist = (velocity.reshape(2, 3) @ T_world_camera[:3, :3].T).reshape(6)
    readings = level.depth[level.depth > 0]
    if len(readings) == 0:
        return twist, 0.0
    return twist, float(np.linalg.norm(twist[:3]) + float(median(readings)) * np.linalg.norm(twist[3:]))
