"""Temporal state of the dynamic detector: recent frames, and the background behind pixels without depth."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import DynamicsConfig
from dudmap.core.backends.cpu.reprojection import Reprojection, reproject
from dudmap.core.backends.cpu.segment_motion import stand_still
from dudmap.core.backends.cpu.splatting import PointImage, overwrite, splat
from dudmap.core.dynamics.segments import Segmentation, scaled_length, scaled_side
from dudmap.core.frames.observation import Level
from dudmap.core.geometry import se3
from dudmap.core.state import Remembered, Stateful

SETTLE_FRAMES = 4
"""Frames over ``settle_time`` in which a released segment is still."""
START_FRAMES = 6
"""Frames over ``start_seconds`` whose lines of sight are free space."""
YOUNG_PERIODS = 3.0
"""Age of the map, in ``start_seconds``, until which single frames give free space."""
YOUNG_UNKNOWN_SHARE = 0.1
"""Share of measurements in unknown space above which single frames give free space at any age."""
SEAM = 1
"""Half width, pixels at REFERENCE_WIDTH, of false free regions along depth edges."""
MAX_DISPLACEMENT = 0.1
"""Largest distance of a point from its last measurement, reference depths: 3 m/s at 30 frames per second in a room."""
DYNAMIC_SHARE = 0.2
"""Smallest dynamic share of a segment that is remembered as dynamic."""

CARRIED_SHARE = 0.5
"""Smallest share of dynamic pixels that is still dynamic in the next frame, for labels that are carried: with
DYNAMIC_SHARE of its pixels, a segment is dynamic as a whole."""


@dataclass(eq=False)
class RememberedFrame:
    """A tracked frame with its labels.

    Attributes:
        timestamp: Seconds.
        level: The image.
        T_world_camera: (4, 4).
        dynamic: (h, w) uint8, 1 for pixels of dynamic segments, else 0.
    """

    timestamp: float
    level: Level
    T_world_camera: NDArray[np.float64]
    dynamic: NDArray[np.uint8]


class TemporalMemory(Stateful):
    """Remembered frames, for comparison with new ones.

    Args:
        config: ``settle_time`` and ``start_seconds``.
        reference_depth: Reference depth of the sensor, metres.
    """

    _last: Remembered[RememberedFrame | None] = None
    _settle_frames: Remembered[deque[RememberedFrame]]
    _recent_frames: Remembered[deque[RememberedFrame]]
    _start_frames: Remembered[list[RememberedFrame]]
    _imported: Remembered[bool] = False  # the frames of the first seconds come from another pass
    _young_until: Remembered[float] = -np.inf

    def __init__(self, config: DynamicsConfig, reference_depth: float = 1.0) -> None:
        self.config = config
        self._near = MAX_DISPLACEMENT * reference_depth
        self._settle_frames = deque()
        self._recent_frames = deque()
        self._start_frames = []

    def start(self, timestamp: float) -> None:
        """Begin with the first frame of a map."""
        self._young_until = timestamp + YOUNG_PERIODS * self.config.start_seconds
        self._start_frames = []
        self._recent_frames.clear()

    def import_from(self, other: "TemporalMemory", Ts_world_camera: dict[float, NDArray[np.float64]]) -> None:
        """Import the frames of the first seconds from another pass over the recording.

        ``Ts_world_camera``: (4, 4) by timestamp; frames without a pose are dropped.
        """
        self._young_until, self._imported = other._young_until, True
        self._start_frames = [
            replace(frame, T_world_camera=Ts_world_camera[frame.timestamp])
            for frame in other._start_frames
            if frame.timestamp in Ts_world_camera
        ]

    def update(
        self,
        timestamp: float,
        level: Level,
        T_world_camera: NDArray[np.float64],
        dynamic: NDArray[np.bool_],
        segmentation: Segmentation | None,
    ) -> None:
        """Remember a tracked frame with its dynamic pixels (h, w) bool; ``segmentation``: None if motion is not decided
        by segment."""
        marks = np.zeros(dynamic.shape, dtype=np.uint8)
        if segmentation is not None:
            marks = dynamic_segments(segmentation, dynamic).view(np.uint8)
        settle_time, start_seconds = self.config.settle_time, self.config.start_seconds
        self._last = frame = RememberedFrame(timestamp, level, T_world_camera, marks)
        settle_frames, recent_frames = self._settle_frames, self._recent_frames
        if not settle_frames or timestamp - settle_frames[-1].timestamp >= settle_time / SETTLE_FRAMES:
            settle_frames.append(frame)
        if not recent_frames or timestamp - recent_frames[-1].timestamp >= start_seconds / START_FRAMES:
            recent_frames.append(frame)
            if timestamp < self._young_until and not self._imported:
                self._start_frames.append(frame)
        while timestamp - recent_frames[0].timestamp > start_seconds:
            recent_frames.popleft()
        while len(settle_frames) > 1 and timestamp - settle_frames[1].timestamp >= settle_time:
            settle_frames.popleft()

    def apply_correction(self, T_new_old: NDArray[np.float64]) -> None:
        """Move the frames with a correction (4, 4) of the world."""
        frames = [*self._settle_frames, *self._recent_frames, *(() if self._imported else self._start_frames)]
        for frame in {id(frame): frame for frame in [*frames, self._last] if frame is not None}.values():
            frame.T_world_camera = T_new_old @ frame.T_world_camera

    def reset(self) -> None:
        """Forget all frames except imported ones."""
        self._last = None
        self._settle_frames.clear()
        self._recent_frames.clear()
        self._start_frames = self._start_frames if self._imported else []

    def can_carry(self, level: Level, T_world_camera: NDArray[np.float64]) -> bool:
        """Whether the labels of the last frame can be carried to an image at a predicted pose (4, 4): most of the
        dynamic pixels have not moved by their own size."""
        if self._last is None:
            return False
        carried = np.count_nonzero(self.last_dynamic(level, T_world_camera))
        return bool(carried >= CARRIED_SHARE * np.count_nonzero(self._last.dynamic))

    def last_dynamic(self, level: Level, T_world_camera: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Pixels (h, w) of an image at a pose (4, 4) whose points were in a dynamic segment in the last frame."""
        if self._last is None or not self._last.dynamic.any():
            return np.zeros(level.depth.shape, bool)
        return _seen_marked(_reprojected(level, T_world_camera, [self._last]), 0, self._near)

    def free_space_frames(self, timestamp: float, unknown: float = 0.0) -> list[RememberedFrame]:
        """Remembered frames whose lines of sight are free space at this time.

        There are some while the map is young, or if ``unknown``, the share of measurements in unknown space, is large.
        A second pass also compares later frames.
        """
        if timestamp < self._young_until:
            candidates = self._start_frames if self._imported else self._recent_frames
        else:
            candidates = self._recent_frames if unknown >= YOUNG_UNKNOWN_SHARE else ()
        return [frame for frame in candidates if 0 < abs(timestamp - frame.timestamp) <= self.config.start_seconds]

    @staticmethod
    def seen_free(
        level: Level,
        T_world_camera: NDArray[np.float64],
        noise: NDArray[np.float32],
        frames: Sequence[RememberedFrame],
    ) -> NDArray[np.bool_]:
        """Pixels (h, w) of an image at a pose (4, 4) in space that single frames have seen to be free.

        At least one frame saw farther by more than ``noise``, and at least half as many as saw a surface there.

        Args:
            noise: (h, w) float32, largest depth difference of measurements of one point, metres.
            frames: See ``free_space_frames``.
        """
        import cv2

        if not frames:
            return np.zeros(level.depth.shape, bool)
        gaps, side = _reprojected(level, T_world_camera, frames).gap, scaled_side(SEAM, level)
        num_free, num_surface = (gaps > noise).sum(axis=0), (np.abs(gaps) <= noise).sum(axis=0)
        free = (num_free > 0) & (2 * num_free >= num_surface)
        return cv2.morphologyEx(free.view(np.uint8), cv2.MORPH_OPEN, np.ones((side, side), np.uint8)) > 0

    def settled(
        self,
        timestamp: float,
        level: Level,
        T_world_camera: NDArray[np.float64],
        segmentation: Segmentation,
        sigma: NDArray[np.float32],
        dynamic: NDArray[np.bool_],
        least_sigma: float = 0.0,
    ) -> NDArray[np.bool_]:
        """Dynamic pixels (h, w) whose segment is still (``stand_still``) in all frames kept of ``settle_time``.

        Args:
            timestamp: Seconds.
            level, T_world_camera: The image and its pose (4, 4).
            segmentation: Its segments.
            sigma: (h, w) float32, standard deviation of a distance, metres; at least ``least_sigma``.
            dynamic: (h, w) bool.
        """
        frames = self._settle_frames
        if not frames or timestamp - frames[0].timestamp < self.config.settle_time or not dynamic.any():
            return np.zeros_like(dynamic)
        segments, still = segmentation.with_noise(sigma, least_sigma), np.arange(segmentation.count + 1) > 0
        for frame in frames:
            found = _reprojected(level, T_world_camera, [frame])
            stand_still(segments, dynamic, found.gap[0], found.difference[0], still)
            if not still.any():  # moving objects have mostly left their place since the oldest frame
                break
        return dynamic & still[segments.labels]


