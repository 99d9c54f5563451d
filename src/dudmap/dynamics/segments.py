"""Whether a whole piece of surface moves: what its pixels say of it together, and how long it has stood still."""

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import DynamicsConfig
from dudmap.geometry import se3
from dudmap.kernels import segmentation
from dudmap.kernels.threads import bands, run_bands
from dudmap.tracking.tracker import Level

REACH = 3
"""Pixels to either side of a hollow."""
HOLLOW = 0.2
"""Sine of half the angle by which the surface turns in a hollow."""
SMALLEST = 60
"""Pieces of fewer pixels are not judged as a whole."""
LARGEST = 0.15
"""Pieces of more than this share of the image hold a part of the room: they move only if nearly all of them does."""
SHIFT = 2.8
"""Mean distance to the map, in standard deviations of a reading, of a piece that surely moved."""
MISMATCH = 0.48
"""Mean difference of intensity over mean gradient of intensity of a piece that surely moved: pixels of motion."""
ORDINARY_SHIFT, ORDINARY_MISMATCH = 0.4, 0.17
"""What three of four pieces of a good frame stay below; where they have more, so must one that moved."""
FLOOR = 0.03
"""Gradients smaller than this tell nothing, intensity per pixel."""
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
UNKNOWN = 0.1
"""Share of the readings in space the map has not seen from which on an old map counts as young, too."""


MOVED, BODY = 1, 2
"""Bits of a pixel of the last frame: it was called moving; a part of its piece was."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """Pieces of surface of one image.

    Attributes:
        labels: (h, w) int32 numbers from 1, 0 = no reading.
        count: How many there are.
        gradient: (h, w) float32, intensity per pixel, mean over 3x3.
    """

    labels: NDArray[np.int32]
    count: int
    gradient: NDArray[np.float32]

    def share(self, pixels: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Share (count + 1,) of the pixels of each piece that are among these (h, w) bool; entry 0 means nothing."""
        total = np.bincount(self.labels.reshape(-1), minlength=self.count + 1)
        return np.bincount(self.labels[pixels], minlength=self.count + 1) / np.maximum(total, 1)


@dataclass(frozen=True, eq=False)
class Verdict:
    """What the pixels of each piece say together; all (count + 1,), entry 0 means nothing.

    Attributes:
        size: Pixels.
        known: Share of the pixels that could be compared.
        moving: Share of the pixels that move by themselves.
        rest: Number of pixels that could be compared and do not move by themselves.
        shift: Of these, mean distance over its standard deviation,
        mismatch: mean difference of the intensities from their mean difference, in pixels of motion,
        texture: and mean gradient of the intensity.
    """

    size: NDArray[np.float64]
    known: NDArray[np.float64]
    moving: NDArray[np.float64]
    rest: NDArray[np.float64]
    shift: NDArray[np.float64]
    mismatch: NDArray[np.float64]
    texture: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Memory:
    timestamp: float
    level: Level
    T_world_camera: NDArray[np.float64]
    marks: NDArray[np.uint8]  # MOVED, BODY


def pieces(level: Level, tolerance: NDArray[np.float32]) -> Pieces:
    """Cut an image's surface along depth edges and hollows.

    Args:
        level: The image.
        tolerance: (h, w) float32, largest depth step to a neighbour of the same surface, metres.
    """
    import cv2

    edge = np.empty(level.depth.shape, dtype=np.bool_)
    labels = np.empty(level.depth.shape, dtype=np.int32)
    normals = np.empty((*level.depth.shape, 3), dtype=np.float32)
    intrinsics = level.camera.intrinsics
    segmentation.hollows(level.depth, intrinsics, tolerance, REACH, np.float32(HOLLOW), normals, edge)
    count = segmentation.segments(level.depth, intrinsics, tolerance, normals, edge, labels, REACH + 1)
    du = cv2.Sobel(level.intensity, cv2.CV_32F, 1, 0, scale=1 / 8)
    dv = cv2.Sobel(level.intensity, cv2.CV_32F, 0, 1, scale=1 / 8)
    gradient = cv2.blur(cv2.magnitude(du, dv), (3, 3))
    return Pieces(labels, count, np.asarray(gradient, dtype=np.float32))


def split(surface: Pieces, body: NDArray[np.bool_]) -> Pieces:
    """Pieces in which a moving and a resting piece of the last frame have met, as two.

    Args:
        surface: The pieces.
        body: (h, w) bool, pixels that belonged to a moving piece.
    """
    total = np.bincount(surface.labels.reshape(-1), minlength=surface.count + 1)
    part = np.bincount(surface.labels[body], minlength=surface.count + 1)
    mixed = np.minimum(part, total - part) >= np.maximum(SMALLEST, 0.2 * total)  # less is what came into view
    mixed[0] = False
    if not mixed.any():
        return surface
    number = np.zeros(surface.count + 1, dtype=np.int32)
    number[mixed] = np.arange(surface.count + 1, surface.count + 1 + np.count_nonzero(mixed))
    labels = np.where(body & mixed[surface.labels], number[surface.labels], surface.labels)
    return Pieces(labels, surface.count + int(np.count_nonzero(mixed)), surface.gradient)


