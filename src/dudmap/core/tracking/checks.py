"""All checks of a registered frame: one table, in which each has a figure, a limit and a reason.

All figures are computed for every frame and reported (``FrameResult.checks``). The first check that fails rejects the
frame. Checks against what was usual in the frames before find registrations that converged to a wrong minimum, which
explain a frame much worse than its predecessors, though often well enough for any fixed limit. Such a check is only a
suspicion: it is overruled where independent evidence confirms the pose.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dudmap.config import SensorConfig, TrackerConfig

MIN_READINGS = 100
"""Static readings on the map that a registration needs: well above its six unknowns."""
MAX_DRIFT = 0.03
"""Largest standard deviation of a pose that follows the prediction where the view shows no motion, metres."""
MIN_VERIFIED_SHARE = 0.09
"""Share of the readings that must be static and lie on the map where most of the view is dynamic."""
MAX_STEP = 0.5
"""Largest motion between two frames whose times are not known, as a share of the width of the image by which it moves
the median reading: half of the view is still common then, from which a registration can start."""
MAX_IMAGE_SHIFT = 1.0
"""Largest misregistration of two images by a right pose, pixels of the coarsest level: a registration that is farther
off has not converged on any level."""
CONFIRMED_SHARE, CONFIRMED_OF_SEEN = 0.5, 0.8
"""Shares of the readings, of all and of those that the last frame shows, whose depth must agree with the last frame for
it to confirm a pose: most of the view, and no room for another motion beside it. With a right pose noise leaves 99.7 %,
depth edges a few percent less; at the wrong minima of kidnapped cameras in synthetic rooms less than 1 % agreed."""
STRICTNESS = {
    "tracking": (4.0, 4.0, 0.03),
    "mostly dynamic": (2.0, 4.0, 0.03),
    "recovering": (1.6, 2.5, 0.02),
    "recognized": (2.5, 2.5, 0.02),
}
"""Largest distance residual and largest intensity difference in multiples of what was usual, and smallest limit of the
intensity difference (0..1). Where most of the view is dynamic, a dynamic object registered as static shows in the
distances first. After a loss the initial pose is poor and wrong minima are common. Where place recognition found the
same pose, larger distances are accepted."""
USUAL_OVERLAP = 0.6
"""Smallest share of the static readings on the map after a loss, in multiples of what was usual."""


@dataclass(frozen=True)
class Limits:
    """Quantities from which the limits of the checks follow.

    Attributes:
        config: Configured limits.
        sensor: Noise of the sensor.
        max_dynamic_share: Configured largest share of dynamic readings.
        mode: Key of STRICTNESS.
        mostly_dynamic: Most of the readings are dynamic.
        blind: The image carries no information.
        residual_mm, overlap, color: Usual values of the frames before; NaN if not known yet.
    """

    config: TrackerConfig
    sensor: SensorConfig
    max_dynamic_share: float = 1.0
    mode: str = "tracking"
    mostly_dynamic: bool = False
    blind: bool = False
    residual_mm: float = np.nan
    overlap: float = np.nan
    color: float = np.nan

    @cached_property
    def sigma_mm(self) -> float:
        """Standard deviation of a reading at 1 m, millimetres."""
        return 1000 * self.sensor.reference_sigma


@dataclass(frozen=True)
class Check:
    """One condition of a registered frame.

    Attributes:
        figure: Name of the figure that is judged, with its unit.
        limit: Limit of the figure. A check whose figure or limit is not known, NaN, passes.
        reason: Text, in which ``figure`` and ``limit`` are replaced by their values.
        at_least: The figure must not be below the limit, instead of not above.
        overruled_by: Evidence against which the check does not hold: the ``last frame``, seen from the pose, has the
            same depth and the same image; the ``corners`` of the last image support the pose.
    """

    figure: str
    limit: Callable[[Limits], float]
    reason: str
    at_least: bool = False
    overruled_by: str = ""


REGISTRATION = (
    Check("readings", lambda _: MIN_READINGS, "only {figure:.0f} static readings fall on the map", at_least=True),
    Check(
        "overlap",
        lambda limits: limits.config.min_inliers,
        "only {figure:.0%} of the static readings fall on the map",
        at_least=True,
    ),
    Check(
        "residual_mm",
        lambda limits: limits.config.max_residual * limits.sigma_mm,
        "readings lie {figure:.1f} mm off the map",
    ),
    Check(
        "condition",
        lambda limits: limits.config.min_condition,
        "the view does not constrain all directions of motion",
        at_least=True,
    ),
)
"""Checks of a registration by itself."""
RELATIVE = (
    # a residual within the noise of the sensor speaks against no pose, however small it was before
    Check(
        "residual_mm",
        lambda limits: max(STRICTNESS[limits.mode][0] * limits.residual_mm, limits.sigma_mm),
        "readings lie {figure:.1f} mm off the map, at most {limit:.1f} mm were to be expected",
        overruled_by="last frame",
    ),
    Check(
        "overlap",
        lambda limits: USUAL_OVERLAP * limits.overlap if limits.mode == "recovering" else 0.0,
        "only {figure:.0%} of the static readings fall on the map, at least {limit:.0%} were to be expected",
        at_least=True,
        overruled_by="last frame",
    ),
    # two walls of one room have the same shape, but not the same texture
    Check(
        "color_residual",
        lambda limits: max(STRICTNESS[limits.mode][1] * limits.color, STRICTNESS[limits.mode][2]),
        "the image differs by {figure:.1%} from the map, at most {limit:.1%} were to be expected",
        overruled_by="last frame",
    ),
)
"""Checks against what was usual in the frames before."""
CHECKS = (
    *REGISTRATION,
    Check("speed_m_s", lambda limits: limits.config.max_speed, "the camera would have jumped at {figure:.1f} m/s"),
    Check("turn_deg_s", lambda limits: limits.config.max_turn_deg, "the camera would have spun at {figure:.0f} deg/s"),
    Check("step", lambda _: MAX_STEP, "the camera would have jumped by {figure:.0%} of the image"),
    Check(
        "drift_mm",
        lambda _: 1000 * MAX_DRIFT,
        "the view has not shown all directions of motion for so long that the pose may drift by {figure:.0f} mm",
    ),
    *RELATIVE,
    Check(
        "dynamic_share",
        lambda limits: limits.max_dynamic_share,
        "{figure:.0%} of the readings seem to move: the static world cannot be told",
    ),
    Check(
        "verified_share",
        lambda limits: MIN_VERIFIED_SHARE if limits.mostly_dynamic else 0.0,
        "most of the readings seem to move, and only {figure:.0%} rest where the map has a surface",
        at_least=True,
    ),
    Check(
        "confirmed_share",
        lambda limits: CONFIRMED_SHARE if limits.blind else 0.0,
        "the image says nothing, and only {figure:.0%} of the depths agree with the last frame's",
        at_least=True,
    ),
    Check(
        "image_shift_px",
        lambda _: MAX_IMAGE_SHIFT,
        "the last image lies {figure:.1f} coarse pixels beside this one, and its corners do not support that",
        overruled_by="corners",
    ),
)
"""All checks of a frame, in the order in which they are applied."""


def first_failure(
    checks: Sequence[Check],
    figures: Mapping[str, float],
    limits: Limits,
    evidence: Mapping[str, Callable[[], bool]] | None = None,
) -> str:
    """Reason of the first check that fails and is not overruled; empty if there is none.

    Args:
        checks: The checks.
        figures: By name.
        limits: What the limits follow from.
        evidence: What decides whether a check that fails is overruled, by name; None for no evidence.
    """
    for check in checks:
        figure, limit = figures[check.figure], check.limit(limits)
        fails = figure < limit if check.at_least else figure > limit
        if fails and not (evidence and check.overruled_by and evidence[check.overruled_by]()):
            return check.reason.format(figure=figure, limit=limit)
    return ""
