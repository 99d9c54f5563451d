"""Motion segmentation from images, while the map cannot separate static and moving surface.

A new map knows no free space, and its moving objects are part of it. Each image is compared with the last one
(``dominant_motion``). Older images show motion that is too slow between consecutive images.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.core.dynamics.dominant_motion import (
    AGREED,
    MANY,
    DominantMotion,
    dominant_motion,
    exceeds_noise_share,
    propagate_to_segments,
)
from dudmap.core.dynamics.segments import Segmentation
from dudmap.core.frames.observation import Pyramid, is_majority_dynamic
from dudmap.core.geometry import se3
from dudmap.core.state import Remembered, Stateful

ImagePose = Callable[[], NDArray[np.float64] | None]
"""Computes the pose (4, 4) by the ego-motion between two images; None if unknown."""
SHORTEST_BASELINE, LONGEST_BASELINE = 0.1, 0.4
"""Age of the older image that shows slow motion, seconds. While the map is young, images are kept at intervals of the
shorter baseline."""


@dataclass(eq=False)
class TrackedImage:
    """Image of a frame at its (predicted) pose, for comparison with older and newer images.

    Attributes:
        timestamp, T_world_camera: Seconds; (4, 4).
        pyramid: Its images.
        segmentation: Its segments, at the resolution of the labels.
        moving: (h, w) bool, its known moving pixels; None for none.
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

    def motion_to(self, later: "TrackedImage", intervals: float) -> DominantMotion | None:
        """Motion of the static world to a later image, and motion too slow between consecutive images; None if unknown.

        ``intervals``: number of frame intervals between the two images. Pixels of this image that move are excluded
        from the estimates of later comparisons.
        """
        T_expected = se3.inverse(later.T_world_camera) @ self.T_world_camera
        segmentations = self.segmentation, later.segmentation
        motion = dominant_motion(self.pyramid, later.pyramid, segmentations, self.moving, T_expected, intervals)
        if motion is not None:
            moving = propagate_to_segments(motion.before)
            self.moving = moving if self.moving is None else self.moving | moving
        return motion


@dataclass(frozen=True, eq=False)
class Restart:
    """New start of a young map whose camera has followed a crowd.

    Attributes:
        T_world_camera: (4, 4) pose of the frame that starts the map again.
        moving: (h, w) bool, its moving pixels, label resolution.
        stamps: (n,) times of earlier images, seconds.
        corrections: (n, 4, 4) corrections of their poses.
    """

    T_world_camera: NDArray[np.float64]
    moving: NDArray[np.bool_]
    stamps: NDArray[np.float64]
    corrections: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SlowMotion:
    """Motion between an older image and a new one that is too slow between consecutive images.

    Attributes:
        T_world_camera: (4, 4) pose of the new image, relative to the older one.
        moving: (h, w) bool, pixels of the new image in segments that moved as a whole.
        static: (h, w) bool, pixels of the new image in static segments.
        moving_first: (h, w) bool, moving pixels of the older image if it is the first one of the map; else None.
    """

    T_world_camera: NDArray[np.float64]
    moving: NDArray[np.bool_]
    static: NDArray[np.bool_]
    moving_first: NDArray[np.bool_] | None


