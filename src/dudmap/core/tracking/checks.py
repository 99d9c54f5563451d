"""All checks of a registered frame: one table of metric, limit and reason.

All metrics are reported (``FrameResult.verdict``); the first failed check rejects the frame. Relative checks compare a
residual with its median in the previous frames, in units of its spread. They find wrong minima that pass fixed limits.
Independent evidence for the pose overrules them.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from dudmap.config import SensorConfig, TrackerConfig
from dudmap.core.verdict import Outcome, Verdict

MIN_READINGS = 100
"""Fewest static measurements on the map: well above the six unknowns."""
MAX_DRIFT = 0.03
"""Largest standard deviation of a pose predicted in unobserved directions, metres."""
MIN_VERIFIED_SHARE = 0.09
"""Smallest share of measurements static and on the map, in mostly dynamic views."""
MAX_STEP = 0.5
"""Largest motion between frames without times: shift of the median measurement as a share of the image width. Half of
the view is then still common."""
MAX_IMAGE_SHIFT = 1.0
"""Largest misregistration of two images at a correct pose, pixels of the coarsest level. A larger one has not
converged."""
CONFIRMED_SHARE, CONFIRMED_OF_SEEN = 0.5, 0.8
"""Smallest shares of measurements that agree with the last frame, of all and of the visible ones, to confirm a pose.
They leave no room for a second motion. Noise leaves 99.7 % at a correct pose, and depth edges a few percent less; less
than 1 % agreed at wrong minima in synthetic rooms."""
MAX_RESIDUAL = 4.0
"""Largest robust root mean square of the distance residuals, in standard deviations sigma(z)."""
MAX_DYNAMIC_SHARE = 0.9
"""Largest share of dynamic measurements of a tracked frame."""
MIN_COLOR_LIMIT = 0.03
"""Smallest limit of the intensity difference (0..1), above the storage steps of the map."""
USUAL_OVERLAP = 0.6
"""Smallest share of static measurements on the map after a loss, in usual shares."""


class RegistrationRules(NamedTuple):
    """Damping of a registration and limits of its result.

    Attributes:
        damping: Initial Levenberg-Marquardt damping, relative to the diagonal of J^T J (thesis eq. 4.42, table 6.1).
        min_overlap: Smallest share of the static measurements on the map.
        min_condition: Smallest ratio of the extreme eigenvalues of the scaled J^T J.
        min_information: Information on a direction, in multiples of gradient noise, above which the registration always
            moves along it; an endless tunnel gives 2. Below it, map and image must have the same texture along the
            direction. 0 always moves.
    """

    damping: float = 0.02
    min_overlap: float = 0.15
    min_condition: float = 1e-4
    min_information: float = 2.3


RULES = RegistrationRules()
"""Rules of the camera's registration."""


@dataclass(frozen=True)
class Limits:
    """Quantities that determine the limits of the checks.

    Attributes:
        config: Configured limits.
        sensor: Noise of the sensor.
        rules: Limits of the registration.
        mostly_dynamic: Most of the measurements are dynamic.
        blind: The image carries no information.
        residual_mm, color: Largest expected residuals; NaN if unknown.
        overlap: Usual overlap, after a loss; else NaN.
    """

    config: TrackerConfig
    sensor: SensorConfig
    rules: RegistrationRules = RULES
    mostly_dynamic: bool = False
    blind: bool = False
    residual_mm: float = np.nan
    color: float = np.nan
    overlap: float = np.nan

    @cached_property
    def sigma_mm(self) -> float:
        """Standard deviation of a measurement at 1 m, millimetres."""
        return 1000 * self.sensor.reference_sigma


