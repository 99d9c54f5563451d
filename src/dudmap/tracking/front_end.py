"""Register a frame, find what moves, register again without that (thesis algorithm 4)."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.dynamics.detector import DynamicDetector
from dudmap.dynamics.masks import Labels
from dudmap.frames.observation import Level
from dudmap.frames.pyramid import Pyramid, reduced
from dudmap.mapping.volume import SURFACE, TsdfVolume
from dudmap.stage_timer import StageTimer
from dudmap.tracking.motion_model import MotionModel
from dudmap.tracking.time_offset import DepthTimeOffset
from dudmap.tracking.tracker import Tracker, TrackingResult

UNCHANGED_SHARE = 0.02
"""Share of the surface whose labels may differ from the last frame's where one level is registered a second time."""


@dataclass(frozen=True, eq=False)
class RegistrationInput:
    """What is to be registered.

    Attributes:
        timestamp: Seconds.
        pyramid: The image.
        known: (H, W) bool, pixels that are known to move from elsewhere; None where nothing is.
        unverified_mask: (h, w) bool, label resolution, pixels not verified as static while a crowd moves; or None.
        blind: The image shows nothing; the distances alone have to give the pose.
        clock: Takes the time of the stages.
    """

    timestamp: float
    pyramid: Pyramid
    known: NDArray[np.bool_] | None
    unverified_mask: NDArray[np.bool_] | None
    blind: bool
    clock: StageTimer


class FrontEnd:
    """Poses and labels of frames, each of which needs the other.

    Args:
        config: All parameters.
        tracker: Registers an image.
        detector: Finds what moves in one that is registered.
        motion: The camera's velocity.
    """

    def __init__(self, config: Config, tracker: Tracker, detector: DynamicDetector, motion: MotionModel) -> None:
        self.config = config
        self.tracker = tracker
        by_distance = config.tracker.model_copy(update={"color_weight": 0.0, "exposure": False})
        self.blind_tracker = Tracker(by_distance, config.sensor)
        self.detector = detector
        self.motion = motion
        self.delay = DepthTimeOffset()
        self.moved: NDArray[np.bool_] | None = None  # label image of the last tracked frame, if anything moved

    def register(
        self, volume: TsdfVolume, task: RegistrationInput, T_init: NDArray[np.float64]
    ) -> tuple[TrackingResult, Labels | None]:
        """Pose and labels of a frame against a map, from a first guess (4, 4) of the pose on.

        The coarse levels bring the pose near enough to tell what moves, the fine ones make it exact.
        """
        levels, clock = task.pyramid.tracked, task.clock
        unmasked = self._unmasked(task)
        tracker = self.blind_tracker if task.blind else self.tracker
        if self.config.dynamics.method == "none" or not self.config.tracker.second_pass:
            with clock("track"):
                tracked = tracker.align(volume, levels, T_init, unmasked)
            if self.config.dynamics.method == "none":
                return tracked, None
            return tracked, self._detect(volume, task, tracked)
        split = max(1, len(levels) - 1)
        with clock("track"):
            tracked = tracker.align(volume, levels[:split], T_init, self.expected(levels, unmasked))
        labels = self._detect(volume, task, tracked)
        with clock("track_again"):
            enough = split < len(levels) and tracked.settled and self._labels_unchanged(labels)
            first = split if enough else split - 1
            weights = static_weights(labels, levels[first:], task.unverified_mask)
            pose, exposure = tracked.T_world_camera, tracked.exposure
            tracked = tracker.align(volume, levels[first:], pose, weights, first_level=first, exposure=exposure)
        if task.blind:
            tracked = replace(tracked, color_residual=np.nan)
        return tracked, labels

    def keep(self, volume: TsdfVolume, task: RegistrationInput, tracked: TrackingResult, labels: Labels | None) -> None:
        """Take over a frame whose pose is believed: what the next one is judged from."""
        velocity = self.motion.update(task.timestamp, tracked.T_world_camera)
        self.moved = labels.dynamic if labels is not None and labels.dynamic.any() else None
        if labels is None or task.blind:
            return
        coarse = task.pyramid.coarse
        weights = static_weights(labels, [coarse], task.unverified_mask)[0]
        self.delay.learn(self.tracker, volume, coarse, tracked.T_world_camera, velocity, weights)
        self.detector.remember(task.pyramid.labelled, tracked.T_world_camera, tracked.exposure, labels)

    def forget(self) -> None:
        """Tracking was lost."""
        self.detector.forget()
        self.moved = None

    def expected(
        self, levels: list[Level], unmasked: list[NDArray[np.float32]] | None = None
    ) -> list[NDArray[np.float32]] | None:
        """Weights of the first registration: what moved in the last frame has little say in this one."""
        if self.moved is None:
            return unmasked
        weights = [np.float32(1) - np.float32(0.9) * reduced(self.moved, level) for level in levels]
        return weights if unmasked is None else [a * b for a, b in zip(weights, unmasked, strict=True)]

    def _unmasked(self, task: RegistrationInput) -> list[NDArray[np.float32]] | None:
        """Weights of 0 for what is known to move, or seen to from image to image; None where nothing is."""
        masks = [mask for mask in (task.known, self.detector.moving, task.unverified_mask) if mask is not None]
        if not masks:
            return None
        levels = task.pyramid.tracked
        return [(~np.any([reduced(mask, level) for mask in masks], axis=0)).astype(np.float32) for level in levels]

    def _labels_unchanged(self, labels: Labels) -> bool:
        """Whether so little of what lies on the map moves other than in the last frame that no coarser level need be
        registered again."""
        changed = labels.dynamic if self.moved is None else labels.dynamic != self.moved
        counted = labels.sample.occupancy == SURFACE  # nothing else has a say in the registration
        return bool(np.count_nonzero(changed & counted) <= UNCHANGED_SHARE * np.count_nonzero(counted))

    def _detect(self, volume: TsdfVolume, task: RegistrationInput, tracked: TrackingResult) -> Labels:
        level = task.pyramid.labelled
        with task.clock("label"):
            T_depth = tracked.T_world_camera
            if not task.blind:
                velocity = self.motion.velocity_to(task.timestamp, T_depth)
                T_depth = self.delay.depth_pose(task.pyramid.coarse, T_depth, velocity)
            labels = self.detector.detect(volume, level, T_depth, tracked.exposure)
            if task.blind:
                labels = replace(labels, hidden=None)
            if task.known is None:
                return labels
            masked = reduced(task.known, level)
            static_probability = np.where(masked, np.float32(0), labels.static_probability)
            return replace(labels, dynamic=labels.dynamic | masked, static_probability=static_probability)


def static_weights(
    labels: Labels, levels: list[Level], unverified_mask: NDArray[np.bool_] | None = None
) -> list[NDArray[np.float32]]:
    """Weights (h, w) of the second registration at each level: what moves, or may, has none."""
    import cv2

    static = labels.static_probability if unverified_mask is None else labels.static_probability * ~unverified_mask
    return [
        np.asarray(cv2.resize(static, level.depth.shape[::-1], interpolation=cv2.INTER_NEAREST), np.float32)
        for level in levels
    ]
