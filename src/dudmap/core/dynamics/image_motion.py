"""Motion between consecutive images, for maps without known free space."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.core.dynamics.dominant_motion import DominantMotion, dominant_motion, exceeds_noise_share
from dudmap.core.dynamics.segments import Segmentation
from dudmap.core.frames.observation import Pyramid, is_majority_dynamic
from dudmap.core.geometry import se3
from dudmap.core.state import Remembered, Stateful

ImagePose = Callable[[], NDArray[np.float64] | None]
"""Computes the pose (4, 4) by the motion between two images; None if unknown."""


@dataclass(eq=False)
class TrackedImage:
    """Image of a frame at its (predicted) pose, for comparison with other images.

    Attributes:
        timestamp, T_world_camera: Seconds; (4, 4).
        pyramid: Its images.
        segmentation: Its segments, label resolution.
        moving: (h, w) bool, known moving pixels; None for none.
        blind: Whether its intensities carry no information.
        gain: Gain of its exposure.
    """

    timestamp: float
    T_world_camera: NDArray[np.float64]
    pyramid: Pyramid
    segmentation: Segmentation
    moving: NDArray[np.bool_] | None = None
    blind: bool = False
    gain: float = 1.0

    def motion_to(self, other: "TrackedImage", **options: bool) -> DominantMotion | None:
        """``dominant_motion`` to another image; None if unknown."""
        T_expected = se3.inverse(other.T_world_camera) @ self.T_world_camera
        segmentations = self.segmentation, other.segmentation
        return dominant_motion(self.pyramid, other.pyramid, segmentations, self.moving, T_expected, **options)


class ImageMotion(Stateful):
    """Compares each image with the last one, while the map is young or most of the view moves.

    Args:
        seconds: Duration after the first frame of a map, extended up to twice while moving objects are found. 0
            disables the comparison.

    Attributes:
        active: Whether to compare the next frame.
        last: The last tracked frame.
    """

    active: Remembered[bool] = False
    last: Remembered[TrackedImage | None] = None
    _young_until: Remembered[float] = -np.inf
    _latest_end: Remembered[float] = -np.inf
    _compared: Remembered[tuple[float, DominantMotion | None] | None] = None  # time and result of the last comparison

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    def start(self, timestamp: float) -> None:
        """Begin with the first frame of a map."""
        self._young_until, self._latest_end = timestamp + self.seconds, timestamp + 2 * self.seconds

    @property
    def started(self) -> bool:
        """Whether ``start`` was called."""
        return bool(np.isfinite(self._latest_end))

    def map_is_young(self, timestamp: float) -> bool:
        """Whether the map cannot yet separate static and moving surface."""
        return timestamp < self._young_until

    def update(self, frame: TrackedImage) -> None:
        """Set the frame for the next comparison."""
        self.last, self._compared, self.active = frame, None, False
        if not frame.blind:
            mostly = frame.moving is not None and is_majority_dynamic(frame.moving, frame.pyramid.labelled)
            self.active = self.map_is_young(frame.timestamp) or (mostly and self.seconds > 0 and self.started)

    def reset(self) -> None:
        """Drop the last frame."""
        self.last, self._compared, self.active = None, None, False

    def compare(self, now: TrackedImage, T_expected: NDArray[np.float64] | None = None) -> DominantMotion | None:
        """Motion of the static world since the last frame; None if unknown.

        ``T_expected``: (4, 4) or None. The result is cached by timestamp.
        """
        last = self.last
        if last is None or last.blind:
            return None
        if self._compared is None or self._compared[0] != now.timestamp:
            segmentations = last.segmentation, now.segmentation
            motion = dominant_motion(last.pyramid, now.pyramid, segmentations, last.moving, T_expected)
            self._compared = now.timestamp, motion
            if (
                motion is not None
                and self.map_is_young(now.timestamp)
                and exceeds_noise_share(motion.moving_after, now.pyramid.labelled)
            ):
                self._young_until = min(now.timestamp + self.seconds, self._latest_end)
        return self._compared[1]