def judge(
    surface: Pieces,
    used: NDArray[np.bool_],
    moving: NDArray[np.bool_],
    distance: NDArray[np.float32],
    sigma: NDArray[np.float32],
    difference: NDArray[np.float32],
) -> Verdict:
    """Evidence of each piece as a whole.

    Args:
        surface: The pieces.
        used: (h, w) bool, pixels whose distance and difference are known.
        moving: (h, w) bool, pixels that move by themselves.
        distance: (h, w) float32, metres; anything where not used.
        sigma: (h, w) float32, metres.
        difference: (h, w) float32, of intensities; anything where not used.
    """
    import cv2

    ones = used.astype(np.float32)
    mean = cv2.blur(np.where(used, difference, np.float32(0)), (3, 3)) / np.maximum(
        cv2.blur(ones, (3, 3)), np.float32(1e-3)
    )
    out = np.empty((surface.count + 1, 8))
    segmentation.sums(
        surface.labels, used, moving, distance, sigma, np.asarray(mean, np.float32), surface.gradient, out
    )
    size, known = np.maximum(out[:, 0], 1), np.maximum(out[:, 3], 1)
    texture = out[:, 6] / known
    return Verdict(
        out[:, 0], out[:, 1] / size, out[:, 2] / size, out[:, 3], out[:, 4] / known,
        out[:, 7] / known * texture / (texture + FLOOR) ** 2, texture,
    )  # fmt: skip


