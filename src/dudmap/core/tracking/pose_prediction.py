"""Prediction of the camera pose, by constant velocity or by the ego-motion between two images."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.dynamics.dominant_motion import AGREED, DominantMotion, exceeds_noise_share
from dudmap.core.dynamics.ego_motion import EgoMotionSegmenter, ImagePose, Restart, SlowMotion
from dudmap.core.frames.observation import Level, is_majority_dynamic
from dudmap.core.geometry import se3
from dudmap.core.map.volume import FREE, UNKNOWN, TsdfVolume
from dudmap.core.state import Remembered, Stateful
from dudmap.core.tracking.frame_view import FrameView, PoseEstimate, initial_weights
from dudmap.core.tracking.motion_model import MotionModel
from dudmap.core.tracking.tracker import Tracker

CLEARLY_BETTER = 0.95
"""A pose explains an image clearly better than another one if its cost is below this share of the other cost."""
SAME_POSE = 0.01, 0.25
"""Poses nearer to each other than this (reference depths, deg) count as equal: registrations from them agree."""


@dataclass(frozen=True, eq=False)
class PosePrediction:
    """Initial pose of a registration, and the scene motion visible in two images.

    Attributes:
        T_world_camera: (4, 4).
        image_pose: Computes the pose (4, 4) by the ego-motion since the previous image; None if unknown.
        image_motion: Computes this ego-motion with its labelled corners; None if unknown.
        moving: (h, w) bool, label resolution, pixels that do not follow the ego-motion; None if not computed.
        slow: (h, w) bool, the part of ``moving`` found with an older image; None without comparison.
        moving_before: (h, w) bool, moving pixels of the map's first image if that is compared; else None.
        unverified_mask: (h, w) bool, pixels not verified as static while most of the view moves; else None.
        restart: New start of a young map whose camera has followed a crowd; else None.
    """

    T_world_camera: NDArray[np.float64]
    image_pose: ImagePose
    image_motion: Callable[[], DominantMotion | None]
    moving: NDArray[np.bool_] | None = None
    slow: NDArray[np.bool_] | None = None
    moving_before: NDArray[np.bool_] | None = None
    unverified_mask: NDArray[np.bool_] | None = None
    restart: Restart | None = None


class PosePredictor(Stateful):
    """Predicts by constant velocity, and by ego-motion while the map is young or most of the view is dynamic.

    Args:
        config: All parameters.
        motion: Velocity of the camera.
        tracker: Evaluates the cost of a pose.
        known_poses: Poses (4, 4) by timestamp from a first pass over the recording.

    Attributes:
        mostly_slow: Whether most of the view moves, but only in comparison with an older image. Pixels not verified as
            static may then move as well; they are neither registered nor fused.
    """

    ego_motion: Remembered[EgoMotionSegmenter]
    mostly_slow: Remembered[bool] = False
    _single_frame_map: Remembered[bool] = False  # the map consists of one frame, whose dynamic pixels are unknown
    _dynamic_start: Remembered[bool] = False  # most of the view has moved in every frame so far
    _mostly_moving: Remembered[bool] = False  # most of the view moved in the last frame
    _looked_back: Remembered[bool] = False  # an older image showed no motion in the last frame

    def __init__(
        self, config: Config, motion: MotionModel, tracker: Tracker, known_poses: Mapping[float, NDArray[np.float64]]
    ) -> None:
        self.motion = motion
        self.tracker = tracker
        self.ego_motion = EgoMotionSegmenter(config.dynamics.start_seconds if config.dynamics.enabled else 0.0)
        self._known_poses = known_poses
        self.same_pose = SAME_POSE[0] * config.sensor.reference_depth, SAME_POSE[1]

    def start(self, view: FrameView) -> None:
        """Begin with the first frame of a map."""
        self.ego_motion.start(view.timestamp)
        self._single_frame_map = self._dynamic_start = True

    def is_mostly_dynamic(self, view: FrameView, last_dynamic: NDArray[np.bool_] | None) -> bool:
        """Whether most of the view has moved since the start of the map, or in the last tracked frame.

        ``last_dynamic``: its dynamic pixels (h, w), None for none.
        """
        return self._dynamic_start or (last_dynamic is not None and is_majority_dynamic(last_dynamic, view.labelled))

    def ambiguity(self, view: FrameView, prediction: PosePrediction, estimate: PoseEstimate) -> str:
        """Reason to distrust the labels of a tracked frame, empty if there is none.

        In a young map, motion below MOVES_PX between consecutive images cannot be separated from camera motion. If
        something moves, more of the view may move slowly and drag the camera. Exception: if most of the view moves, the
        rest has been verified corner by corner (``unverified_mask``).
        """
        if not self.ego_motion.slow_motion_is_hidden(view.timestamp):
            return ""
        moving = np.zeros(view.labelled.depth.shape, bool)
        for mask in (prediction.moving, None if estimate.labels is None else estimate.labels.dynamic):
            moving = moving if mask is None else moving | mask
        verified = prediction.unverified_mask is not None and not self.mostly_slow
        if verified or not exceeds_noise_share(moving, view.labelled):
            return ""
        return "something moves, and the map is too young to show other moving objects"

    def predict(
        self, volume: TsdfVolume, view: FrameView, previously_dynamic: NDArray[np.bool_] | None
    ) -> PosePrediction:
        """Initial pose for the registration of a frame to a map.

        ``previously_dynamic``: (h, w) bool, dynamic pixels of the previous frame; None for none.
        """
        timestamp, pyramid = view.timestamp, view.pyramid
        if self._known_poses and not self.ego_motion.started:
            self.ego_motion.start(timestamp)
        T_expected = self._known_poses.get(timestamp, self.motion.predict(timestamp))
        was_slow, was_moving = self.mostly_slow, self._mostly_moving
        self.mostly_slow = self._mostly_moving = False
        by_velocity = PosePrediction(
            T_expected, lambda: self._image_pose(self._ego_motion(view)), lambda: self._ego_motion(view)
        )
        if not self.ego_motion.active:
            return by_velocity
        with view.timer("parallax"):
            motion = self._ego_motion(view)
            T_image = self._image_pose(motion)
            if motion is None or T_image is None:
                return by_velocity
            slow = self._slow_motion(view, T_image, motion.moving_after, previously_dynamic if was_slow else None)
            known = timestamp in self._known_poses or self.motion.is_given
            if known:
                T_image = T_expected
            elif slow is not None:
                T_image = T_image if was_slow else slow.T_world_camera  # known moving pixels mislead no corner
            elif not self._single_frame_map and self.fits_better(
                volume, T_expected, T_image, pyramid.coarse, previously_dynamic
            ):
                return by_velocity  # the dominant motion is the motion of the dynamic objects
            moving_before = motion.moving_before if self._single_frame_map else None
            self._single_frame_map = False
            moving = motion.moving_after
            if slow is not None:
                moving, moving_before = moving | slow.moving, slow.moving_first
            young = self.ego_motion.map_is_young(timestamp)
            unverified = self._watch_crowd(view, motion, slow, moving, was_moving=was_moving)
            restart = None
            if young and unverified is not None and not known:
                crowd = unverified if self.mostly_slow else moving
                restart = self.ego_motion.restart(view.tracked_at(T_image), crowd, self.same_pose)
            if not young:  # a known map labels better than two images
                moving = moving & (_occupancy(volume, view.labelled, T_image) == UNKNOWN)
        slowly = None if slow is None else slow.moving
        return replace(
            by_velocity, T_world_camera=T_image, moving=moving, slow=slowly, moving_before=moving_before,
            unverified_mask=unverified, restart=restart,
        )  # fmt: skip

    def _watch_crowd(
        self,
        view: FrameView,
        motion: DominantMotion,
        slow: SlowMotion | None,
        moving: NDArray[np.bool_],
        *,
        was_moving: bool,
    ) -> NDArray[np.bool_] | None:
        """Record whether most of the view moves, by the pixels ``moving`` (h, w) bool, and whether slowly.

        A single comparison of two images may be wrong. A fast crowd is therefore accepted in its second frame
        (``was_moving`` in the last one), or if it lasts since the start of the map.

        Returns:
            The pixels (h, w) bool not verified as static if most of the view moves, else None.
        """
        young = self.ego_motion.map_is_young(view.timestamp)
        self._mostly_moving = is_majority_dynamic(moving, view.labelled)
        self._dynamic_start = self._dynamic_start and young and self._mostly_moving
        lasts = self._dynamic_start or (was_moving and self._mostly_moving)
        if slow is not None and is_majority_dynamic(slow.moving, view.labelled):
            self.mostly_slow = True
            return ~slow.static
        return ~motion.static_after | moving if young and lasts else None

    def update(self, view: FrameView, estimate: PoseEstimate) -> None:
        """Set the image for the next comparison: a frame with an accepted pose."""
        if self.ego_motion.seconds == 0:
            return
        with view.timer("parallax"):
            dynamic = None if estimate.labels is None or not estimate.labels.dynamic.any() else estimate.labels.dynamic
            gain, _ = estimate.exposure
            image = view.tracked_at(estimate.T_world_camera, moving=dynamic, blind=view.without_image, gain=gain)
            self.ego_motion.update(image)

    def _slow_motion(
        self,
        view: FrameView,
        T_world_camera: NDArray[np.float64],
        moving: NDArray[np.bool_],
        crowd: NDArray[np.bool_] | None,
    ) -> SlowMotion | None:
        """Comparison with an older image, if it shows more motion than the last one.

        Motion below MOVES_PX between consecutive images counts as static and drags the pose. Rules:

        * If most of the view moves, no older image is compared, because few corners would be found again.
        * If an older image shows nothing about a slow crowd, the crowd is assumed to move on.
        * While nothing moves, every second frame is compared.

        ``T_world_camera`` (4, 4) and ``moving`` (h, w) are pose and moving pixels by the last image. ``crowd``: moving
        pixels of the last image if most of them moved slowly; else None.
        """
        if crowd is None and is_majority_dynamic(moving, view.labelled):
            return None
        looked_back, self._looked_back = self._looked_back, False
        if looked_back and crowd is None and not exceeds_noise_share(moving, view.labelled):
            return None
        slow = self.ego_motion.slow_motion(view.tracked_at(T_world_camera))
        if crowd is None:
            shows = slow is not None and exceeds_noise_share(slow.moving & ~moving, view.labelled)
            self._looked_back = slow is not None and not shows
            return slow if shows else None
        if slow is not None:
            return slow
        segments = view.segmentation()
        moves = segments.share(crowd) >= AGREED
        moves[0] = False
        moves = moves[segments.labels]
        return SlowMotion(T_world_camera, moves, ~moves, moving_first=None)

    def _ego_motion(self, view: FrameView) -> DominantMotion | None:
        if self.ego_motion.seconds == 0:
            return None
        with view.timer("parallax"):
            T_world_camera = self.motion.predict(view.timestamp)
            T_expected = se3.inverse(T_world_camera) @ self.motion.T_world_camera
            return self.ego_motion.compare(view.tracked_at(T_world_camera), T_expected)

    def _image_pose(self, motion: DominantMotion | None) -> NDArray[np.float64] | None:
        return None if motion is None else self.motion.T_world_camera @ se3.inverse(motion.T_after_before)

    def fits_better(
        self,
        volume: TsdfVolume,
        T: NDArray[np.float64],
        T_other: NDArray[np.float64],
        level: Level,
        previously_dynamic: NDArray[np.bool_] | None,
    ) -> bool:
        """Whether a pose explains the image clearly better than another one, without measurements in free space."""
        weights = initial_weights([level], previously_dynamic, []) or [np.ones_like(level.depth)]
        static = np.where(_occupancy(volume, level, T) == FREE, np.float32(0), weights[0])
        cost, other = (self.tracker.linearize(volume, level, pose, static).cost for pose in (T, T_other))
        return cost < CLEARLY_BETTER * other


def _occupancy(volume: TsdfVolume, level: Level, T_world_camera: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Occupancy (h, w) of the map at the points of an image: UNKNOWN, SURFACE or FREE."""
    volume.look_at(T_world_camera)
    return volume.sample(level.depth, level.intensity, level.camera, T_world_camera).occupancy
