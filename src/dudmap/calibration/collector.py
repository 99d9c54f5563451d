"""Selection of the frames from which the calibration is estimated."""

import numpy as np
from numpy.typing import NDArray

from dudmap.calibration.keyframes import ColorKeyframe, keyframe, velocity_at
from dudmap.frames.observation import Observation
from dudmap.geometry.camera import Camera

INTERVAL = 0.1
"""Time between two keyframes at the start, seconds."""
MAX_KEYFRAMES = 60
"""Largest number of keyframes; beyond it every second one is dropped and the interval doubles."""
MAX_GAP = 0.1
"""Largest mean time from frame to frame for the velocity of a keyframe to be known, seconds."""
NEIGHBOURS = 2
"""Frames before and after a keyframe from whose poses its velocity is estimated."""


class KeyframeCollector:
    """Collects keyframes evenly over the time since tracking began.

    Args:
        color_camera: Camera of the colour images as recorded.

    Attributes:
        keyframes: In the order of time.
    """

    def __init__(self, color_camera: Camera) -> None:
        self.color_camera = color_camera
        self.keyframes: list[ColorKeyframe] = []
        self._interval = INTERVAL
        self._poses: list[tuple[float, NDArray[np.float64]]] = []  # of the latest frames, and the images of those
        self._waiting: list[tuple[Observation, NDArray[np.bool_]]] = []  # that may still become keyframes

    def add(
        self, observation: Observation, T_world_camera: NDArray[np.float64], dynamic_mask: NDArray[np.bool_]
    ) -> None:
        """Take note of a tracked frame; an earlier one may become a keyframe, since its velocity is now known.

        Args:
            observation: The frame.
            T_world_camera: (4, 4) pose.
            dynamic_mask: (H, W) bool, pixels that move.
        """
        self._poses = [*self._poses, (observation.timestamp, T_world_camera)][-2 * NEIGHBOURS - 1 :]
        self._waiting = [*self._waiting, (observation, dynamic_mask)][-NEIGHBOURS - 1 :]
        times, poses = zip(*self._poses, strict=True)
        steady = times[-1] - times[0] <= 2 * NEIGHBOURS * (MAX_GAP + 1e-3)
        middle, mask = self._waiting[0]
        if len(times) <= 2 * NEIGHBOURS or not steady or not self._is_due(middle.timestamp):
            return
        velocity = velocity_at(NEIGHBOURS, times, poses)
        self.keyframes.append(keyframe(middle, self.color_camera, poses[NEIGHBOURS], velocity, mask))
        if len(self.keyframes) > MAX_KEYFRAMES:
            del self.keyframes[1::2]
            self._interval *= 2

    def interrupt(self) -> None:
        """Tracking was lost, or the poses jumped: the velocity across is not known."""
        self._poses, self._waiting = [], []

    def clear(self) -> None:
        """Another map has begun, whose poses cannot be compared."""
        self.interrupt()
        self.keyframes.clear()
        self._interval = INTERVAL

    def _is_due(self, timestamp: float) -> bool:
        return not self.keyframes or timestamp - self.keyframes[-1].timestamp >= self._interval - 1e-3
