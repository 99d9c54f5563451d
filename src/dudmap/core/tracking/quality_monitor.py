"""Acceptance of registered frames: the metrics of ``checks.py`` and their usual values."""

import statistics
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.backends.cpu.exposure import LARGE_GAIN
from dudmap.core.backends.cpu.reprojection import compare_images, reproject
from dudmap.core.dynamics.detector import noise_parameters
from dudmap.core.dynamics.dominant_motion import MANY
from dudmap.core.dynamics.image_motion import ImagePose, TrackedImage
from dudmap.core.frames.observation import Level, reduced
from dudmap.core.geometry import se3
from dudmap.core.state import Remembered, Stateful
from dudmap.core.tracking.checks import (
    CHECKS,
    CONFIRMED_OF_SEEN,
    CONFIRMED_SHARE,
    MAX_IMAGE_SHIFT,
    RELATIVE,
    RULES,
    Limits,
    judged,
)
from dudmap.core.tracking.frame_view import FrameView, PoseEstimate
from dudmap.core.tracking.motion_model import MotionModel
from dudmap.core.tracking.tracker import TrackingResult
from dudmap.core.verdict import Outcome, Verdict

CLEARLY_LESS = 0.5
"""Another motion explains two images clearly better below this share of misregistration. Noise and blur add half a
pixel to both."""
MIN_PIXELS = 100
"""Fewest pixels of the coarsest level that show the same static surface."""


@dataclass(frozen=True)
class ImageComparison:
    """The last tracked frame, seen from the pose of this one.

    Attributes:
        shift: Misregistration of static pixels, pixels of the coarsest level. NaN if too few are common, or an image
            carries no information.
        share: Share of the measurements whose depth agrees with the last frame.
        share_of_seen: The same share of the measurements visible in the last frame.
    """

    shift: float = np.nan
    share: float = np.nan
    share_of_seen: float = np.nan

    @property
    def confirms(self) -> bool:
        """Whether the depths of both frames agree."""
        return self.share >= CONFIRMED_SHARE and self.share_of_seen >= CONFIRMED_OF_SEEN

    @property
    def is_same_view(self) -> bool:
        """Whether depths and images agree. In a corridor the depths agree at any position."""
        return self.confirms and self.shift <= MAX_IMAGE_SHIFT


class ImageConsistency:
    """Measures how well the motion since the last tracked frame explains both frames. It detects wrong poses that fit
    the shape of the map but not its texture.

    Args:
        config: Noise of the sensor.
        motion: Provides the pose of the last tracked frame.
    """

    def __init__(self, config: Config, motion: MotionModel) -> None:
        self.config = config
        self.motion = motion

    def supported(
        self,
        last: TrackedImage | None,
        view: FrameView,
        estimate: PoseEstimate,
        seen: ImageComparison,
        image_pose: ImagePose,
    ) -> bool:
        """Whether the images are compatible with the pose of a frame.

        They are incompatible if the last image is misregistered by more than MAX_IMAGE_SHIFT and one of these holds:

        * The corners follow no common motion. Exceptions: few corners, or a sudden change of exposure.
        * Their motion explains the images clearly better. Exception: the depths confirm only the pose, because colour
          and depth were captured at different times.

        Args:
            last: The last tracked frame; None if unknown.
            view, estimate: The frame, its pose and labels.
            seen: Its comparison with the last frame.
            image_pose: Computes the pose (4, 4) that the corners predict; None without a common motion.
        """
        if last is None or not seen.shift > MAX_IMAGE_SHIFT:
            return True
        T_image = image_pose()
        if T_image is None:
            change = estimate.exposure[0] / last.gain
            return len(view.pyramid.corners) < MANY or max(change, 1 / change) > LARGE_GAIN
        other = self.compare(last, view, estimate, T_image)
        return not other.shift < CLEARLY_LESS * seen.shift or (seen.confirms and not other.confirms)

    def compare(
        self,
        last: TrackedImage | None,
        view: FrameView,
        estimate: PoseEstimate,
        T_world_camera: NDArray[np.float64] | None = None,
    ) -> ImageComparison:
        """Comparison of a frame with the last tracked one; NaN if that is None.

        A shift by d pixels in a random direction changes intensities by the mean square d^2 |grad I|^2 / 2, so

            d = sqrt(2) median |I_last - I| / median |grad I|

        over common surface, after the best gain and offset. Two depths agree within three standard deviations.

        ``T_world_camera``: (4, 4) another pose of this frame; None for the estimate's.
        """
        if last is None:
            return ImageComparison()
        level, older = view.pyramid.coarse, last.pyramid.coarse
        moved = _reduced(last.moving, older).astype(np.uint8)
        dynamic = _reduced(None if estimate.labels is None else estimate.labels.dynamic, level)
        T_world_camera = estimate.T_world_camera if T_world_camera is None else T_world_camera
        T_last_camera = se3.inverse(self.motion.T_world_camera) @ T_world_camera
        images = np.array([(older.depth, older.intensity)])
        gaps, differences, marks = reproject(
            level.depth, level.intensity, level.camera.intrinsics, T_last_camera[None], images, moved[None]
        )  # fmt: skip
        shift, agreeing, readings, seen = compare_images(
            level.depth, level.intensity, dynamic, gaps[0], differences[0], marks[0],
            noise_parameters(self.config.sensor, level, 0.0), MIN_PIXELS,
            (level.ceiling, older.ceiling),
        )  # fmt: skip
        shift = np.nan if view.without_image or last.blind else shift
        return ImageComparison(shift, agreeing / max(readings, 1), agreeing / max(seen, 1))


