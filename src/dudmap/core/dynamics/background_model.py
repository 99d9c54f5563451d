"""The static background behind pixels without a reading: objects too near, too dark, or in a shadow of the sensor."""

import numpy as np
from numpy.typing import NDArray

from dudmap.config import DynamicsConfig
from dudmap.core.backends.cpu.splatting import PointImage, overwrite, splat
from dudmap.core.dynamics.segments import scaled_length
from dudmap.core.frames.observation import Level
from dudmap.core.geometry import se3
from dudmap.core.state import Remembered, Stateful

SAME_INTENSITY = 0.15
"""Largest difference of a pixel's intensity to those of the background around it."""
MIN_AGE = 0.3
"""Time for which a surface must have been seen to be background, seconds."""
VOTING_SIDE = 7
"""Side of the square in which pixels without a reading vote, subsampled pixels."""
MIN_KNOWN = 0.2
"""Share of that square behind which the background must be known."""
STRIDE = 2
"""Pixels of the label image per subsampled pixel, across and down, at REFERENCE_WIDTH."""
SQUARE = np.ones((3, 3), np.uint8)
MIN_AREA = 0.005
"""Smallest region without readings that is examined, as a share of the image."""


class BackgroundModel(Stateful):
    """The last static reading of every pixel, as a point in the world that is carried from image to image.

    An object that gives no reading hides the background known to be behind it, and looks different; the sensor's own
    shadow, a screen or a window looks as the background did.

    Args:
        config: ``settle_time``: background that has not been seen for longer is dropped.
    """

    _background: Remembered[PointImage | None] = None

    def __init__(self, config: DynamicsConfig) -> None:
        self.config = config

    def reset(self) -> None:
        """Drop the background: it belongs to another world, or the pose was lost."""
        self._background = None

    def hidden(self, timestamp: float, level: Level, T_world_camera: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Pixels (h, w) without a reading in front of known background.

        A pixel without a reading votes if the background is known within 3x3 pixels, and votes for hidden if its
        intensity lies outside of the range of the background's there, extended by SAME_INTENSITY. A pixel is hidden
        by majority within VOTING_SIDE, where at least MIN_KNOWN of the pixels vote.

        Args:
            timestamp: Seconds.
            level: The image, with the exposure of the map.
            T_world_camera: (4, 4).
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
        """Replace the background by the static readings of an image.

        Args:
            timestamp: Seconds.
            level: The image, with the exposure of the map.
            T_world_camera: (4, 4).
            dynamic: (h, w) bool, pixels whose readings are left out.
        """
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
        """The background in an image at a pose, subsampled by a stride."""
        if self._background is None:
            return PointImage.empty(level.depth[::stride, ::stride].shape)
        since, intrinsics = timestamp - self.config.settle_time, level.camera.intrinsics / np.float32(stride)
        return splat(self._background, se3.inverse(T_world_camera), intrinsics, since)


def _subsampled(level: Level, stride: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth of one pixel per stride across and down, and mean intensity around it."""
    import cv2

    depth = level.depth[::stride, ::stride]
    return depth, np.asarray(cv2.resize(level.intensity, depth.shape[::-1], interpolation=cv2.INTER_AREA), np.float32)


def _stride(level: Level) -> int:
    """Pixels of the label image per subsampled pixel: subsampled images are about 80 pixels wide."""
    return scaled_length(STRIDE, level)
