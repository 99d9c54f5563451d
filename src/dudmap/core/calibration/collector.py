"""Selection of the frames from which the calibration is estimated."""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.calibration.keyframes import ColorKeyframe, central_velocity, keyframe
from dudmap.core.frames.observation import Observation
from dudmap.core.geometry.camera import Camera

INTERVAL = 0.1
"""Time between two keyframes at the start, seconds."""
MAX_KEYFRAMES = 60
"""Largest number of keyframes; beyond it every second one is dropped and the interval doubles."""
MAX_GAP = 0.2
"""Largest time between the two neighbours of a keyframe for its velocity to be known, seconds."""


class KeyframeCollector:
    """Collects keyframes evenly over the time since tracking began.

    Args:
        color_camera: Camera of the colour images as recorded.
        max_gap: Largest time between the two neighbours of a keyframe, seconds, if less than ``MAX_GAP``.

    Attributes:
        keyframes: In the order of time.
    """

    def __init__(self, color_camera: Camera, max_gap: float = MAX_GAP) -> None:
        self.color_camera = color_camera
        self.max_gap = min(max_gap, MAX_GAP)
        self.keyframes: list[ColorKeyframe] = []
        self._interval = INTERVAL
        self._before: tuple[float, NDArray[np.float64]] | None = None
        self._pending: tuple[Observation, NDArray[np.float64], NDArray[np.bool_]] | None = None

    def add(
        self, observation: Observation, T_world_camera: NDArray[np.float64], dynamic_mask: NDArray[np.bool_]
    ) -> None:
        """Take note of a tracked frame; the one before may become a keyframe, since its velocity is now known.

        Args:
            observation: The frame.
            T_world_camera: (4, 4) pose.
            dynamic_mask: (H, W) bool, pixels that move.
        """
        now = observation.timestamp
        if self._pending is not None:
            middle, T, mask = self._pending
            before = self._before
            if before is not None and now - before[0] <= self.max_gap and self._is_due(middle.timestamp):
                velocity = central_velocity(before, (now, T_world_camera))
                self.keyframes.append(keyframe(middle, self.color_camera, T, velocity, mask))
                if len(self.keyframes) > MAX_KEYFRAMES:
                    del self.keyframes[1::2]
                    self._interval *= 2
            self._before = middle.timestamp, T
        self._pending = observation, T_world_camera, dynamic_mask

    def interrupt(self) -> None:
        """Tracking was lost, or the poses jumped: the velocity across is not known."""
        self._before = self._pending = None

    def clear(self) -> None:
        """Another map has begun, whose poses cannot be compared."""
        self.interrupt()
        self.keyframes.clear()
        self._interval = INTERVAL

    def _is_due(self, timestamp: float) -> bool:
        return not self.keyframes or timestamp - self.keyframes[-1].timestamp >= self._interval - 1e-3