def _reduced(mask: NDArray[np.bool_] | None, level: Level) -> NDArray[np.bool_]:
    return np.zeros(level.depth.shape, bool) if mask is None else reduced(mask, level)


HISTORY = 30
"""Remembered accepted registrations."""
MIN_HISTORY = 5
"""Registrations before new ones are compared with them."""
SMALL_COLOR_RESIDUAL = 0.005
"""Intensity difference (0..1) that is always good."""
UNUSUAL_RESIDUAL, UNUSUAL_COLOR_RESIDUAL = 1.5, 1.8
"""Multiples of the median residuals above which a registration is repeated."""


INNOVATION = 6.0
"""Largest rise of a residual over its median, in standard deviations of its logarithm. None of 2284 residuals of six
recordings rose by more."""
SPREADS, COLOR_SPREADS = (0.12, 0.23), (0.153, 0.23)
"""Smallest and largest standard deviation of the logarithm; on six recordings its median is 0.10 to 0.27. Limits are 2
to 4 times the median, 2.5 to 4 times for intensities, whose difference also rises with new texture in view."""


def _highest(values: Sequence[float], spreads: tuple[float, float]) -> float:
    """Largest expected residual: the median, raised by the innovation in log space."""
    logarithms = np.log(np.maximum(values, 1e-6))
    median = np.median(logarithms)
    spread = np.clip(1.4826 * np.median(np.abs(logarithms - median)), *spreads)
    return float(np.exp(median + INNOVATION * spread))


@dataclass(frozen=True)
class RegistrationHistory:
    """Residuals of the last accepted registrations, oldest first.

    Attributes:
        residuals: Root mean square distances to the map, metres.
        shares: Shares of the static measurements on the map.
        colors: Median absolute intensity differences (0..1).
    """

    residuals: tuple[float, ...] = ()
    shares: tuple[float, ...] = ()
    colors: tuple[float, ...] = ()


