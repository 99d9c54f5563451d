"""Is a registration as good as those before it? Catches wrong minima that pass every absolute check."""

from collections import deque

import numpy as np

from dudmap.config import SensorConfig
from dudmap.tracker import TrackingResult

MEMORY = 30
"""Tracked frames that are remembered."""
GOOD_SIGMAS = 0.5
"""A root mean square residual of this many standard deviations of the sensor, at one metre depth, is good."""
DARK = 0.005
"""Intensity differences below this are as good as none."""
UNUSUAL_RESIDUAL, UNUSUAL_COLOR = 1.5, 1.8
"""A registration whose residuals, or intensity differences, are more than this times the usual ones may be wrong."""


class TrackingHealth:
    """Compares a registration's residuals and share of readings on the map with the recent ones.

    A registration that slid into a wrong minimum explains the frame much worse than its predecessors were explained,
    though still well enough for any fixed threshold. After a loss the first guess is poor and such minima are common,
    so that the comparison is stricter until tracking has been found again.

    Args:
        sensor: Noise of the depth sensor. Residuals are compared with it at one metre depth, as the tracker gives them
            (``TrackingResult.residual``) whether or not it weighs readings by their noise.
    """

    def __init__(self, sensor: SensorConfig) -> None:
        self._good = GOOD_SIGMAS * (sensor.sigma_base + sensor.sigma_scale)
        self._residuals: deque[float] = deque(maxlen=MEMORY)
        self._shares: deque[float] = deque(maxlen=MEMORY)
        self._colors: deque[float] = deque(maxlen=MEMORY)
        self.recovering = False

    def doubt(self, tracked: TrackingResult, *, recognised: bool = False, crowded: bool = False) -> str:
        """Sentence on what is much worse than before, empty if nothing is.

        Args:
            tracked: The registration.
            recognised: Whether features put the camera there too; then the distances alone need not be as usual, and
                less of the view need be known: where the camera looks now, a young map may end.
            crowded: Whether most of the view moves: a part of that, taken for the world, then drags the pose along, and
                the distances are the first to tell.
        """
        if len(self._residuals) < 5:
            return ""
        strict = self.recovering or recognised
        residual, share, color = (float(np.median(q)) for q in (self._residuals, self._shares, self._colors))
        worst = 2.5 if recognised else 1.6 if self.recovering else 4.0
        if crowded and not strict:
            worst, residual = 2.0, max(residual, self._good)
        if tracked.residual > worst * residual:
            return f"readings lie {1000 * tracked.residual:.1f} mm off the map, {1000 * residual:.1f} mm were usual"
        if self.recovering and not recognised and tracked.inlier_share < 0.6 * share:
            return f"only {tracked.inlier_share:.0%} of the static readings fall on the map, {share:.0%} were usual"
        # one wall fits another of the same room, but it does not look like it
        if tracked.color_residual > (max(0.02, 2.5 * color) if strict else max(0.03, 4.0 * color)):
            return f"the image differs by {tracked.color_residual:.1%} from the map, {color:.1%} were usual"
        return ""

    def misfit(self, tracked: TrackingResult) -> tuple[float, float]:
        """Residual and intensity difference over what was usual; (1, 1) before anything is."""
        if len(self._residuals) < 5:
            return 1.0, 1.0
        residual, color = (float(np.median(q)) for q in (self._residuals, self._colors))
        return tracked.residual / max(residual, 1e-6), tracked.color_residual / max(color, DARK)

    def unusual(self, tracked: TrackingResult) -> bool:
        """Whether a registration is bad enough to be worth another one from elsewhere."""
        residual, color = self.misfit(tracked)
        return not tracked.converged or residual > UNUSUAL_RESIDUAL or color > UNUSUAL_COLOR

    def tracked(self, tracked: TrackingResult) -> None:
        """Take over a registration that passed."""
        self._residuals.append(tracked.residual)
        self._shares.append(tracked.inlier_share)
        if np.isfinite(tracked.color_residual):
            self._colors.append(tracked.color_residual)
        self.recovering = False

    def lost(self) -> None:
        """From here on, until a frame is tracked, only registrations like those before the loss are believed."""
        self.recovering = True
