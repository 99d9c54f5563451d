"""Acceptance of registered frames: the figures of ``checks.py``, and what was usual in the frames before."""

import statistics
from collections import deque
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from dudmap.config import Config
from dudmap.core.tracking.checks import CHECKS, RELATIVE, Limits, first_failure
from dudmap.core.tracking.estimate import PoseEstimate
from dudmap.core.tracking.frame_view import FrameView
from dudmap.core.tracking.image_consistency import ImageConsistency, ImagePose
from dudmap.core.tracking.motion_model import MotionModel
from dudmap.core.tracking.tracker import TrackingResult

HISTORY = 30
"""Accepted registrations that are remembered."""
MIN_HISTORY = 5
"""Accepted registrations before new ones are compared with them."""
SMALL_COLOR_RESIDUAL = 0.005
"""Intensity difference (0..1) that is good with any sensor."""
UNUSUAL_RESIDUAL, UNUSUAL_COLOR_RESIDUAL = 1.5, 1.8
"""Multiples of the median residuals from which on a registration is repeated from another initial pose."""


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


@dataclass(frozen=True)
class Verdict:
    """Outcome of the checks of a frame.

    Attributes:
        reason: Of the rejection; empty for a frame that is accepted.
        figures: All figures by name, NaN where one is not known.
    """

    reason: str
    figures: dict[str, float] = field(default_factory=dict)


class QualityMonitor:
    """Decides whether the registration of a frame can be trusted.

    Args:
        config: ``tracker``, ``dynamics.max_share`` and the sensor's noise.
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
        self._usual = (np.nan, np.nan, np.nan)  # medians of the three; NaN where they are not known yet
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
        self._update_usual()

    def judge(self, view: FrameView, estimate: PoseEstimate, image_pose: ImagePose) -> Verdict:
        """Figures of a registered frame, and the reason of the first check of ``CHECKS`` that it fails.

        Args:
            view: The frame.
            estimate: Its pose and labels.
            image_pose: Computes the pose (4, 4) that the last image and this one alone give; None if their corners
                follow no common motion.
        """
        tracking, labels = estimate.tracking, estimate.labels
        with view.timer("check"):
            readings = view.labelled.depth > 0
            dynamic = np.zeros_like(readings) if labels is None else labels.dynamic & readings
            share = float(np.count_nonzero(dynamic) / max(np.count_nonzero(readings), 1))
            seen = self.images.compare(view, estimate)
            figures = {
                **tracking.figures,
                **self.motion.figures(view.timestamp, tracking.T_world_camera, view.labelled),
                "drift_mm": 1000 * self.motion.drift(view.timestamp) if len(tracking.unobservable) else 0.0,
                "dynamic_share": share,
                "verified_share": (1 - share) * tracking.inlier_share,
                "image_shift_px": seen.shift,
                "confirmed_share": seen.share,
            }
            crowded = share > 0.5
            evidence = {
                "last frame": lambda: not crowded and seen.is_same_view,
                "corners": partial(self.images.supported, view, estimate, seen, image_pose),
            }
            mode = "recovering" if self.recovering else "crowded" if crowded else "tracking"
            return Verdict(first_failure(CHECKS, figures, self.limits(mode, crowded=crowded), evidence), figures)

    def reason_to_doubt(self, tracking: TrackingResult) -> str:
        """Reason why the registration of a frame at a recognised place is much worse than usual, empty if it is not."""
        return first_failure(RELATIVE, tracking.figures, self.limits("recognized"))

    def limits(self, mode: str, *, crowded: bool = False) -> Limits:
        """What limits follow from: configuration, and medians of the registrations before, if they are enough."""
        config, (residual, overlap, color) = self.config, self._usual
        share = config.dynamics.max_share
        return Limits(config.tracker, config.sensor, share, mode, crowded, 1000 * residual, overlap, color)

    def relative_misfit(self, tracking: TrackingResult) -> tuple[float, float]:
        """Distance and intensity residual over their medians in the previous frames; (1, 1) before there are any."""
        if len(self._residuals) < MIN_HISTORY:
            return 1.0, 1.0
        residual, _, color = self._usual
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
        self._update_usual()
        self.recovering = False

    def _update_usual(self) -> None:
        if len(self._residuals) >= MIN_HISTORY:
            median = statistics.median
            colors = median(self._colors) if self._colors else np.nan
            self._usual = median(self._residuals), median(self._shares), colors

    def lose(self) -> None:
        """Judge strictly until a frame is accepted again."""
        self.recovering = True
