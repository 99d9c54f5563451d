"""Registration and labelling of a frame in alternation (thesis algorithm 4)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.backends.cpu.exposure import LARGE_GAIN
from dudmap.core.backends.median import median
from dudmap.core.dynamics.cue import Cue
from dudmap.core.dynamics.detector import NONE, DynamicDetector
from dudmap.core.dynamics.dominant_motion import AGREED, exceeds_noise_share
from dudmap.core.dynamics.image_motion import TrackedImage
from dudmap.core.dynamics.masks import Labels
from dudmap.core.frames.observation import is_majority_dynamic, reduced
from dudmap.core.geometry.se3 import agree
from dudmap.core.map.volume import SURFACE, TsdfVolume
from dudmap.core.shed import Shed
from dudmap.core.state import Remembered, Stateful
from dudmap.core.tracking.color_motion import ColorMotion, gain_discount, motion_discount
from dudmap.core.tracking.frame_view import FrameView, PoseEstimate, initial_weights, static_weights
from dudmap.core.tracking.motion_model import MotionModel
from dudmap.core.tracking.pose_prediction import CLEARLY_BETTER, PosePrediction
from dudmap.core.tracking.quality_monitor import QualityMonitor
from dudmap.core.tracking.tracker import MEDIAN_STRIDE, Minimum, Tracker, TrackingResult
from dudmap.core.verdict import Verdict
from dudmap.core.young_map import SAME_POSE

NO_CHANCE = 3
"""Excess of improved over worsened measurements, in standard deviations of chance."""
UNCHANGED_SHARE = 0.02
"""Largest share of changed labels on the map for registration at the finest level alone."""


class FrontEnd(Stateful):
    """Registers frames to a map and labels their dynamic pixels.

    Args:
        config: All parameters.
        tracker: Registers an image pyramid.
        detector: Labels a registered image.
        motion: Velocity of the camera.
        monitor: Provides the residuals of previous frames.
        color_motion: Registers colours with the camera's motion.
        cues: Further evidence of motion.

    Attributes:
        last_dynamic: (h, w) bool, dynamic pixels of the last accepted frame; None for none.
    """

    last_dynamic: Remembered[NDArray[np.bool_] | None] = None
    _brightness: Remembered[float | None] = None  # mean intensity of the last tracked image in the exposure of the map

    def __init__(
        self,
        config: Config,
        tracker: Tracker,
        detector: DynamicDetector,
        motion: MotionModel,
        monitor: QualityMonitor,
        color_motion: ColorMotion,
        cues: Sequence[Cue] = (),
    ) -> None:
        self.cues = cues
        self.config = config
        self.tracker = tracker
        distances_only = config.tracker.model_copy(update={"color_weight": 0.0, "exposure": False})
        self.blind_tracker = Tracker(distances_only, config.sensor, config.preprocess.smoothing_px)
        self.detector = detector
        self.motion = motion
        self.monitor = monitor
        self.color_motion = color_motion

    def judged(
        self, volume: TsdfVolume, view: FrameView, prediction: PosePrediction, last: TrackedImage | None
    ) -> tuple[FrameView, PoseEstimate, Verdict]:
        """A frame, its pose and labels, and the outcome of the checks.

        A rejected frame is judged once more:

        * with undecided pixels: registered with them;
        * after a change of light: by its distances alone, because the change differs between places;
        * else: at the pose by the corners of the last image, if these clearly follow one motion.
        """
        estimate = self.register(volume, view, prediction)
        verdict = self.monitor.judge(last, view, estimate, prediction.image_pose)
        if verdict.accepted or view.blind:
            return view, estimate, verdict
        if prediction.undecided is not None:
            other_view = view
            other = self.register(volume, view, replace(prediction, undecided=None))
        elif self._brightness is not None and self._is_relit(view):
            other_view = replace(view, blind=True)
            other = self.register(volume, other_view, prediction)
        elif (T_image := self._clear_image_pose(view, prediction)) is not None:
            other_view = view
            other = self.at_given(volume, view, replace(prediction, T_world_camera=T_image))
            other = replace(other, from_corners=True)
        else:
            return view, estimate, verdict
        judged = self.monitor.judge(last, other_view, other, prediction.image_pose)
        accepted = judged.accepted and other.is_observed
        return (other_view, other, judged) if accepted else (view, estimate, verdict)

    def _is_relit(self, view: FrameView) -> bool:
        """Whether the mean intensity shows another light than the map."""
        mean = float(view.pyramid.coarse.intensity.mean())
        return self._brightness is None or not mean / LARGE_GAIN < self._brightness < LARGE_GAIN * mean

    def register(self, volume: TsdfVolume, view: FrameView, prediction: PosePrediction) -> PoseEstimate:
        """Pose and labels of a frame, starting at its predicted pose.

        A registration that fits unusually badly, or did not converge and moved far, is repeated from the ego-motion
        between the last two images, without the pixels that do not follow it. The better fit is returned. The usual
        cause is a near person who starts walking and drags the camera: the floor fits the map at any position.
        """
        if self.motion.is_given:
            return self.at_given(volume, view, prediction)
        estimate = self.register_from(volume, view, prediction, prediction.T_world_camera)
        if not estimate.is_observed:  # along these directions, a registration keeps its initial pose
            T_image = self._clear_image_pose(view, prediction)
            if T_image is not None:
                estimate = replace(self.register_from(volume, view, prediction, T_image), from_corners=True)
            return estimate
        tracking = estimate.tracking
        same_pose = SAME_POSE[0] * self.config.sensor.reference_depth, SAME_POSE[1]
        arrived = tracking.converged or agree(prediction.T_world_camera, tracking.T_world_camera, *same_pose)
        if arrived and not self.monitor.is_unusual(tracking):
            return estimate
        T_image, motion = prediction.image_pose(), prediction.image_motion()
        if T_image is None or motion is None:
            return estimate
        moving = motion.moving_after if prediction.moving is None else prediction.moving | motion.moving_after
        unseen = moving if estimate.labels is None else moving & ~estimate.labels.dynamic
        same = agree(T_image, tracking.T_world_camera, *same_pose)
        if same and not exceeds_noise_share(unseen, view.labelled):
            return estimate
        other = self.register_from(volume, view, replace(prediction, moving=moving), T_image)
        misfit, other_misfit = (sum(self.monitor.relative_misfit(e.tracking)) for e in (estimate, other))
        better = other.tracking.accepted and (not tracking.accepted or other_misfit < CLEARLY_BETTER * misfit)
        return other if better else estimate

    @staticmethod
    def _clear_image_pose(view: FrameView, prediction: PosePrediction) -> NDArray[np.float64] | None:
        """Pose by the corners of the last image; None unless they clearly follow one motion."""
        T_image, motion = prediction.image_pose(), prediction.image_motion()
        if T_image is None or motion is None or motion.share < AGREED:
            return None
        return None if is_majority_dynamic(motion.moving_after, view.labelled) else T_image

    def register_from(
        self, volume: TsdfVolume, view: FrameView, prediction: PosePrediction, T_init: NDArray[np.float64]
    ) -> PoseEstimate:
        """Pose and labels of a frame from one initial pose (4, 4): coarse levels, labels, then fine levels with static
        weights."""
        levels = view.pyramid.tracked
        tracker = self.blind_tracker if view.without_image else self.tracker
        excluded = [m for m in (view.known_dynamic, prediction.moving, prediction.undecided) if m is not None]
        split, relit = max(1, len(levels) - 1), self._is_relit(view)
        if not self.config.dynamics.enabled:
            with view.timer("track"):
                coarse, weights = levels[:split], initial_weights(levels[:split], None, excluded)
                found = tracker.minimize(volume, coarse, T_init, weights, relit=relit)
            view = self.color_motion.refined(view, found.T_world_camera)
            with view.timer("track"):
                fine, exposure = view.pyramid.tracked[split - 1 :], found.exposure
                weights = initial_weights(fine, None, excluded)
                tracking = tracker.align(volume, fine, found.T_world_camera, weights, split - 1, exposure)
            return PoseEstimate(tracking, None, view)
        with view.timer("track"):
            coarse, weights = levels[:split], initial_weights(levels[:split], self.last_dynamic, excluded)
            found = tracker.minimize(volume, coarse, T_init, weights, relit=relit)
        view = self.color_motion.refined(view, found.T_world_camera)
        levels = view.pyramid.tracked
        labels = self._label(volume, view, prediction, found)
        with view.timer("track_again"):
            finest_suffices = split < len(levels) and found.converged and self._labels_unchanged(labels)
            first = split if finest_suffices else split - 1
            weights = static_weights(labels, levels[first:], prediction.undecided)
            pose, exposure = found.T_world_camera, found.exposure
            velocity = self.motion.velocity_to(view.timestamp, pose)
            time_sigma = self.color_motion.time_sigma(self.config.sensor.color_time_sigma)
            discount = motion_discount(view.pyramid.fine, velocity, time_sigma, volume.voxel_size)
            discount *= gain_discount(exposure[0], self.config.sensor.reference_sigma, tracker.config.color_weight)
            color_weight = tracker.config.color_weight * discount
            tracking = tracker.align(volume, levels[first:], pose, weights, first, exposure, color_weight)
        if view.without_image:
            tracking = replace(tracking, color_residual=np.nan)
        return PoseEstimate(tracking, labels, view)

    def at_given(self, volume: TsdfVolume, view: FrameView, prediction: PosePrediction) -> PoseEstimate:
        """Labels of a frame with a given pose."""
        coarse, fine = view.pyramid.coarse, view.pyramid.fine
        T_world_camera = prediction.T_world_camera
        excluded = [m for m in (view.known_dynamic, prediction.moving, prediction.undecided) if m is not None]
        tracker = self.blind_tracker if view.blind else self.tracker
        with view.timer("track"):
            [weights] = initial_weights([coarse], self.last_dynamic, excluded) or [np.ones_like(coarse.depth)]
            found = tracker.judge(volume, coarse, T_world_camera, weights)
        labels = self._label(volume, view, prediction, found) if self.config.dynamics.enabled else None
        with view.timer("track_again"):
            if labels is None:
                [weights] = initial_weights([fine], None, excluded) or [np.ones_like(fine.depth)]
            else:
                [weights] = static_weights(labels, [fine], prediction.undecided)
            tracking = tracker.judge(volume, fine, T_world_camera, weights, found.exposure)
        return PoseEstimate(tracking, labels)

    def update(self, view: FrameView, estimate: PoseEstimate) -> None:
        """Accept the pose and labels of a frame."""
        tracking, labels = estimate.tracking, estimate.labels
        self.motion.update(view.timestamp, tracking.T_world_camera, observed=estimate.is_observed)
        self.last_dynamic = labels.dynamic if labels is not None and labels.dynamic.any() else None
        self.monitor.accept(tracking)
        if not view.blind:
            (gain, offset), mean = tracking.exposure, float(view.pyramid.coarse.intensity.mean())
            self._brightness = gain * mean + offset
        if labels is None or view.blind or labels.mixture is None:  # carried labels are not carried again
            return
        with view.timer("label"):
            self.detector.update(view.timestamp, view.labelled, tracking.T_world_camera, tracking.exposure, labels)

    def lose(self, timestamp: float) -> None:
        """Handle a lost frame; drop the state of previous frames after some time."""
        self.monitor.lose()
        if self.motion.lost(timestamp):
            self.detector.reset()
            self.last_dynamic = self._brightness = None

    def _labels_unchanged(self, labels: Labels) -> bool:
        """Whether too few labels on the map changed to register the coarser level again."""
        changed = labels.dynamic if self.last_dynamic is None else labels.dynamic != self.last_dynamic
        on_map = labels.sample.occupancy == SURFACE
        return bool(np.count_nonzero(changed & on_map) <= UNCHANGED_SHARE * np.count_nonzero(on_map))

    def _by_distances(
        self, volume: TsdfVolume, view: FrameView, prediction: PosePrediction, found: TrackingResult | Minimum
    ) -> NDArray[np.float64]:
        """Nearby pose with the smallest distances of the labelled image.

        Returns the input pose in these cases:

        * Images are compared: the young map contains moving objects, which the distances would follow.
        * Only the distances determined the input pose.
        * The far half of the measurements does not improve: near surfaces dominate the cost and may be moving.
        """
        level, T_world_camera = view.labelled, found.T_world_camera
        if view.without_image or prediction.moving is not None or self.tracker.config.color_weight == 0:
            return T_world_camera
        if isinstance(found, Minimum) and found.level.depth is level.depth:
            weights, before = found.weights, found.equations.residuals[0]
        else:
            excluded = [m for m in (view.known_dynamic, prediction.undecided) if m is not None]
            [weights] = initial_weights([level], self.last_dynamic, excluded) or [np.ones_like(level.depth)]
            before = self.blind_tracker.linearize(volume, level, T_world_camera, weights).residuals[0]
        T_nearest, after = self.blind_tracker.nearest(volume, level, T_world_camera, weights)
        before, after = np.abs(before), np.abs(after)
        depth = level.depth[::MEDIAN_STRIDE, ::MEDIAN_STRIDE]
        depth = depth[np.isfinite(before[::MEDIAN_STRIDE, ::MEDIAN_STRIDE])]
        if len(depth) == 0:
            return T_world_camera
        far = level.depth > median(depth)
        nearer, farther = np.count_nonzero(far & (after < before)), np.count_nonzero(far & (before < after))
        return T_nearest if nearer - farther > NO_CHANCE * np.sqrt(nearer + farther) else T_world_camera

    def _label(
        self, volume: TsdfVolume, view: FrameView, prediction: PosePrediction, tracking: TrackingResult | Minimum
    ) -> Labels:
        """Labels of a registered frame, compared with the map at the pose that fits its distances best.

        Misregistered colours bias the pose, so that static surface resembles motion. Surface that fits at an
        indistinguishable pose is static.
        """
        with view.timer("label"):
            if Shed.LABELS in view.shed and prediction.moving is None:
                labels = self.detector.carried(
                    volume, view.labelled, tracking.T_world_camera, view.segmentation, tracking.exposure
                )
            else:
                T_world_camera = self._by_distances(volume, view, prediction, tracking)
                added = [cue.log_odds(volume, view, T_world_camera) for cue in self.cues]
                labels = self.detector.detect(
                    volume,
                    view.labelled,
                    T_world_camera,
                    view.timestamp,
                    view.segmentation,
                    prediction.moving,
                    tracking.exposure,
                    np.asarray(sum(added), np.float32) if added else NONE,
                )
            if view.without_image:
                labels = replace(labels, hidden=None)
            if view.known_dynamic is None:
                return labels
            known = reduced(view.known_dynamic, view.labelled)
            static_probability = np.where(known, np.float32(0), labels.static_probability)
            return replace(labels, dynamic=labels.dynamic | known, static_probability=static_probability)
