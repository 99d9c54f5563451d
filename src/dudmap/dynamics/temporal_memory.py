"""Recent frames that tell what moved a moment ago and what has stood still since."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import DynamicsConfig
from dudmap.dynamics.segments import ORDINARY_MISMATCH, SMALLEST, Segmentation, judge, upper_quartile
from dudmap.frames.observation import Level
from dudmap.geometry import se3
from dudmap.kernels import segmentation

MEMORIES = 4
"""Frames that are kept of the time in which a thing must stand still."""
YOUTH = 3.0
"""Times `start_seconds` for which space that was seen free from single frames counts; later the map knows it."""
ALIKE = 0.08
"""Intensities that differ by less are the same."""
RESTED = 0.3
"""Share of `start_seconds` in which a thing must have been seen at its place to have rested there."""
SEAM = 3
"""What is thinner, pixels, may come from a pose that is a little off along a depth edge."""
VIEWS = 6
"""Frames that are kept of `start_seconds` to know that."""
YOUNG_UNKNOWN_SHARE = 0.1
"""Share of the readings in space the map has not seen from which on an old map counts as young, too."""
MOVED, BODY = 1, 2
"""Bits of a pixel of the last frame: it was called moving; a part of its piece was."""


@dataclass(frozen=True, eq=False)
class _Memory:
    timestamp: float
    level: Level
    T_world_camera: NDArray[np.float64]
    marks: NDArray[np.uint8]  # MOVED, BODY


class TemporalMemory:
    """The last frames, to tell what moved a moment ago and what has stood still since.

    Args:
        config: ``settle_time``.
    """

    def __init__(self, config: DynamicsConfig) -> None:
        self.config = config
        self._last: _Memory | None = None
        self._memories: deque[_Memory] = deque()
        self._young_until = -np.inf
        self._views: list[_Memory] = []  # of the first seconds
        self._recent: deque[_Memory] = deque()  # of the last moments
        self._complete = False  # those of the first seconds come from another pass

    def start(self, timestamp: float) -> None:
        """Begin with the first frame of a map, of this time in seconds."""
        self._young_until = timestamp + YOUTH * self.config.start_seconds
        self._views = []
        self._recent.clear()

    def import_from(self, other: "TemporalMemory", Ts_world_camera: dict[float, NDArray[np.float64]]) -> None:
        """Take over what another pass over the same frames has seen in the first seconds.

        Args:
            other: Its memory.
            Ts_world_camera: (4, 4) by time, where it saw the frames; others are left out.
        """
        self._young_until, self._complete = other._young_until, True
        self._views = [
            replace(view, T_world_camera=Ts_world_camera[view.timestamp])
            for view in other._views
            if view.timestamp in Ts_world_camera
        ]

    def update(
        self,
        timestamp: float,
        level: Level,
        T_world_camera: NDArray[np.float64],
        moving: NDArray[np.bool_],
        surface: Segmentation | None,
    ) -> None:
        """Keep the frame, which was tracked, its labels (h, w) bool and its pieces."""
        marks = moving.astype(np.uint8)
        if surface is not None:
            marks[((surface.share(moving) >= 0.2) & (np.arange(surface.count + 1) > 0))[surface.labels]] |= BODY
        self._last = _Memory(timestamp, level, T_world_camera, marks)
        if not self._memories or timestamp - self._memories[-1].timestamp >= self.config.settle_time / MEMORIES:
            self._memories.append(self._last)
        if not self._recent or timestamp - self._recent[-1].timestamp >= self.config.start_seconds / VIEWS:
            self._recent.append(self._last)
            if timestamp < self._young_until and not self._complete:
                self._views.append(self._last)
        while timestamp - self._recent[0].timestamp > self.config.start_seconds:
            self._recent.popleft()
        while len(self._memories) > 1 and timestamp - self._memories[1].timestamp >= self.config.settle_time:
            self._memories.popleft()

    def reset(self) -> None:
        """Tracking was lost: what was seen before says nothing of what stood still meanwhile."""
        self._last = None
        self._memories.clear()
        self._recent.clear()
        self._views = self._views if self._complete else []

    def marks(self, level: Level, T_world_camera: NDArray[np.float64], reach: float) -> NDArray[np.uint8]:
        """What each pixel (h, w) was in the last frame, MOVED and BODY, if its point is nearer than ``reach`` (m)."""
        if self._last is None or not self._last.marks.any():
            return np.zeros(level.depth.shape, dtype=np.uint8)
        ((gap, _, marks),) = reproject_difference(level, T_world_camera, [self._last])
        marks[~(np.abs(gap) < reach)] = 0
        return marks

    def views(
        self,
        timestamp: float,
        level: Level,
        T_world_camera: NDArray[np.float64],
        noise: NDArray[np.float32],
        unknown: float = 0.0,
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """What single frames of the last moments say of each pixel, while the map is young, or knows little of what is
        in view; else nothing.

        In the first seconds a second pass also asks the frames of the next moments.

        Args:
            timestamp: Seconds.
            level: The image.
            T_world_camera: (4, 4) its pose.
            noise: (h, w) float32, largest gap between two readings of one point, metres.
            unknown: Share of the readings that lie in space the map has not seen.

        Returns:
            (h, w) bool, pixels whose point lies in space through which those frames have seen farther,
            (h, w) bool, pixels whose point was there in all of them, and looked the same.
        """
        import cv2

        free, there, alike, known, age = (np.zeros(level.depth.shape, dtype=np.float32) for _ in range(5))
        if timestamp < self._young_until:
            views = self._views if self._complete else self._recent
        else:
            views = self._recent if unknown >= YOUNG_UNKNOWN_SHARE else ()
        asked = [view for view in views if 0 < abs(timestamp - view.timestamp) <= self.config.start_seconds]
        answers = reproject_difference(level, T_world_camera, asked)
        for view, (gap, difference, _) in zip(asked, answers, strict=True):
            apart = abs(timestamp - view.timestamp)
            seen, close = ~np.isnan(gap), np.abs(gap) <= noise
            free += gap > noise
            there += close
            alike += close & (np.abs(difference) < ALIKE)
            known += seen
            age[seen] = np.maximum(age[seen], apart)
        rested = (known >= 2) & (alike == known) & (age >= RESTED * self.config.start_seconds)
        rested = cv2.medianBlur(rested.astype(np.uint8), 5) > 0
        freed = ((free > 0) & (2 * free >= there)).astype(np.uint8)
        freed = cv2.morphologyEx(freed, cv2.MORPH_OPEN, np.ones((SEAM, SEAM), np.uint8)) > 0
        return freed, rested

    def standing(
        self,
        timestamp: float,
        level: Level,
        T_world_camera: NDArray[np.float64],
        surface: Segmentation,
        sigma: NDArray[np.float32],
        moving: NDArray[np.bool_],
    ) -> NDArray[np.bool_]:
        """Pixels (h, w) of those called ``moving`` whose piece has been where it is for ``settle_time``."""
        nothing = np.zeros_like(moving)
        if not self._memories or timestamp - self._memories[0].timestamp < self.config.settle_time or not moving.any():
            return nothing
        count = surface.count
        both = Segmentation(
            surface.labels + np.where(moving, np.int32(count), np.int32(0)), 2 * count, surface.gradient
        )
        still = np.bincount(both.labels.reshape(-1), minlength=2 * count + 1) >= SMALLEST
        still[: count + 1] = False
        for memory in self._memories:
            ((gap, difference, _),) = reproject_difference(level, T_world_camera, [memory])
            known = ~np.isnan(gap)
            verdict = judge(both, known, known & (np.abs(np.nan_to_num(gap)) > 4 * sigma), gap, sigma, difference)
            counted = np.flatnonzero((verdict.known > 0.7) & (verdict.size >= SMALLEST))
            usual = max(ORDINARY_MISMATCH, upper_quartile(verdict.mismatch[counted]))
            still &= (verdict.known > 0.7) & (verdict.moving < 0.1) & (np.abs(verdict.shift) < 1)
            still &= verdict.mismatch < 1.2 * usual
            if not still.any():
                return nothing
        return still[both.labels]


def reproject_difference(
    level: Level, T_world_camera: NDArray[np.float64], frames: Sequence[_Memory]
) -> list[segmentation.Reprojection]:
    """Differences of an image to remembered frames, one for each."""
    targets = [
        segmentation.ReprojectionTarget(
            se3.inverse(frame.T_world_camera) @ T_world_camera, frame.level.depth, frame.level.intensity, frame.marks
        )
        for frame in frames
    ]
    return segmentation.reproject(level.depth, level.intensity, level.camera.intrinsics, targets)
