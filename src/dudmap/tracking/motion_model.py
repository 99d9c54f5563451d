"""Constant-velocity model of the camera's motion."""

import numpy as np
from numpy.typing import NDArray

from dudmap.config import TrackerConfig
from dudmap.geometry import se3

VELOCITY_LIFETIME = 0.15
"""Time after the last accepted pose during which the velocity is still used, seconds."""


PAUSE = 1.0
"""Time without a pose after which the last velocity says nothing, seconds: a hand accelerates by about 1 m/s^2."""

ACCELERATION = 1.0
"""Standard deviation of the acceleration of a camera in the hand, m/s^2, by which a prediction goes wrong."""
MAX_DRIFT = 0.03
"""Largest standard deviation of a pose that follows the prediction where the view shows no motion, metres."""


class MotionModel:
    """Predicts the next pose from the last two.

    Attributes:
        T_world_camera: (4, 4), the last accepted pose.
    """

    def __init__(self, config: TrackerConfig) -> None:
        self.config = config
        self.T_world_camera = np.eye(4)
        self._timestamp = 0.0
        self._velocity = np.zeros(6)  # twist per second, camera axes
        self._initialized = False
        self._observed = 0.0  # time of the last pose whose motion was seen in all directions

    @property
    def velocity(self) -> NDArray[np.float64]:
        """Twist per second (6,), camera axes, between the last two poses; 0 where it is not known."""
        return self._velocity

    def predict(self, timestamp: float) -> NDArray[np.float64]:
        """Predicted pose (4, 4) at a time in seconds."""
        if not self.config.constant_velocity:
            return self.T_world_camera
        return self.T_world_camera @ se3.exp(self._velocity * self.elapsed(timestamp))

    def update(self, timestamp: float, T_world_camera: NDArray[np.float64], *, observed: bool = True) -> None:
        """Accept the pose of a tracked frame, whose motion was ``observed`` in all directions or partly predicted."""
        if observed:
            self._observed = timestamp
        if self._initialized:
            self._velocity = self.velocity_to(timestamp, T_world_camera)
        self._timestamp, self.T_world_camera, self._initialized = timestamp, T_world_camera, True

    def velocity_to(self, timestamp: float, T_world_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """Twist per second (6,), camera axes, from the last accepted pose to this one; 0 before the first."""
        if not self._initialized:
            return np.zeros(6)
        return se3.log(se3.inverse(self.T_world_camera) @ T_world_camera) / self.elapsed(timestamp)

    def lost(self, timestamp: float) -> bool:
        """Register a frame without a pose; once the velocity's lifetime is over, the last pose is the prediction.

        Returns:
            Whether the velocity's lifetime is over.
        """
        if timestamp - self._timestamp <= VELOCITY_LIFETIME:
            return False
        self._velocity = np.zeros(6)
        return True

    def has_paused(self, timestamp: float) -> bool:
        """Whether no pose has been accepted for longer than PAUSE."""
        return self._initialized and timestamp - self._timestamp > PAUSE

    def drift_reason(self, timestamp: float) -> str:
        """Sentence if a pose that is partly predicted would be too uncertain, empty if not.

        An unknown acceleration of standard deviation a moves the camera by a t^2 / 2 off its prediction in a time t.
        """
        elapsed = timestamp - self._observed
        drift = ACCELERATION * elapsed**2 / 2
        if drift <= MAX_DRIFT:
            return ""
        return f"the view has not shown all directions of motion for {elapsed:.2f} s, in which the pose may drift"

    def restart(self, timestamp: float, T_world_camera: NDArray[np.float64]) -> None:
        """Continue from the pose of a relocalised frame with unknown velocity."""
        self._initialized, self._velocity = False, np.zeros(6)
        self.update(timestamp, T_world_camera)

    def apply_correction(self, T_new_old: NDArray[np.float64]) -> None:
        """Follow a correction of the world frame; the velocity is in camera axes and stays."""
        self.T_world_camera = T_new_old @ self.T_world_camera

    def rejection_reason(self, timestamp: float, T_world_camera: NDArray[np.float64]) -> str:
        """Sentence on a velocity beyond ``max_speed`` or ``max_turn_deg``; empty if there is none."""
        motion = se3.inverse(self.T_world_camera) @ T_world_camera
        elapsed = self.elapsed(timestamp)
        speed = float(np.linalg.norm(motion[:3, 3])) / elapsed
        turn = float(np.degrees(se3.rotation_angle(motion))) / elapsed
        if speed > self.config.max_speed or turn > self.config.max_turn_deg:
            return f"the camera would have jumped at {speed:.1f} m/s and {turn:.0f} deg/s"
        return ""

    def elapsed(self, timestamp: float) -> float:
        """Seconds since the last accepted pose, at most 1."""
        return min(max(timestamp - self._timestamp, 1e-3), 1.0)
