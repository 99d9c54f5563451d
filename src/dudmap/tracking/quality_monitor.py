"""Acceptance of a registration: absolute checks, and comparison with the registrations before it."""

import statistics
from collections import deque
from dataclasses import dataclass

import numpy as np

from dudmap.config import Config
from dudmap.frames.pyramid import is_majority_dynamic
from dudmap.tracking.estimate import PoseEstimate
from dudmap.tracking.frame_view import FrameView
from dudmap.tracking.image_consistency import ImageConsistency, ImagePose
from dudmap.tracking.motion_model import MotionModel
from dudmap.tracking.tracker import TrackingResult

HISTORY = 30
"""Accepted registrations that are remembered."""
MIN_HISTORY = 5
"""Accepted registrations before new ones are compared with them."""
SMALL_RESIDUAL_SIGMAS = 0.5
"""Root mean square residual, in standard deviations of the sensor, that is good."""
SMALL_COLOR_RESIDUAL = 0.005
"""Intensity difference (0..1) that is good with any sensor."""
UNUSUAL_RESIDUAL, UNUSUAL_COLOR_RESIDUAL = 1.5, 1.8
"""Multiples of the median residuals from which on a registration is repeated from another initial pose."""
MIN_VERIFIED_SHARE = 0.09
"""Share of the readings that must be static and lie on the map where most of the view is dynamic."""


@dataclass(frozen=True)
class RegistrationHistory:
    """Residuals of the last accepted registrations, oldest first.

    Attributes:
        residuals: Root mean square distances to the map, metres.
        shares: Shares of the static readings on the map.
        colors: Root mean square intensity differences (0..1).
    """

    residuals: tuple[float, ...] = ()
    shares: tuple[float, ...] = ()
    colors: tuple[float, ...] = ()


class QualityMonitor:
    """Decides whether the registration of a frame can be trusted.

    A registration that converged to a wrong minimum explains the frame much worse than its predecessors were explained,
    though often well enough for any fixed threshold. After a loss the initial pose is poor and wrong minima are common,
    so the comparison is stricter until a frame has been accepted again.

    Args:
        config: ``dynamics.max_share`` and the sensor's noise.
        motion: Velocity of the camera.
    """

    def __init__(self, config: Config, motion: MotionModel) -> None:
        self.config = config
        self.motion = motion
        self.images = ImageConsistency(config, motion)
        self.reset()

    def reset(self) -> None:
        """Forget all registrations: a new map begins."""
        self._residuals: deque[float] = deque(maxlen=HISTORY)
        self._shares: deque[float] = deque(maxlen=HISTORY)
        self._colors: deque[float] = deque(maxlen=HISTORY)
        self.recovering = False
        self.images.reset()

    @property
    def history(self) -> RegistrationHistory:
        """The registrations that new ones are compared with."""
        return RegistrationHistory(tuple(self._residuals), tuple(self._shares), tuple(self._colors))

    def restore(self, history: RegistrationHistory) -> None:
        """Compare new registrations with those of an earlier run in the same map."""
        self._residuals.extend(history.residuals)
        self._shares.extend(history.shares)
        self._colors.extend(history.colors)

    def rejection_reason(self, view: FrameView, estimate: PoseEstimate, image_pose: ImagePose) -> str:
        """Sentence on the first check that a registered frame fails, empty if it passes all.

        The checks are those of the registration itself (overlap, residual, conditioning), of the camera's velocity, of
        the residuals against those of the previous frames, of the share of the view that is static and known, and of
        the last image, seen from the new pose. ``image_pose`` computes the pose that two images alone predict.
        """
        tracking, labels = estimate.tracking, estimate.labels
        with view.timer("check"):
            crowded = labels is not None and is_majority_dynamic(labels.dynamic, view.labelled)
            return (
                tracking.reason
                or self.motion.rejection_reason(view.timestamp, tracking.T_world_camera)
                or (self.motion.drift_reason(view.timestamp) if len(tracking.unobservable) else "")
                or self.deviation(tracking, crowded=crowded)
                or self._undetermined(view, estimate)
                or self.images.contradicts(view, estimate, image_pose)
            )

    def deviation(self, tracking: TrackingResult, *, recognized: bool = False, crowded: bool = False) -> str:
        """Sentence on what is much worse than in the previous frames, empty if nothing is.

        Args:
            tracking: The registration.
            recognized: Place recognition found the same pose: larger distances and a smaller overlap are accepted.
            crowded: Most of the view is dynamic: a dynamic object registered as static shows in the distances first,
                which are therefore judged more strictly.
        """
        if len(self._residuals) < MIN_HISTORY:
            return ""
        strict = self.recovering or recognized
        residual, share, color = (_median(q) for q in (self._residuals, self._shares, self._colors))
        worst = 2.5 if recognized else 1.6 if self.recovering else 4.0
        if crowded and not strict:
            worst, residual = 2.0, max(residual, SMALL_RESIDUAL_SIGMAS * self.config.sensor.sigma(1.0))
        if tracking.residual > worst * residual:
            return f"readings lie {1000 * tracking.residual:.1f} mm off the map, {1000 * residual:.1f} mm were usual"
        if self.recovering and not recognized and tracking.inlier_share < 0.6 * share:
            return f"only {tracking.inlier_share:.0%} of the static readings fall on the map, {share:.0%} were usual"
        # two walls of one room have the same shape, but not the same texture
        if tracking.color_residual > (max(0.02, 2.5 * color) if strict else max(0.03, 4.0 * color)):
            return f"the image differs by {tracking.color_residual:.1%} from the map, {color:.1%} were usual"
        return ""

    def relative_misfit(self, tracking: TrackingResult) -> tuple[float, float]:
        """Distance and intensity residual over their medians in the previous frames; (1, 1) before there are any."""
        if len(self._residuals) < MIN_HISTORY:
            return 1.0, 1.0
        residual, color = (_median(q) for q in (self._residuals, self._colors))
        return tracking.residual / max(residual, 1e-6), tracking.color_residual / max(color, SMALL_COLOR_RESIDUAL)

    def is_unusual(self, tracking: TrackingResult) -> bool:
        """Whether a registration failed or fits badly enough to be repeated from another initial pose."""
        residual, color = self.relative_misfit(tracking)
        return not tracking.converged or residual > UNUSUAL_RESIDUAL or color > UNUSUAL_COLOR_RESIDUAL

    def accept(self, tracking: TrackingResult) -> None:
        """Remember a registration that passed all checks."""
        self._residuals.append(tracking.residual)
        self._shares.append(tracking.inlier_share)
        if np.isfinite(tracking.color_residual):
            self._colors.append(tracking.color_residual)
        self.recovering = False

    def lose(self) -> None:
        """Judge strictly until a frame is accepted again."""
        self.recovering = True

    def _undetermined(self, view: FrameView, estimate: PoseEstimate) -> str:
        """Sentence if too much of the view is dynamic, or too little of the rest is known, to determine the pose."""
        if estimate.labels is None:
            return ""
        readings = view.labelled.depth > 0
        share = np.count_nonzero(estimate.labels.dynamic & readings) / max(np.count_nonzero(readings), 1)
        if share > self.config.dynamics.max_share:
            return f"{share:.0%} of the readings seem to move: the static world cannot be told"
        verified = (1 - share) * estimate.tracking.inlier_share
        if share > 0.5 and verified < MIN_VERIFIED_SHARE:
            return f"{share:.0%} of the readings seem to move, and only {verified:.0%} rest where the map has a surface"
        return ""


def _median(values: deque[float]) -> float:
    """Median of a few values, NaN of none."""
    return statistics.median(values) if values else np.nan