def moves_as_a_whole(verdict: Verdict, moved: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which pieces (count + 1,) move, all of each.

    A piece moves if nearly all of its pixels do by themselves. A piece that is not too large also moves if a part of it
    does and the rest fits badly, by its distances and intensities together and by more than is common in this frame;
    the larger the part, the less will do, and still less where it moved in the last frame: a thing does not move by
    halves.

    Args:
        verdict: Evidence of each piece.
        moved: (count + 1,) share of the pixels that moved in the last frame.
    """
    counted = np.flatnonzero((verdict.known > 0.5) & (verdict.size >= SMALLEST))
    resting = counted[verdict.moving[counted] < 0.5]
    shift = SHIFT * max(1.0, _usual(np.abs(verdict.shift[resting])) / ORDINARY_SHIFT)
    mismatch = MISMATCH * max(1.0, _usual(verdict.mismatch[resting]) / ORDINARY_MISMATCH)
    score = np.zeros(len(verdict.size))
    score[counted] = ((np.maximum(verdict.shift, 0) / shift) ** 2 + (verdict.mismatch / mismatch) ** 2)[counted]
    doubt = (verdict.shift / (0.35 * shift)) ** 2 + (verdict.mismatch / (0.7 * mismatch)) ** 2
    telling = (verdict.texture > FLOOR) & (verdict.rest >= 0.5 * SMALLEST)
    whole = (score >= 1) & (verdict.moving >= 0.1)
    whole |= np.where(telling, (verdict.moving >= 0.2) & (doubt >= 1), verdict.moving >= 0.6)
    whole |= (moved >= 0.7) & (verdict.moving >= 0.2) & (doubt >= 0.4)
    whole |= (moved >= 0.4) & (verdict.moving >= 0.4) & (doubt >= 0.5)
    whole &= verdict.size <= LARGEST * verdict.size[1:].sum()
    whole |= verdict.moving >= 0.8
    whole &= verdict.size >= SMALLEST
    whole[0] = False
    return whole


def _usual(values: NDArray[np.float64]) -> float:
    """What three of four values stay below; 0 if there is none."""
    return float(np.percentile(values, 75)) if len(values) else 0.0


class StandStill:
    """The last frames, to tell what moved a moment ago and what has stood still since.

    Args:
        config: ``settle_time``.
    """

    def __init__(self, config: DynamicsConfig) -> None:
        self.config = config
        self._now = 0.0
        self._last: _Memory | None = None
        self._memories: deque[_Memory] = deque()
        self._young_until = -np.inf
        self._views: list[_Memory] = []  # of the first seconds
        self._recent: deque[_Memory] = deque()  # of the last moments
        self._complete = False  # those of the first seconds come from another pass

    def start(self) -> None:
        """The frame that has begun is the first of a map."""
        self._young_until = self._now + YOUTH * self.config.start_seconds
        self._views = []
        self._recent.clear()

    def know(self, other: "StandStill", Ts_world_camera: dict[float, NDArray[np.float64]]) -> None:
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

    def begin(self, timestamp: float) -> None:
        """A new frame, of this time in seconds, is going to be labelled."""
        self._now = timestamp

    def remember(
        self,
        level: Level,
        T_world_camera: NDArray[np.float64],
        moving: NDArray[np.bool_],
        surface: Pieces | None,
    ) -> None:
        """Keep the frame, which was tracked, its labels (h, w) bool and its pieces."""
        marks = moving.astype(np.uint8)
        if surface is not None:
            marks[((surface.share(moving) >= 0.2) & (np.arange(surface.count + 1) > 0))[surface.labels]] |= BODY
        self._last = _Memory(self._now, level, T_world_camera, marks)
        if not self._memories or self._now - self._memories[-1].timestamp >= self.config.settle_time / MEMORIES:
            self._memories.append(self._last)
        if not self._recent or self._now - self._recent[-1].timestamp >= self.config.start_seconds / VIEWS:
            self._recent.append(self._last)
            if self._now < self._young_until and not self._complete:
                self._views.append(self._last)
        while self._now - self._recent[0].timestamp > self.config.start_seconds:
            self._recent.popleft()
        while len(self._memories) > 1 and self._now - self._memories[1].timestamp >= self.config.settle_time:
            self._memories.popleft()

    def forget(self) -> None:
        """Tracking was lost: what was seen before says nothing of what stood still meanwhile."""
        self._last = None
        self._memories.clear()
        self._recent.clear()
        self._views = self._views if self._complete else []

    def marks(self, level: Level, T_world_camera: NDArray[np.float64], reach: float) -> NDArray[np.uint8]:
        """What each pixel (h, w) was in the last frame, MOVED and BODY, if its point is nearer than ``reach`` (m)."""
        if self._last is None or not self._last.marks.any():
            return np.zeros(level.depth.shape, dtype=np.uint8)
        gap, _, marks = _against(level, T_world_camera, self._last)
        marks[~(np.abs(gap) < reach)] = 0
        return marks

    def views(
        self, level: Level, T_world_camera: NDArray[np.float64], noise: NDArray[np.float32], unknown: float = 0.0
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """What single frames of the last moments say of each pixel, while the map is young, or knows little of what is
        in view; else nothing.

        In the first seconds a second pass also asks the frames of the next moments.

        Args:
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
        if self._now < self._young_until:
            views = self._views if self._complete else self._recent
        else:
            views = self._recent if unknown >= UNKNOWN else ()
        asked = [view for view in views if 0 < abs(self._now - view.timestamp) <= self.config.start_seconds]
        answers = run_bands(lambda n, _: _against(level, T_world_camera, asked[n]), bands(len(asked), 1))
        for view, (gap, difference, _) in zip(asked, answers, strict=True):
            apart = abs(self._now - view.timestamp)
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
        level: Level,
        T_world_camera: NDArray[np.float64],
        surface: Pieces,
        sigma: NDArray[np.float32],
        moving: NDArray[np.bool_],
    ) -> NDArray[np.bool_]:
        """Pixels (h, w) of those called ``moving`` whose piece has been where it is for ``settle_time``."""
        nothing = np.zeros_like(moving)
        if not self._memories or self._now - self._memories[0].timestamp < self.config.settle_time or not moving.any():
            return nothing
        count = surface.count
        both = Pieces(surface.labels + np.where(moving, np.int32(count), np.int32(0)), 2 * count, surface.gradient)
        still = np.bincount(both.labels.reshape(-1), minlength=2 * count + 1) >= SMALLEST
        still[: count + 1] = False
        for memory in self._memories:
            gap, difference, _ = _against(level, T_world_camera, memory)
            known = ~np.isnan(gap)
            verdict = judge(both, known, known & (np.abs(np.nan_to_num(gap)) > 4 * sigma), gap, sigma, difference)
            counted = np.flatnonzero((verdict.known > 0.7) & (verdict.size >= SMALLEST))
            usual = max(ORDINARY_MISMATCH, _usual(verdict.mismatch[counted]))
            still &= (verdict.known > 0.7) & (verdict.moving < 0.1) & (np.abs(verdict.shift) < 1)
            still &= verdict.mismatch < 1.2 * usual
            if not still.any():
                return nothing
        return still[both.labels]


def _against(
    level: Level, T_world_camera: NDArray[np.float64], memory: _Memory
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
    shape = level.depth.shape
    out = (np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.uint8))
    T = (se3.inverse(memory.T_world_camera) @ T_world_camera)[:3].astype(np.float32)
    segmentation.against(  # in one piece: it takes no longer than waking a thread
        0, shape[0], level.depth, level.intensity, level.camera.intrinsics, T, memory.level.depth,
        memory.level.intensity, memory.marks, *out,
    )  # fmt: skip
    return out