class QualityMonitor(Stateful):
    """Decides whether a registration can be trusted.

    Args:
        config: ``tracker`` and the sensor's noise.
        motion: Velocity of the camera.
    """

    recovering: Remembered[bool]
    _residuals: Remembered[deque[float]]
    _shares: Remembered[deque[float]]
    _colors: Remembered[deque[float]]

    def __init__(self, config: Config, motion: MotionModel) -> None:
        self.config = config
        self.motion = motion
        self.images = ImageConsistency(config, motion)
        self.reset()

    def reset(self) -> None:
        """Forget all registrations."""
        self._residuals = deque(maxlen=HISTORY)
        self._shares = deque(maxlen=HISTORY)
        self._colors = deque(maxlen=HISTORY)
        self.recovering = False

    @property
    def history(self) -> RegistrationHistory:
        """The remembered registrations."""
        return RegistrationHistory(tuple(self._residuals), tuple(self._shares), tuple(self._colors))

    def continue_from(self, history: RegistrationHistory) -> None:
        """Compare new registrations with an earlier run in the same map."""
        self._residuals.extend(history.residuals)
        self._shares.extend(history.shares)
        self._colors.extend(history.colors)

    def judge(
        self, last: TrackedImage | None, view: FrameView, estimate: PoseEstimate, image_pose: ImagePose
    ) -> Verdict:
        """Outcomes of ``CHECKS`` for a registered frame. A given pose is never rejected: its outcomes have no limits.

        Args:
            last: The last tracked frame; None if unknown.
            view, estimate: The frame, its pose and labels.
            image_pose: Computes the pose (4, 4) from the last two images; None without a common motion.
        """
        tracking, labels = estimate.tracking, estimate.labels
        with view.timer("check"):
            level = view.labelled
            count = 0 if labels is None else np.count_nonzero(labels.dynamic & (level.depth > 0))
            share = count / max(level.num_readings, 1)
            seen = self.images.compare(last, view, estimate)
            figures = {
                **tracking.figures,
                **self.motion.figures(view.timestamp, tracking.T_world_camera, level),
                "drift_mm": 0.0 if estimate.is_observed else 1000 * self.motion.drift(view.timestamp),
                "dynamic_share": share,
                "verified_share": (1 - share) * tracking.inlier_share,
                "image_shift_px": seen.shift,
                "confirmed_share": seen.share,
            }
            mostly_dynamic = bool(share > 0.5)
            evidence = {
                "last frame": lambda: not mostly_dynamic and seen.is_same_view,
                "corners": partial(self.images.supported, last, view, estimate, seen, image_pose),
            }
            if self.motion.is_given:
                return Verdict(tuple(Outcome(name, figure) for name, figure in figures.items()))
            limits = self.limits(mostly_dynamic=mostly_dynamic, blind=view.blind)
            return judged(CHECKS, figures, limits, evidence)

    def misfit(self, tracking: TrackingResult) -> Verdict:
        """Whether the registration at a recognised place is much worse than usual."""
        return judged(RELATIVE, tracking.figures, replace(self.limits(), overlap=np.nan))

    def limits(self, *, mostly_dynamic: bool = False, blind: bool = False) -> Limits:
        """Limits from the configuration and earlier registrations; NaN before there are enough."""
        config, known = self.config, len(self._residuals) >= MIN_HISTORY
        residual, color = (
            _highest(values, spreads) if known and values else np.nan
            for values, spreads in ((self._residuals, SPREADS), (self._colors, COLOR_SPREADS))
        )
        overlap = statistics.median(self._shares) if known and self.recovering else np.nan
        return Limits(config.tracker, config.sensor, RULES, mostly_dynamic, blind, 1000 * residual, color, overlap)

    def relative_misfit(self, tracking: TrackingResult) -> tuple[float, float]:
        """Distance and intensity residual over their medians; (1, 1) before there are any."""
        if len(self._residuals) < MIN_HISTORY:
            return 1.0, 1.0
        residual = statistics.median(self._residuals)
        color = statistics.median(self._colors) if self._colors else np.nan
        return tracking.residual / max(residual, 1e-6), tracking.color_residual / max(color, SMALL_COLOR_RESIDUAL)

    def is_unusual(self, tracking: TrackingResult) -> bool:
        """Whether to repeat a registration from another initial pose."""
        residual, color = self.relative_misfit(tracking)
        return not tracking.accepted or residual > UNUSUAL_RESIDUAL or color > UNUSUAL_COLOR_RESIDUAL

    def accept(self, tracking: TrackingResult) -> None:
        """Remember a registration that passed all checks."""
        self._residuals.append(tracking.residual)
        self._shares.append(tracking.inlier_share)
        if np.isfinite(tracking.color_residual):
            self._colors.append(tracking.color_residual)
        self.recovering = False

    def lose(self) -> None:
        """Check the overlap, too, until a frame is accepted again."""
        self.recovering = True