@dataclass(frozen=True)
class Check:
    """One condition of a registered frame.

    Attributes:
        figure: Name of the metric, with its unit.
        limit: Limit of the metric. A NaN metric or limit passes.
        reason: Text with placeholders for ``figure`` and ``limit``.
        at_least: The limit is a lower bound.
        overruled_by: Overruling evidence. ``last frame``: it has the same depth and image at the pose. ``corners``: the
            corners of the last image support the pose.
        name: Name of the check; empty for the name of the metric.
    """

    figure: str
    limit: Callable[[Limits], float]
    reason: str
    at_least: bool = False
    overruled_by: str = ""
    name: str = ""

    def outcome(self, figures: Mapping[str, float], limits: Limits) -> Outcome:
        """Outcome before it is overruled."""
        figure, limit = figures[self.figure], self.limit(limits)
        return Outcome.of(self.name or self.figure, figure, limit, self.reason, at_least=self.at_least)


REGISTRATION = (
    Check("readings", lambda _: MIN_READINGS, "only {figure:.0f} static measurements fall on the map", at_least=True),
    Check(
        "overlap",
        lambda limits: limits.rules.min_overlap,
        "only {figure:.0%} of the static measurements fall on the map",
        at_least=True,
    ),
    Check(
        "residual_mm",
        lambda limits: MAX_RESIDUAL * limits.sigma_mm,
        "measurements lie {figure:.1f} mm off the map",
    ),
    Check(
        "condition",
        lambda limits: limits.rules.min_condition,
        "the view does not constrain all directions of motion",
        at_least=True,
    ),
)
"""Checks of a single registration."""
RELATIVE = (
    # a residual within the sensor noise never rejects a pose, however small it was before
    Check(
        "residual_mm",
        lambda limits: max(limits.residual_mm, limits.sigma_mm),
        "measurements lie {figure:.1f} mm off the map, at most {limit:.1f} mm were to be expected",
        overruled_by="last frame",
        name="usual_residual_mm",
    ),
    Check(
        "overlap",
        lambda limits: USUAL_OVERLAP * limits.overlap,
        "only {figure:.0%} of the static measurements fall on the map, at least {limit:.0%} were to be expected",
        at_least=True,
        overruled_by="last frame",
        name="usual_overlap",
    ),
    # two walls of a room have the same shape, but different texture
    Check(
        "color_residual",
        lambda limits: max(limits.color, MIN_COLOR_LIMIT),
        "the image differs by {figure:.1%} from the map, at most {limit:.1%} were to be expected",
        overruled_by="last frame",
    ),
)
"""Checks against usual values of previous frames."""
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
        lambda _: MAX_DYNAMIC_SHARE,
        "{figure:.0%} of the measurements seem to move: the static world is ambiguous",
    ),
    Check(
        "verified_share",
        lambda limits: MIN_VERIFIED_SHARE if limits.mostly_dynamic else 0.0,
        "most of the measurements seem to move, and only {figure:.0%} are static on the map",
        at_least=True,
    ),
    Check(
        "confirmed_share",
        lambda limits: CONFIRMED_SHARE if limits.blind else 0.0,
        "the image carries no information, and only {figure:.0%} of the depths agree with the last frame",
        at_least=True,
    ),
    Check(
        "image_shift_px",
        lambda _: MAX_IMAGE_SHIFT,
        "the last image is misregistered by {figure:.1f} coarse pixels, and its corners do not confirm the pose",
        overruled_by="corners",
    ),
)
"""All checks, in order."""


def judged(
    checks: Sequence[Check],
    figures: Mapping[str, float],
    limits: Limits,
    evidence: Mapping[str, Callable[[], bool]] | None = None,
) -> Verdict:
    """Outcomes of all checks. After the first failed one, no evidence is evaluated.

    Args:
        checks: The checks.
        figures: Metrics by name.
        limits: Quantities that determine the limits.
        evidence: Overruling functions by name; None for none.
    """
    outcomes, failed = list[Outcome](), evidence is None
    for check in checks:
        outcome = check.outcome(figures, limits)
        if outcome.reason and not failed:
            assert evidence is not None
            if check.overruled_by and evidence[check.overruled_by]():
                outcome = outcome._replace(overruled_by=check.overruled_by)
            failed = not outcome.passed
        outcomes.append(outcome)
    return Verdict(tuple(outcomes))
