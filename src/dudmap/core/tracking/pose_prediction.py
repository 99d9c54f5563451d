"""Prediction of the camera pose, by constant velocity or by the motion between two images."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.dynamics.dominant_motion import DominantMotion
from dudmap.core.dynamics.image_motion import ImageMotion, ImagePose
from dudmap.core.frames.observation import Level, is_majority_dynamic
from dudmap.core.geometry import se3
from dudmap.core.map.volume import FREE, UNKNOWN, TsdfVolume
from dudmap.core.state import Remembered, Stateful
from dudmap.core.tracking.frame_view import FrameView, PoseEstimate, initial_weights
from dudmap.core.tracking.motion_model import MotionModel
from dudmap.core.tracking.tracker import Tracker

CLEARLY_BETTER = 0.95
"""Largest cost of a clearly better pose, as a share of the other cost."""


@dataclass(frozen=True, eq=False)
class PosePrediction:
    """Initial pose of a registration, and scene motion between two images.

    Attributes:
        T_world_camera: (4, 4).
        image_pose: Computes the pose (4, 4) by the motion since the previous image.
        image_motion: Computes this motion with its labelled corners.
        moving: (h, w) bool, label resolution, pixels that do not follow the camera's motion; None if not computed.
        undecided: (h, w) bool, pixels not verified as static while most of the view moves; None for none.
    """

    T_world_camera: NDArray[np.float64]
    image_pose: ImagePose
    image_motion: Callable[[], DominantMotion | None]
    moving: NDArray[np.bool_] | None = None
    undecided: NDArray[np.bool_] | None = None

    @classmethod
    def known(
        cls,
        T_world_camera: NDArray[np.float64],
        moving: NDArray[np.bool_] | None,
        undecided: NDArray[np.bool_] | None,
    ) -> "PosePrediction":
        """A prediction without comparison to the previous image."""
        return cls(T_world_camera, lambda: None, lambda: None, moving, undecided)


class PosePredictor(Stateful):
    """Predicts by constant velocity, and by image motion while the map is young or the view mostly dynamic.

    Args:
        config: All parameters.
        motion: Velocity of the camera.
        tracker: Evaluates the cost of a pose.
        known_poses: Poses (4, 4) by timestamp from a first pass.
    """

    image_motion: Remembered[ImageMotion]
    mostly_dynamic: Remembered[bool] = False  # most of the view moved in the last tracked frame
    _single_frame_map: Remembered[bool] = False  # the map consists of one frame, whose dynamic pixels are unknown

    def __init__(
        self, config: Config, motion: MotionModel, tracker: Tracker, known_poses: Mapping[float, NDArray[np.float64]]
    ) -> None:
        self.motion = motion
        self.tracker = tracker
        self.image_motion = ImageMotion(config.dynamics.start_seconds if config.dynamics.enabled else 0.0)
        self._known_poses = known_poses

    def start(self, timestamp: float) -> None:
        """Begin with the first frame of a map."""
        self.image_motion.start(timestamp)
        self._single_frame_map = True

    def predict(self, volume: TsdfVolume, view: FrameView) -> PosePrediction:
        """Initial pose for the registration of a frame."""
        timestamp = view.timestamp
        if self._known_poses and not self.image_motion.started:
            self.image_motion.start(timestamp)
        T_expected = self._known_poses.get(timestamp, self.motion.predict(timestamp))
        by_velocity = PosePrediction(
            T_expected, lambda: self._image_pose(self._compare(view)), lambda: self._compare(view)
        )
        if not self.image_motion.active:
            return by_velocity
        with view.timer("parallax"):
            motion = self._compare(view)
            T_image = self._image_pose(motion)
            if motion is None or T_image is None:
                return by_velocity
            if timestamp in self._known_poses or self.motion.is_given:
                T_image = T_expected
            elif not self._single_frame_map and self._fits_better(volume, T_expected, T_image, view.pyramid.coarse):
                return by_velocity  # the common motion of the images is that of the dynamic objects
            self._single_frame_map = False
            moving, undecided = motion.moving_after, None
            if self.mostly_dynamic and is_majority_dynamic(moving, view.labelled):
                undecided = ~motion.static_after
            if not self.image_motion.map_is_young(timestamp):  # a known map labels better than two images
                moving = moving & (_occupancy(volume, view.labelled, T_image) == UNKNOWN)
                undecided = None
        return replace(by_velocity, T_world_camera=T_image, moving=moving, undecided=undecided)

    def update(self, view: FrameView, estimate: PoseEstimate) -> None:
        """Set the image for the next comparison."""
        dynamic = None if estimate.labels is None or not estimate.labels.dynamic.any() else estimate.labels.dynamic
        self.mostly_dynamic = dynamic is not None and is_majority_dynamic(dynamic, view.labelled)
        if self.image_motion.seconds > 0:
            with view.timer("parallax"):
                self.image_motion.update(view.tracked_at(
                    estimate.T_world_camera, moving=dynamic, blind=view.without_image, gain=estimate.exposure[0]
                ))  # fmt: skip

    def _fits_better(
        self, volume: TsdfVolume, T: NDArray[np.float64], T_other: NDArray[np.float64], level: Level
    ) -> bool:
        """Whether T explains the image clearly better, without measurements in free space."""
        last = self.image_motion.last
        weights = initial_weights([level], None if last is None else last.moving, []) or [np.ones_like(level.depth)]
        static = np.where(_occupancy(volume, level, T) == FREE, np.float32(0), weights[0])
        cost, other = (self.tracker.linearize(volume, level, pose, static).cost for pose in (T, T_other))
        return cost < CLEARLY_BETTER * other

    def _compare(self, view: FrameView) -> DominantMotion | None:
        if self.image_motion.seconds == 0:
            return None
        with view.timer("parallax"):
            T_world_camera = self.motion.predict(view.timestamp)
            T_expected = se3.inverse(T_world_camera) @ self.motion.T_world_camera
            return self.image_motion.compare(view.tracked_at(T_world_camera), T_expected)

    def _image_pose(self, motion: DominantMotion | None) -> NDArray[np.float64] | None:
        return None if motion is None else self.motion.T_world_camera @ se3.inverse(motion.T_after_before)


def _occupancy(volume: TsdfVolume, level: Level, T_world_camera: NDArray[np.float64]) -> NDArray[np.uint8]:
    volume.look_at(T_world_camera)
    return volume.sample(level.depth, level.intensity, level.camera, T_world_camera).occupancy
