"""The optimum of a response surface, whether it is to be believed, and runs that confirm it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dudmap.lab.study.designs import Point
from dudmap.lab.study.factors import Factor, Table
from dudmap.lab.study.response_surface import Optimum, Surface, fit_surface, lack_of_fit, optimum, values_text
from dudmap.lab.study.responses import Scale

ENOUGH_EXPLAINED = 0.5
"""Smallest share of the variance that a model must predict (leave-one-out) to be better than a guess."""
SIGNIFICANT = 0.05
"""Largest p of a significant lack of fit."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Quadratic model of a response, its optimum and the best point of the design.

    Attributes:
        surface: The model.
        best: Its optimum.
        point: Values of all factors at the optimum; those without numbers have their best level.
        best_point: Values of all factors at the best point of the design.
        reasons: What speaks against the optimum before it is confirmed, each a sentence.
    """

    surface: Surface
    best: Optimum
    point: Point
    best_point: Point
    reasons: tuple[str, ...]


def predict_optimum(data: Table, factors: Sequence[Factor], scale: Scale) -> Prediction | str:
    """Quadratic model of a response and its optimum, or a sentence that says why there is none.

    Args:
        data: Runs, as ``Scale.usable`` gives them.
        factors: All factors.
        scale: The response.
    """
    surface = fit_surface(data, factors, scale)
    if isinstance(surface, str):
        return surface
    best, name = optimum(surface), scale.response
    sizes = data.groupby("point")[name].transform("size")
    means = scale.sign * data[sizes == sizes.max()].groupby("point")[name].mean()
    first = data[data["point"] == means.idxmin()].iloc[0]
    point: dict[str, Any] = {}
    for factor in factors:
        labels = data[factor.key].map(str)
        label = (scale.sign * data.groupby(labels)[name].mean()).idxmin()
        point[factor.key] = best.values.get(factor.key, _plain(data[factor.key][labels == label].iloc[0]))
    best_point = {factor.key: _plain(first[factor.key]) for factor in factors}
    return Prediction(surface, best, point, best_point, reasons_against(surface, best))


def _plain(value: Any) -> Any:  # noqa: ANN401 - a value of a table as plain Python
    return value.item() if isinstance(value, np.generic) else value


def reasons_against(surface: Surface, best: Optimum) -> tuple[str, ...]:
    """Reasons not to believe the optimum of a surface before it is confirmed, each a sentence."""
    reasons, scale = [], surface.scale
    if surface.r2_predicted < ENOUGH_EXPLAINED:
        reasons.append(
            f"The model explains {surface.r2:.0%} of the variance (R2 = {surface.r2:.2f}) and predicts "
            f"{max(surface.r2_predicted, 0):.0%} of it when each run is left out in turn "
            f"(R2 = {surface.r2_predicted:.2f})."
        )
    seen = surface.best_seen
    noise = surface.residual_sd / np.sqrt(len(surface.observed) / len(surface.point_means))
    if abs(seen - best.predicted) < noise:
        beyond = scale.sign * best.predicted < scale.sign * seen
        side = "below" if scale.sign > 0 else "above"
        where = f"lies {side} everything observed" if beyond else "is no better than the best observed"
        reasons.append(
            f"The prediction {scale.text(best.predicted)} {where} ({scale.text(seen)}), from which it differs by less "
            f"than the standard deviation of the residuals of a point, {noise:.3g}{scale.unit}."
        )
    if (single := carried_by(surface)) is not None:
        reasons.append(single)
    fit = lack_of_fit(surface)
    if fit is not None and fit[1] < SIGNIFICANT:
        reasons.append(f"The lack of fit is significant (F = {fit[0]:.2f}, p = {fit[1]:.2g}): it is not quadratic.")
    return tuple(reasons)


def carried_by(surface: Surface) -> str | None:
    """The run that carries the model, and the model without it, as a sentence; None if no run does.

    A run carries the model if its Cook's distance is beyond the median of F(P, N - P): it then moves the estimate out
    of its own 50 % confidence region (Cook 1977).
    """
    import statsmodels.api as sm
    from scipy import stats

    model, scale = surface.model, surface.scale
    distances, exog = model.get_influence().cooks_distance[0], np.asarray(model.model.exog)
    worst, limit = int(np.argmax(distances)), float(stats.f.ppf(0.5, exog.shape[1], model.df_resid))
    rest = np.arange(len(distances)) != worst
    if distances[worst] <= limit or np.linalg.matrix_rank(exog[rest]) < exog.shape[1] or rest.sum() <= exog.shape[1]:
        return None
    observed = surface.observed[rest]
    smaller = replace(surface, model=sm.OLS(observed, exog[rest]).fit(), observed=observed, coded=surface.coded[rest])
    best = optimum(smaller)
    return (
        f"One value carries the model: {scale.text(surface.observed[worst])} at {surface.labels[worst]}, with a Cook's "
        f"distance of {distances[worst]:.2f} (limit {limit:.2f}); without it R2 is {smaller.r2:.2f}, and the optimum "
        f"{scale.text(best.predicted)} at {values_text(best.values)}."
    )


@dataclass(frozen=True)
class Confirmation:
    """Runs at the predicted optimum, beside runs at the best point of the design on the same recordings.

    Attributes:
        scale: The response; all values are as it is analysed.
        predicted: Prediction of the model.
        low, high: Interval in which the mean of the confirmation runs should fall.
        design_mean: Mean of all runs of the design: what one would predict without a model.
        measured: Mean of the confirmation runs.
        best_point: Mean of the runs at the best point of the design on the same recordings.
        count: Number of confirmation runs.
    """

    scale: Scale
    predicted: float
    low: float
    high: float
    design_mean: float
    measured: float
    best_point: float
    count: int

    @property
    def informative(self) -> bool:
        """Whether the interval excludes the mean of the design: a wider one holds whatever is measured."""
        return not self.low <= self.design_mean <= self.high

    @property
    def improves(self) -> bool:
        """Whether the optimum is at least as good as the best point of the design."""
        return self.scale.sign * self.measured <= self.scale.sign * self.best_point

    @property
    def held(self) -> bool:
        """Whether the model held: it said what would be measured, more exactly than the mean does, and where to go."""
        return self.low <= self.measured <= self.high and self.informative and self.improves

    def __str__(self) -> str:
        text = self.scale.text
        runs = "1 run" if self.count == 1 else f"mean of {self.count} runs"
        part = "inside" if self.low <= self.measured <= self.high else "outside"
        wide = "" if self.informative else f" (so wide that it holds the mean of the design, {text(self.design_mean)})"
        found = "no worse" if self.improves else "worse"
        return (
            f"Predicted {text(self.predicted)}, measured {text(self.measured)} ({runs}), {part} the interval "
            f"{text(self.low)} to {text(self.high)}{wide}; {found} than the best point of the design on the same "
            f"recordings, {text(self.best_point)}. The prediction was {'' if self.held else 'not '}confirmed."
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
    mean, other, usual = (float(np.mean(values)) for values in (measured, best_point, surface.observed))
    return Confirmation(surface.scale, predicted, low, high, usual, mean, other, len(measured))
