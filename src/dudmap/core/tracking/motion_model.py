"""Camera motion: constant velocity, or the motion of given poses."""

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dudmap.config import TrackerConfig
from dudmap.core.frames.observation import Level
from dudmap.core.geometry import se3
from dudmap.core.state import Remembered, Stateful
from dudmap.core.verdict import Outcome, Verdict
from dudmap.errors import ConfigError

GivenRole = Literal["estimated", "given", "refined"]
"""Role of given poses, see ``MotionModel``."""
VELOCITY_LIFETIME = 0.15
"""Seconds since the last accepted pose during which the velocity is valid."""
PAUSE = 1.0
"""Seconds without a pose that make the velocity useless: a hand accelerates by about 1 m/s^2."""
ACCELERATION = 1.0
"""Standard deviation of the acceleration of a handheld camera, m/s^2."""


class MotionModel(Stateful):
    """Predicts the next pose from the last two, or by the motion of given poses (robot arm, phone, odometry).

    Args:
        config: Whether velocity is constant.
        timed: Whether the stamps are times; otherwise they only give the order.
        poses: Given poses are the result (``given``) or start the registration (``refined``); ``estimated``: there are
            none.

    Attributes:
        T_world_camera: (4, 4), the last accepted pose.
    """

    T_world_camera: Remembered[NDArray[np.float64]]
    _T_given: Remembered[NDArray[np.float64] | None] = None  # given pose of the next frame
    _T_world_given: Remembered[NDArray[np.float64]]  # world of the given poses in the world of the map
    _timestamp: Remembered[float] = 0.0
    _velocity: Remembered[NDArray[np.float64]]
    _initialized: Remembered[bool] = False
    _observed: Remembered[float] = 0.0  # time of the last pose that was observed in all directions

    def __init__(self, config: TrackerConfig, *, timed: bool = True, poses: GivenRole = "estimated") -> None:
        self.config = config
        self.timed, self.poses = timed, poses
        self.T_world_camera, self._T_world_given = np.eye(4), np.eye(4)
        self._velocity = np.zeros(6)  # twist per second, camera axes

    @property
    def timestamp(self) -> float:
        """Time of the last accepted pose, seconds."""
        return self._timestamp

    @property
    def velocity(self) -> NDArray[np.float64]:
        """Twist per second (6,), camera axes; 0 if unknown."""
        return self._velocity

    def give(self, T_world_camera: NDArray[np.float64] | None) -> None:
        """Set the given pose (4, 4) of the next frame, None for none.

        Raises:
            ConfigError: The role of poses is ``estimated``.
            FrameError: The pose is no rigid motion.
        """
        if T_world_camera is not None and self.poses == "estimated":
            raise ConfigError('a pose is given for a frame; expected Slam(camera, poses="given") or poses="refined"')
        self._T_given = None if T_world_camera is None else se3.checked_pose(T_world_camera)

    @property
    def verdict(self) -> Verdict:
        """Whether the next frame has the pose that it needs."""
        lacks = self.poses == "given" and self._T_given is None
        return Verdict((Outcome.of("pose", lacks, 0, "no pose is given for the frame"),))

    @property
    def is_given(self) -> bool:
        """Whether the given pose is the result."""
        return self.poses == "given" and self._T_given is not None

    @property
    def start(self) -> NDArray[np.float64]:
        """Pose (4, 4) of the first frame of a map: given, else the identity."""
        return np.eye(4) if self._T_given is None else self._T_world_given @ self._T_given

    def predict(self, timestamp: float) -> NDArray[np.float64]:
        """Predicted pose (4, 4) at a time in seconds."""
        if self._T_given is not None:
            return self._T_world_given @ self._T_given
        return self.T_world_camera @ se3.exp(self._velocity * self.elapsed(timestamp))

    def repeated(self, timestamp: float, T_last: NDArray[np.float64], *, depth_only: bool) -> NDArray[np.float64]:
        """Pose (4, 4) of a frame that repeats the last images (pose ``T_last``), or only their depth."""
        return self.predict(timestamp) if depth_only or self.is_given else T_last

    def update(self, timestamp: float, T_world_camera: NDArray[np.float64], *, observed: bool = True) -> None:
        """Accept a pose; ``observed``: no direction of its motion was predicted."""
        if observed:
            self._observed = timestamp
        if self._initialized:
            self._velocity = self.velocity_to(timestamp, T_world_camera)
        if self._T_given is not None and self.poses == "refined":
            self._T_world_given = T_world_camera @ se3.inverse(self._T_given)
        self._timestamp, self.T_world_camera, self._initialized = timestamp, T_world_camera, True

    def velocity_to(self, timestamp: float, T_world_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """Twist per second (6,), camera axes, since the last accepted pose; 0 before the first."""
        if not self._initialized:
            return np.zeros(6)
        return se3.log(se3.inverse(self.T_world_camera) @ T_world_camera) / self.elapsed(timestamp)

    def lost(self, timestamp: float) -> bool:
        """Register a frame without a pose. Returns whether the velocity's lifetime is over."""
        if timestamp - self._timestamp <= VELOCITY_LIFETIME:
            return False
        self._velocity = np.zeros(6)
        return True

    def has_paused(self, timestamp: float) -> bool:
        """Whether the last accepted pose is older than PAUSE."""
        return self._initialized and timestamp - self._timestamp > PAUSE

    def drift(self, timestamp: float) -> float:
        """Standard deviation of a partly predicted pose, metres: a t^2 / 2 with the acceleration a."""
        return ACCELERATION * (timestamp - self._observed) ** 2 / 2

    def restart(self, timestamp: float, T_world_camera: NDArray[np.float64]) -> None:
        """Continue from a relocalized pose with unknown velocity."""
        self._initialized, self._velocity = False, np.zeros(6)
        self.update(timestamp, T_world_camera)

    def apply_correction(self, T_new_old: NDArray[np.float64]) -> None:
        """Follow a correction of the world frame."""
        self.T_world_camera = T_new_old @ self.T_world_camera
        self._T_world_given = T_new_old @ self._T_world_given

    def figures(self, timestamp: float, T_world_camera: NDArray[np.float64], image: Level) -> dict[str, float]:
        """Motion since the last accepted pose (4, 4): ``speed_m_s`` and ``turn_deg_s``.

        Without frame times it is ``step``: shift of the median measurement as a share of the image width.
        """
        motion = se3.inverse(self.T_world_camera) @ T_world_camera
        shift, angle = motion[:3, 3].copy(), se3.rotation_angle(motion)
        distance = math.sqrt(shift @ shift)
        if self.timed:
            elapsed = self.elapsed(timestamp)
            return {"speed_m_s": distance / elapsed, "turn_deg_s": math.degrees(angle) / elapsed, "step": np.nan}
        readings = image.depth[image.depth > 0]
        depth = float(np.median(readings)) if len(readings) else np.inf
        step = (distance / depth + angle) * image.camera.fx / image.camera.width
        return {"speed_m_s": np.nan, "turn_deg_s": np.nan, "step": step}

    def elapsed(self, timestamp: float) -> float:
        """Seconds since the last accepted pose, at most 1."""
        return min(max(timestamp - self._timestamp, 1e-3), 1.0)
