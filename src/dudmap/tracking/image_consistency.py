"""Comparison of a registered frame with the last one, whatever the map is and whatever the registration weighs.

A camera that jumps may converge to a wrong pose that fits the map. The last image, seen from there, then shows
something else. Shape alone does not tell: walls and desks resemble each other, their texture does not.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.dynamics.detector import depth_tolerance, distance_sigma
from dudmap.frames.exposure import LARGE_GAIN, fit_exposure
from dudmap.frames.observation import Level
from dudmap.frames.pyramid import reduced
from dudmap.geometry import se3
from dudmap.kernels.median import median
from dudmap.kernels.reprojection import ReprojectionTarget, reproject
from dudmap.tracking.estimate import PoseEstimate
from dudmap.tracking.frame_view import FrameView
from dudmap.tracking.motion_model import MotionModel

MAX_MISREGISTRATION = 1.0
"""Largest misregistration of two images by a right pose, pixels of the coarsest level: a registration that is farther
off has not converged on any level."""
ImagePose = Callable[[], NDArray[np.float64] | None]
"""Pose (4, 4) that the ego-motion between two images predicts; None if it is not known."""
CLEARLY_LESS = 0.5
"""Another motion explains two images clearly better if its misregistration is below this share of the other: both are
known up to what noise and blur add to them, half a pixel in the median frame of a hand-held camera."""
MIN_PIXELS = 100
"""Pixels of the coarsest level that must show the same static surface in both images."""
MIN_CORNERS = 60
"""Corners of an image from which on a motion that most of them follow would be found: four times those it needs."""


class ImageConsistency:
    """Measures how well the motion since the last frame explains the two images.

    Args:
        config: Noise of the sensor. Without ``dynamics.start_seconds`` images are never compared, nor are they here.
        motion: Knows the pose of the last accepted frame.
    """

    def __init__(self, config: Config, motion: MotionModel) -> None:
        self.sensor = config.sensor
        self._enabled = config.dynamics.method == "em" and config.dynamics.start_seconds > 0
        self.motion = motion
        self._last: tuple[Level, NDArray[np.uint8]] | None = None  # coarsest level and its dynamic pixels
        self._gain = 1.0  # of the exposure of the last frame

    def update(self, view: FrameView, estimate: PoseEstimate) -> None:
        """Compare the next frame with this one, whose pose is accepted."""
        level = view.pyramid.coarse
        self._last = None if view.blind or not self._enabled else (level, _dynamic(estimate, level).astype(np.uint8))
        self._gain = estimate.exposure[0]

    def contradicts(self, view: FrameView, estimate: PoseEstimate, image_pose: ImagePose) -> str:
        """Sentence if the last image contradicts the pose of a frame, empty if not.

        It does if it is more than MAX_MISREGISTRATION beside this one, and the corners of the two images follow no
        common motion, or one that explains the images clearly better. Blur alone moves corners and images alike. That
        corners are not found again where the exposure has changed suddenly says nothing.

        Args:
            view: The frame.
            estimate: Its pose and labels.
            image_pose: Computes the pose (4, 4) that the corners predict; None if they follow no common motion.
        """
        if view.blind:
            return ""
        distance = self.misregistration(view, estimate, estimate.T_world_camera)
        if not distance > MAX_MISREGISTRATION:
            return ""
        T_image = image_pose()
        if T_image is None:
            change = estimate.exposure[0] / self._gain
            if len(view.pyramid.corners) < MIN_CORNERS or max(change, 1 / change) > LARGE_GAIN:
                return ""
            return f"the last image lies {distance:.1f} coarse pixels beside this one, and no motion joins them"
        other = self.misregistration(view, estimate, T_image)
        if other < CLEARLY_LESS * distance:
            return f"the last image lies {distance:.1f} coarse pixels beside this one, {other:.1f} at the motion seen"
        return ""

    def reset(self) -> None:
        """Forget the last frame: a new map begins."""
        self._last = None

    def misregistration(self, view: FrameView, estimate: PoseEstimate, T_world_camera: NDArray[np.float64]) -> float:
        """Distance by which a pose puts the static pixels of the last image beside those of this one, coarse pixels.

        A shift by d pixels in a random direction changes intensities by the mean square d^2 |grad I|^2 / 2, so

            d = sqrt(2) median |I_last - I| / median |grad I|

        over pixels that show the same surface in both images, after the best gain and offset. What does not resemble at
        all gives the correlation length of the texture, a few pixels.

        Args:
            view: This frame.
            estimate: Its labels.
            T_world_camera: (4, 4) a pose of this frame.

        Returns:
            NaN where too few pixels are common, or the last image is not known.
        """
        if self._last is None:
            return np.nan
        level, (last, marks) = view.pyramid.coarse, self._last
        T_last_camera = se3.inverse(self.motion.T_world_camera) @ T_world_camera
        target = ReprojectionTarget(T_last_camera, last.depth, last.intensity, marks)
        seen = reproject(level.depth, level.intensity, level.camera.intrinsics, [target])[0]
        tolerance = depth_tolerance(distance_sigma(self.sensor, level.depth, 0.0), level)
        common = (np.abs(seen.gap) < tolerance) & (seen.marks == 0) & ~_dynamic(estimate, level)
        if np.count_nonzero(common) < MIN_PIXELS:
            return np.nan
        gain, offset = fit_exposure(level.intensity, seen.difference, common.astype(np.float32))
        difference = seen.difference + np.float32(1 - gain) * level.intensity - np.float32(offset)
        down, across = np.gradient(level.intensity)
        contrast = float(median(np.sqrt(down**2 + across**2)[common]))
        return float(np.sqrt(2) * median(np.abs(difference[common])) / contrast) if contrast > 0 else np.nan


def _dynamic(estimate: PoseEstimate, level: Level) -> NDArray[np.bool_]:
    """Dynamic pixels (h, w) of a frame at the size of a level."""
    return np.zeros(level.depth.shape, bool) if estimate.labels is None else reduced(estimate.labels.dynamic, level)
