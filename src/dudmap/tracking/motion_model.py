"""Constant-velocity prediction of the camera, and what it makes of a jump."""

import numpy as np
from numpy.typing import NDArray

from dudmap.config import TrackerConfig
from dudmap.geometry import se3

KEPT = 0.15
"""Time after the last good pose in which the camera is taken to go on as it did, seconds."""


class MotionModel:
    """Predicts the next pose from the last two; some time after a loss it stays at the last good pose.

    Attributes:
        T_world_camera: (4, 4), the last good pose.
    """

    def __init__(self, config: TrackerConfig) -> None:
        self.config = config
        self._timestamp = 0.0
        self.T_world_camera = np.eye(4)
        self._velocity = np.zeros(6)  # twist per second, camera axes
        self._known = False

    def predict(self, timestamp: float) -> NDArray[np.float64]:
        """Pose (4, 4) to start the registration from."""
        if not self.config.constant_velocity:
            return self.T_world_camera
        return self.T_world_camera @ se3.exp(self._velocity * self._elapsed(timestamp))

    def update(self, timestamp: float, T_world_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take over the pose of a tracked frame; returns ``velocity_to`` it."""
        velocity = self.velocity_to(timestamp, T_world_camera)
        if self._known:
            self._velocity = velocity
        self._timestamp, self.T_world_camera, self._known = timestamp, T_world_camera, True
        return velocity

    def velocity_to(self, timestamp: float, T_world_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """Twist per second (6,), camera axes, that leads from the last pose to this one; 0 where there is none."""
        if not self._known:
            return np.zeros(6)
        return se3.log(se3.inverse(self.T_world_camera) @ T_world_camera) / self._elapsed(timestamp)

    def lost(self, timestamp: float) -> bool:
        """Take note of a frame without a pose; after a few, the next are tried from the last good pose.

        Returns:
            Whether what was known of the last good frame says nothing any more.
        """
        if timestamp - self._timestamp <= KEPT:
            return False
        self._velocity = np.zeros(6)
        return True

    def restart(self, timestamp: float, T_world_camera: NDArray[np.float64]) -> None:
        """Take over the pose of a frame whose place was recognised; what lies before it says nothing of its motion."""
        self._known, self._velocity = False, np.zeros(6)
        self.update(timestamp, T_world_camera)

    def moved(self, T_new_old: NDArray[np.float64]) -> None:
        """Follow a correction of the world; the velocity, in camera axes, stays."""
        self.T_world_camera = T_new_old @ self.T_world_camera

    def implausible(self, timestamp: float, T_world_camera: NDArray[np.float64]) -> str:
        """Sentence on a jump that no camera makes, empty if there is none."""
        motion = se3.inverse(self.T_world_camera) @ T_world_camera
        elapsed = self._elapsed(timestamp)
        speed = float(np.linalg.norm(motion[:3, 3])) / elapsed
        turn = float(np.degrees(se3.rotation_angle(motion))) / elapsed
        if speed > self.config.max_speed or turn > self.config.max_turn_deg:
            return f"the camera would have jumped at {speed:.1f} m/s and {turn:.0f} deg/s"
        return ""

    def _elapsed(self, timestamp: float) -> float:
        return min(max(timestamp - self._timestamp, 1e-3), 1.0)
