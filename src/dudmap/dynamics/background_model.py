"""What the static world looked like where a sensor reads nothing now: too near, too dark, in a shadow of its light."""

import numpy as np
from numpy.typing import NDArray

from dudmap.config import DynamicsConfig
from dudmap.frames.observation import Level
from dudmap.geometry import se3
from dudmap.kernels import splatting

DIFFERENT = 0.15
"""Intensities that differ by more, from all around, are not of the same thing."""
RESTED = 0.3
"""What has not been read at its place for this long, seconds, may be a passer-by."""
AROUND = 7
"""Side of the square in which pixels without a reading decide together, pixels that are asked."""
KNOWN = 0.2
"""Share of them behind which the world must be known."""
STRIDE = 2
"""Every so many pixels of the image are asked, across and down."""
SMALLEST = 0.005
"""Share of the image that is left out if nothing larger is hidden."""


class BackgroundModel:
    """The last static reading of every pixel, as a point in the world that is carried from image to image.

    A thing that gives no reading hides what is known to be behind it: its pixels look unlike that. A shadow of the
    sensor's own light, a screen and a window look as they did.

    Args:
        config: ``settle_time``; what has not been read for longer is not known any more.
    """

    def __init__(self, config: DynamicsConfig) -> None:
        self.config = config
        self._known: splatting.PointImage | None = None

    def reset(self) -> None:
        """What was seen is in another world, or nobody knows where."""
        self._known = None

    def hidden(self, timestamp: float, level: Level, T_world_camera: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Pixels (h, w) without a reading that look unlike the static world behind them.

        Args:
            timestamp: Seconds.
            level: The image, its intensities as the map has them.
            T_world_camera: (4, 4).
        """
        import cv2

        depth, intensity = _asked(level)
        nothing = np.zeros(level.depth.shape, dtype=bool)
        if self._known is None:
            return nothing
        _, shades, times = self._seen_from(timestamp, level, (depth.shape[0], depth.shape[1]), T_world_camera)
        farthest = cv2.dilate(level.depth, np.ones((STRIDE, STRIDE), np.uint8))
        hole = farthest[STRIDE - 1 :: STRIDE, STRIDE - 1 :: STRIDE] <= 0
        missing = np.isnan(shades)
        square = np.ones((3, 3), np.uint8)
        darkest = cv2.erode(np.where(missing, np.float32(9), shades), square)
        brightest = cv2.dilate(np.where(missing, np.float32(-9), shades), square)
        rested = ~missing & (times[..., 1] - times[..., 0] >= RESTED)
        known = hole & (cv2.dilate(rested.astype(np.uint8), square) > 0)
        limit = np.float32(DIFFERENT)
        unlike = known & ((intensity < darkest - limit) | (intensity > brightest + limit))
        solid = cv2.morphologyEx(unlike.astype(np.uint8), cv2.MORPH_OPEN, square)  # not the seam along an edge
        if not solid.any():
            return nothing
        votes = cv2.blur(solid.astype(np.float32), (AROUND, AROUND))
        asked = cv2.blur(known.astype(np.float32), (AROUND, AROUND))
        hidden = (hole & (asked >= np.float32(KNOWN)) & (votes > np.float32(0.5) * asked)).astype(np.uint8)
        _, numbers, stats, _ = cv2.connectedComponentsWithStats(hidden, connectivity=4)
        large = stats[:, cv2.CC_STAT_AREA] >= SMALLEST * hidden.size
        large[0] = False
        found = large[np.asarray(numbers, np.int32)].astype(np.uint8)
        found = cv2.resize(found, nothing.shape[::-1], interpolation=cv2.INTER_NEAREST)
        return (found > 0) & (level.depth <= 0)

    def update(
        self, timestamp: float, level: Level, T_world_camera: NDArray[np.float64], moving: NDArray[np.bool_]
    ) -> None:
        """Take over the readings of an image that rest; ``moving`` (h, w) bool do not."""
        depth, intensity = _asked(level)
        self._known = self._seen_from(timestamp, level, (depth.shape[0], depth.shape[1]), T_world_camera)
        splatting.overwrite(
            self._known, depth, intensity, ~moving[::STRIDE, ::STRIDE], timestamp, T_world_camera, _intrinsics(level)
        )

    def _seen_from(
        self, timestamp: float, level: Level, shape: tuple[int, int], T_world_camera: NDArray[np.float64]
    ) -> splatting.PointImage:
        """The known points as the image's camera sees them."""
        if self._known is None:
            return splatting.PointImage.empty(shape)
        since = timestamp - self.config.settle_time
        return splatting.splat(self._known, se3.inverse(T_world_camera), _intrinsics(level), since)


def _asked(level: Level) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth of the pixels that are asked, and intensity around them."""
    import cv2

    depth = level.depth[::STRIDE, ::STRIDE]
    return depth, np.asarray(cv2.resize(level.intensity, depth.shape[::-1], interpolation=cv2.INTER_AREA), np.float32)


def _intrinsics(level: Level) -> NDArray[np.float32]:
    return level.camera.intrinsics / np.float32(STRIDE)
