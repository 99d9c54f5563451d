"""Whether the optimum of a response surface is to be believed: reasons against it, and confirmation runs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dudmap.lab.study.response_surface import LackOfFit, Optimum, Surface, optimum

ENOUGH_EXPLAINED = 0.5
"""Smallest share of the variance that a model must predict (leave-one-out) to be better than a guess."""
SIGNIFICANT = 0.05
"""Largest p of a significant lack of fit."""


@dataclass(frozen=True)
class Influence:
    """The run with the largest Cook's distance, and the model without it.

    Attributes:
        label: The run.
        value: Its response.
        distance: Its Cook's distance.
        limit: Median of F(P, N - P): beyond it the run moves the estimate out of its own 50 % confidence region
            (Cook 1977).
        r2_without: Share of the variance that the model explains without it.
        sd_without: Standard deviation of the residuals without it.
        optimum_without: Optimum without it.
    """

    label: str
    value: float
    distance: float
    limit: float
    r2_without: float
    sd_without: float
    optimum_without: Optimum

    @property
    def carries(self) -> bool:
        """Whether the run carries the model."""
        return self.distance > self.limit


def influence(surface: Surface) -> Influence | None:
    """The most influential run; None if the model cannot be fitted without it."""
    import statsmodels.api as sm
    from scipy import stats

    model = surface.model
    distances = model.get_influence().cooks_distance[0]
    worst = int(np.argmax(distances))
    rest = np.arange(len(distances)) != worst
    exog = np.asarray(model.model.exog)
    if np.linalg.matrix_rank(exog[rest]) < exog.shape[1] or rest.sum() <= exog.shape[1]:
        return None
    without = sm.OLS(surface.observed[rest], exog[rest]).fit()
    smaller = Surface(
        surface.factors, surface.features, without, surface.blocks, surface.observed[rest], surface.coded[rest],
        [label for label, keep in zip(surface.labels, rest, strict=True) if keep], surface.better,
    )  # fmt: skip
    limit = float(stats.f.ppf(0.5, exog.shape[1], model.df_resid))
    return Influence(
        surface.labels[worst], float(surface.observed[worst]), float(distances[worst]), limit,
        smaller.r2, smaller.residual_sd, optimum(smaller),
    )  # fmt: skip


def judge(surface: Surface, best: Optimum, fit: LackOfFit | None, single: Influence | None) -> tuple[str, ...]:
    """Reasons not to believe the optimum of a surface before it is confirmed, each a sentence."""
    reasons = []
    if surface.r2_predicted < ENOUGH_EXPLAINED:
        reasons.append(
            f"The model explains {surface.r2:.0%} of the variance (R2 = {surface.r2:.2f}) and predicts "
            f"{max(surface.r2_predicted, 0):.0%} of it when each run is left out in turn "
            f"(R2 = {surface.r2_predicted:.2f})."
        )
    seen = surface.best_seen
    gain = abs(seen - best.predicted)
    noise = surface.residual_sd / np.sqrt(len(surface.observed) / len(surface.point_means))
    if gain < noise:
        per = " per point" if noise < surface.residual_sd else ""
        side = "below" if surface.better == "low" else "above"
        beyond = (best.predicted < seen) == (surface.better == "low") and best.predicted != seen
        where = f"lies {side} everything observed" if beyond else "is no better than the best observed"
        reasons.append(
            f"The prediction {best.predicted:.4g} {where} ({seen:.4g}), from which it differs by {gain:.2g}, less than "
            f"the standard deviation of the residuals{per}, {noise:.3g}."
        )
    if single is not None and single.carries:
        where = ", ".join(
            f"{key.rpartition('.')[2]} {value:.4g}" for key, value in single.optimum_without.values.items()
        )
        reasons.append(
            f"One value carries the model: {single.value:.4g} at {single.label}, with a Cook's distance of "
            f"{single.distance:.2f} (limit {single.limit:.2f}); without it R2 is {single.r2_without:.2f}, the "
            f"standard deviation of the residuals {single.sd_without:.3g}, and the optimum "
            f"{single.optimum_without.predicted:.4g} at {where}."
        )
    if fit is not None and fit.p < SIGNIFICANT:
        reasons.append(
            f"The lack of fit is significant (F = {fit.f:.2f}, p = {fit.p:.2g}): the response is not quadratic."
        )
    return tuple(reasons)


@dataclass(frozen=True)
class Confirmation:
    """Runs at the predicted optimum, beside runs at the best point of the design on the same recordings.

    Attributes:
        predicted: Prediction of the model.
        low, high: Interval in which the mean of the confirmation runs should fall.
        measured: Mean of the confirmation runs.
        design_mean: Mean of all runs of the design: what one would predict without a model.
        best_point: Mean of the runs at the best point of the design on the same recordings.
        count: Number of confirmation runs.
        better: Whether ``low`` or ``high`` values are good.
    """

    predicted: float
    low: float
    high: float
    design_mean: float
    measured: float
    best_point: float
    count: int
    better: str

    @property
    def inside(self) -> bool:
        """Whether the measured mean lies in the interval."""
        return self.low <= self.measured <= self.high

    @property
    def informative(self) -> bool:
        """Whether the interval excludes the mean of the design: a wider one holds whatever is measured."""
        return not self.low <= self.design_mean <= self.high

    @property
    def improves(self) -> bool:
        """Whether the optimum is at least as good as the best point of the design."""
        return self.measured == self.best_point or (self.measured < self.best_point) == (self.better == "low")

    @property
    def held(self) -> bool:
        """Whether the model held: it said what would be measured, more exactly than the mean does, and where to go."""
        return self.inside and self.informative and self.improves

    def __str__(self) -> str:
        runs = "1 run" if self.count == 1 else f"mean of {self.count} runs"
        part = "inside" if self.inside else "outside"
        wide = "" if self.informative else f" (so wide that it holds the mean of the design, {self.design_mean:.4g})"
        found = "no worse" if self.improves else "worse"
        return (
            f"Predicted {self.predicted:.4g}, measured {self.measured:.4g} ({runs}), {part} the interval "
            f"{self.low:.4g} to {self.high:.4g}{wide}; {found} than the best point of the design on the same "
            f"recordings, {self.best_point:.4g}. The prediction was {'' if self.held else 'not '}confirmed."
        )


def confirm(surface: Surface, best: Optimum, measured: Sequence[float], best_point: Sequence[float]) -> Confirmation:
    """Compare confirmation runs with the prediction and with the best point of the design.

    Args:
        surface: The model.
        best: Its optimum.
        measured: (M,) response of the runs at the optimum, the same number on every recording.
        best_point: (M,) response of runs at the best point of the design, on the same recordings.
    """
    predicted, low, high = surface.interval(np.array(best.coded), len(measured))
    mean, other = float(np.mean(measured)), float(np.mean(best_point))
    return Confirmation(
        predicted, low, high, float(surface.observed.mean()), mean, other, len(measured), surface.better
    )