def dynamic_segments(segmentation: Segmentation, dynamic: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels (h, w) of the segments with a share of at least DYNAMIC_SHARE in a mask."""
    chosen = segmentation.share(dynamic) >= DYNAMIC_SHARE
    chosen[0] = False
    return chosen[segmentation.labels]


def _reprojected(level: Level, T_world_camera: NDArray[np.float64], frames: Sequence[RememberedFrame]) -> Reprojection:
    Ts = se3.inverse(np.array([frame.T_world_camera for frame in frames])) @ T_world_camera
    older = np.array([(frame.level.depth, frame.level.intensity) for frame in frames])
    marks = np.array([frame.dynamic for frame in frames])
    return reproject(level.depth, level.intensity, level.camera.intrinsics, Ts, older, marks)


def _seen_marked(found: Reprojection, n: int, near: float) -> NDArray[np.bool_]:
    return (found.marks[n] > 0) & (np.abs(found.gap[n]) < near)


SAME_INTENSITY = 0.15
"""Largest intensity difference from the background around."""
MIN_AGE = 0.3
"""Seconds for which background has been seen."""
VOTING_SIDE = 7
"""Side of the voting square, subsampled pixels."""
MIN_KNOWN = 0.2
"""Smallest share of the square with known background."""
STRIDE = 2
"""Pixels of the label image per subsampled pixel, at REFERENCE_WIDTH."""
SQUARE = np.ones((3, 3), np.uint8)
MIN_AREA = 0.005
"""Smallest examined region without depth, share of the image."""


class BackgroundModel(Stateful):
    """The last static measurement of every pixel, as a world point carried from image to image.

    An object without depth hides known background and looks different; a sensor shadow, screen or window looks like the
    background.

    Args:
        config: ``settle_time``: age at which unseen background is dropped.
    """

    _background: Remembered[PointImage | None] = None

    def __init__(self, config: DynamicsConfig) -> None:
        self.config = config

    def reset(self) -> None:
        """Drop the background."""
        self._background = None

    def hidden(self, timestamp: float, level: Level, T_world_camera: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Pixels (h, w) without depth in front of known background. The image has the exposure of the map.

        A pixel without depth votes if background is known within 3x3 pixels, and for hidden if its intensity is outside
        the background's range plus SAME_INTENSITY. The majority within VOTING_SIDE decides if at least MIN_KNOWN vote.
        """
        import cv2

        stride = _stride(level)
        farthest = cv2.dilate(level.depth, np.ones((stride, stride), np.uint8), anchor=(0, 0))[::stride, ::stride]
        hole = farthest <= 0
        none = np.zeros(level.depth.shape, bool)
        if self._background is None or not hole.any():
            return none
        intensity = _subsampled(level, stride)[1]
        _, background, times = self._seen_from(timestamp, level, stride, T_world_camera)
        missing = np.isnan(background)
        darkest = cv2.erode(np.where(missing, np.float32(9), background), SQUARE)
        brightest = cv2.dilate(np.where(missing, np.float32(-9), background), SQUARE)
        static = ~missing & (times[..., 1] - times[..., 0] >= MIN_AGE)
        known = hole & (cv2.dilate(static.view(np.uint8), SQUARE) > 0)
        limit = np.float32(SAME_INTENSITY)
        different = known & ((intensity < darkest - limit) | (intensity > brightest + limit))
        different = cv2.morphologyEx(different.view(np.uint8), cv2.MORPH_OPEN, SQUARE)  # without seams along edges
        if not different.any():
            return none
        votes = cv2.blur(different.astype(np.float32), (VOTING_SIDE, VOTING_SIDE))
        voters = cv2.blur(known.astype(np.float32), (VOTING_SIDE, VOTING_SIDE))
        hidden = (hole & (voters >= np.float32(MIN_KNOWN)) & (votes > np.float32(0.5) * voters)).astype(np.uint8)
        _, numbers, stats, _ = cv2.connectedComponentsWithStats(hidden, connectivity=4)
        large = stats[:, cv2.CC_STAT_AREA] >= MIN_AREA * hidden.size
        large[0] = False
        found = large[np.asarray(numbers, np.int32)].astype(np.uint8)
        found = cv2.resize(found, level.depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
        return (found > 0) & (level.depth <= 0)

    def update(
        self, timestamp: float, level: Level, T_world_camera: NDArray[np.float64], dynamic: NDArray[np.bool_]
    ) -> None:
        """Replace the background, except at ``dynamic`` pixels (h, w). The image has the exposure of the map."""
        stride = _stride(level)
        depth, intensity = _subsampled(level, stride)
        self._background = self._seen_from(timestamp, level, stride, T_world_camera)
        static, intrinsics = ~dynamic[::stride, ::stride], level.camera.intrinsics / np.float32(stride)
        overwrite(self._background, depth, intensity, static, timestamp, T_world_camera, intrinsics)

    def apply_correction(self, T_new_old: NDArray[np.float64]) -> None:
        """Move the points with a correction (4, 4) of the world."""
        if self._background is not None:
            points = self._background.points @ T_new_old[:3, :3].T + T_new_old[:3, 3]
            self._background = self._background._replace(points=points.astype(np.float32))

    def _seen_from(
        self, timestamp: float, level: Level, stride: int, T_world_camera: NDArray[np.float64]
    ) -> PointImage:
        if self._background is None:
            return PointImage.empty(level.depth[::stride, ::stride].shape)
        since, intrinsics = timestamp - self.config.settle_time, level.camera.intrinsics / np.float32(stride)
        return splat(self._background, se3.inverse(T_world_camera), intrinsics, since)


def _subsampled(level: Level, stride: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth of one pixel per stride, and mean intensity around it."""
    import cv2

    depth = level.depth[::stride, ::stride]
    return depth, np.asarray(cv2.resize(level.intensity, depth.shape[::-1], interpolation=cv2.INTER_AREA), np.float32)


def _stride(level: Level) -> int:
    """Subsampled images are about 80 pixels wide."""
    return scaled_length(STRIDE, level)