class EgoMotionSegmenter(Stateful):
    """Segments moving objects by comparing images, while the map is young or most of the view moves.

    Args:
        seconds: Duration of the comparison after the first frame of a map. It is extended, up to twice, while moving
            objects are found. 0 disables the comparison.

    Attributes:
        active: Whether to compare the next frame with the last one.
        last: The last tracked frame.
        start_verified: Whether the poses since the start are known not to follow a crowd.
    """

    active: Remembered[bool] = False
    _young_until: Remembered[float]
    _latest_end: Remembered[float]
    _started: Remembered[float]
    last: Remembered[TrackedImage | None] = None
    _older: Remembered[deque[TrackedImage]]
    _since_start: Remembered[list[TrackedImage]]
    start_verified: Remembered[bool] = False
    _compared: Remembered[tuple[float, DominantMotion | None] | None] = None  # time and result of the last comparison

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._young_until = self._latest_end = self._started = -np.inf
        self._older, self._since_start = deque(), []

    def start(self, timestamp: float) -> None:
        """Begin with the first frame of a map."""
        self._young_until, self._latest_end = timestamp + self.seconds, timestamp + 2 * self.seconds
        self._started = timestamp
        self._older.clear()
        self._since_start.clear()
        self.start_verified = False

    @property
    def started(self) -> bool:
        """Whether ``start`` was called."""
        return bool(np.isfinite(self._started))

    def map_is_young(self, timestamp: float) -> bool:
        """Whether the map cannot separate static and moving surface yet."""
        return timestamp < self._young_until

    def slow_motion_is_hidden(self, timestamp: float) -> bool:
        """Whether the map is younger than the longest baseline for slow motion."""
        return timestamp < self._started + min(LONGEST_BASELINE, self.seconds)

    def update(self, frame: TrackedImage) -> None:
        """Set the tracked frame for the next comparison; after a blind frame there is none."""
        self.last, self._compared, self.active = frame, None, False
        if frame.blind:
            return
        young = self.map_is_young(frame.timestamp)
        hidden = frame.moving is not None and is_majority_dynamic(frame.moving, frame.pyramid.labelled)
        self.active = young or (hidden and self.seconds > 0 and self.started)
        if not young:
            self._since_start.clear()
        if not young and not (self.active and self._older):  # a crowd since the first second may be a slow one
            self._older.clear()
        elif not self._older or frame.timestamp - self._older[-1].timestamp >= SHORTEST_BASELINE:
            self._older.append(replace(frame))
            if young:
                self._since_start.append(replace(frame))

    def reset(self) -> None:
        """Drop the last frame, so that nothing is compared before the next ``update``."""
        self.last, self._compared, self.active = None, None, False

    def compare(self, now: TrackedImage, T_expected: NDArray[np.float64] | None = None) -> DominantMotion | None:
        """Motion of the static world since the last frame; None if unknown.

        ``T_expected``: (4, 4) expected motion, or None. The result is cached: a second call with the same timestamp
        returns the same object.
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

    def restart(self, now: TrackedImage, crowd: NDArray[np.bool_], same_pose: tuple[float, float]) -> Restart | None:
        """New start of the young map, now that most of the view is known to move.

        Backwards in time, each earlier image is registered by its corners to the next one, without the moving pixels.
        None if every pose stays within ``same_pose``, or if a motion is not found.

        Args:
            now: The image, at its pose relative to the last one.
            crowd: (h, w) bool, its moving pixels.
            same_pose: Largest distance (m) and angle (deg) of equal poses.
        """
        if self.start_verified:
            return None
        images, corrections, later = self._since_start[::-1], [np.eye(4)], replace(now, moving=crowd)
        for image in images:
            image = replace(image, T_world_camera=corrections[-1] @ image.T_world_camera)
            motion = later.motion_to(image, np.inf)
            if motion is None or motion.share < AGREED or np.count_nonzero(motion.before.static) < MANY:
                return None
            T = later.T_world_camera @ se3.inverse(motion.T_after_before)
            corrections.append(T @ se3.inverse(image.T_world_camera) @ corrections[-1])
            later = replace(image, T_world_camera=T, moving=~motion.static_after)
        self.start_verified = True
        moved = zip(images, corrections[1:], strict=True)
        if all(se3.agree(T @ image.T_world_camera, image.T_world_camera, *same_pose) for image, T in moved):
            return None
        T_world = se3.inverse(corrections[-1])  # the first camera keeps its pose
        stamps = np.array([image.timestamp for image in self._since_start])
        return Restart(T_world @ now.T_world_camera, crowd, stamps, T_world @ np.stack(corrections[:0:-1]))

    def slow_motion(self, now: TrackedImage) -> SlowMotion | None:
        """Comparison with the oldest suitable image; None without one or without a common motion.

        If it shows motion, the newest of the older images is compared, too, because it shows surface that came into
        view later.
        """
        timestamp = now.timestamp
        while self._older and timestamp - self._older[0].timestamp > LONGEST_BASELINE:
            self._older.popleft()
        older = [image for image in self._older if timestamp - image.timestamp >= SHORTEST_BASELINE]
        if not older or self.last is None or not self.active:
            return None
        newest, interval = older[-1], timestamp - self.last.timestamp
        found = ((image, image.motion_to(now, (timestamp - image.timestamp) / interval)) for image in older)
        oldest, motion = next((pair for pair in found if pair[1] is not None), (newest, None))
        if motion is None:
            return None
        now = replace(now, T_world_camera=oldest.T_world_camera @ se3.inverse(motion.T_after_before))
        moving, static = propagate_to_segments(motion.after), motion.static_after
        first = oldest.moving if oldest.timestamp == self._started else None
        if newest is not oldest and exceeds_noise_share(moving, now.pyramid.labelled):
            motion = newest.motion_to(now, (timestamp - newest.timestamp) / interval)
            if motion is not None:
                moving = moving | propagate_to_segments(motion.after)
                static = static | motion.static_after
        return SlowMotion(now.T_world_camera, moving, static & ~moving, first)
