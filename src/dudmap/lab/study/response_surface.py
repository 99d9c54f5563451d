"""Quadratic response surface (Box and Wilson 1951): fit, optimum, doubts, confirmation."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.lab.study.designs import Factor, Point, Table, coded_points
from dudmap.lab.study.effects import CONFIDENCE
from dudmap.lab.study.responses import Scale

Numbers = NDArray[np.float64]

STARTS = 50
"""Starting points of the search for the optimum."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Quadratic model y = b0 + sum b_i x_i + sum b_ij x_i x_j in coded units (-1 to 1) of K factors.

    Attributes:
        blocks: Columns of the recordings after the P terms.
        observed: (N,) values of the response.
        coded: (N, K) coded values of the runs.
    """

    scale: Scale
    factors: tuple[Factor, ...]
    model: Any
    blocks: int
    observed: Numbers
    coded: Numbers

    @property
    def r2(self) -> float:
        """Explained share of the variance; 0 if all values are equal."""
        return float(self.model.rsquared) if np.ptp(self.observed) > 0 else 0.0

    @property
    def r2_predicted(self) -> float:
        """Share predicted by leave-one-out (PRESS)."""
        press = self.model.get_influence().resid_press
        return float(1 - np.sum(press**2) / np.sum((self.observed - self.observed.mean()) ** 2))

    @property
    def residual_sd(self) -> float:
        """Standard deviation of the residuals, corrected for degrees of freedom."""
        return float(np.sqrt(self.model.mse_resid))

    def predict(self, coded: Numbers) -> Numbers:
        """Predictions (N,) at coded values (N, K), mean over recordings."""
        terms = quadratic_terms(coded)
        return terms @ self.model.params[: terms.shape[1]]

    def interval(self, coded: Numbers, count: int) -> tuple[float, float, float]:
        """Prediction at a point, and interval of the mean of ``count`` new runs."""
        from scipy import stats

        frame = self.model.get_prediction(self._exog(coded[None]))
        mean, se = float(frame.predicted_mean[0]), float(frame.se_mean[0])
        half = stats.t.ppf((1 + CONFIDENCE) / 2, self.model.df_resid) * np.hypot(se, self.residual_sd / np.sqrt(count))
        return mean, mean - float(half), mean + float(half)

    def mean_interval(self, coded: Numbers) -> Numbers:
        """Predicted mean (N, 3) at coded values (N, K), and confidence interval."""
        frame = self.model.get_prediction(self._exog(coded))
        return np.column_stack([frame.predicted_mean, frame.conf_int(alpha=1 - CONFIDENCE)])

    @property
    def point_means(self) -> Numbers:
        """Mean (M,) of every distinct point."""
        _, group = np.unique(self.coded.round(9), axis=0, return_inverse=True)
        return np.bincount(group.ravel(), self.observed) / np.bincount(group.ravel())

    @property
    def best_seen(self) -> float:
        """Best mean response of an observed point."""
        return float(self.scale.sign * np.min(self.scale.sign * self.point_means))

    def _exog(self, coded: Numbers) -> Numbers:
        return np.hstack([quadratic_terms(coded), np.zeros((len(coded), self.blocks))])


def quadratic_terms(coded: Numbers) -> Numbers:
    """Terms (N, P) of coded values (N, K): 1, x_i, x_i x_j."""
    pairs = combinations_with_replacement(coded.T, 2)
    return np.column_stack([np.ones(len(coded)), coded, *(a * b for a, b in pairs)])


def fit_surface(data: Table, factors: Sequence[Factor], scale: Scale) -> Surface | str:
    """Fit the quadratic model to ``Scale.usable`` runs, or return why not; recordings are blocks whose effects sum to
    zero."""
    import pandas as pd
    import statsmodels.api as sm

    used = tuple(factor for factor in factors if factor.numeric and data[factor.key].nunique() > 1)
    if not used:
        return "There is no response surface: no numeric factor varies."
    coded = coded_points(used, data)
    blocks = pd.get_dummies(data["sequence"]).to_numpy(float)
    effects = blocks[:, :-1] - blocks[:, -1:]
    exog = np.hstack([quadratic_terms(coded), effects])
    rank, (runs, terms) = np.linalg.matrix_rank(exog), exog.shape
    if rank < terms:
        return (
            f"There is no response surface: the design tells apart {rank} of the {terms} terms of the full quadratic "
            "model; take three or more levels per factor (central-composite, full-factorial)."
        )
    if runs <= terms:
        return f"There is no response surface: {runs} runs leave nothing over for {terms} terms."
    observed = data[scale.response].to_numpy(float)
    if np.ptp(observed) == 0:
        return "There is no response surface: the response is the same in all runs."
    return Surface(scale, used, sm.OLS(observed, exog).fit(), effects.shape[1], observed, coded)


def values_text(values: dict[str, Any]) -> str:
    """Text of the values of factors."""
    return ", ".join(
        f"{key.rpartition('.')[2]} {value:.4g}" if isinstance(value, float) else f"{key.rpartition('.')[2]} {value}"
        for key, value in values.items()
    )


@dataclass(frozen=True)
class Optimum:
    """Best prediction: coded values (K,), values by key, response."""

    coded: tuple[float, ...]
    values: dict[str, float]
    predicted: float


def optimum(surface: Surface) -> Optimum:
    """Best prediction inside the bounds: L-BFGS-B (scipy) from several starts."""
    import pandas as pd
    from scipy.optimize import minimize

    count, sign = len(surface.factors), surface.scale.sign
    starts = [np.zeros(count), *np.random.default_rng(0).uniform(-1, 1, (STARTS, count))]
    found = [
        minimize(lambda x: sign * float(surface.predict(x[None])[0]), start, bounds=[(-1, 1)] * count)
        for start in starts
    ]
    best = min(found, key=lambda result: result.fun).x
    values = {f.key: f.value(float(x)) for f, x in zip(surface.factors, best, strict=True)}
    exact = coded_points(surface.factors, pd.DataFrame([values]))  # whole numbers were rounded
    return Optimum(tuple(map(float, exact[0])), values, float(surface.predict(exact)[0]))


ENOUGH_EXPLAINED = 0.5
"""Smallest predicted share of the variance (leave-one-out) of a useful model."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Quadratic model, its optimum and the best design point.

    Attributes:
        point: Values at the optimum; best level without numbers.
    """

    surface: Surface
    best: Optimum
    point: Point
    best_point: Point
    reasons: tuple[str, ...]


def predict_optimum(data: Table, factors: Sequence[Factor], scale: Scale) -> Prediction | str:
    """Quadratic model of ``Scale.usable`` runs and its optimum, or why there is none."""
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
    """Doubts about an optimum before its confirmation."""
    reasons, scale = [], surface.scale
    if surface.r2_predicted < ENOUGH_EXPLAINED:
        reasons.append(
            f"The model explains {surface.r2:.0%} of the variance (R2 = {surface.r2:.2f}) and predicts "
            f"{max(surface.r2_predicted, 0):.0%} of it by leave-one-out "
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
    return tuple(reasons)


@dataclass(frozen=True)
class Confirmation:
    """Runs at the predicted optimum and at the best design point.

    Attributes:
        predicted, low, high: Mean of ``count`` runs and interval.
        design_mean: Mean of the design.
        measured, best_point: Means at the optimum and at the best point.
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
        """Whether the interval excludes the design's mean."""
        return not self.low <= self.design_mean <= self.high

    @property
    def improves(self) -> bool:
        """Whether the optimum is at least as good as the best design point."""
        return self.scale.sign * self.measured <= self.scale.sign * self.best_point

    @property
    def held(self) -> bool:
        """Whether the model held: correct, informative, an improvement."""
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
    """Compare runs at the optimum (M,), equally many per recording, with prediction and best point (M,)."""
    predicted, low, high = surface.interval(np.array(best.coded), len(measured))
    mean, other, usual = (float(np.mean(values)) for values in (measured, best_point, surface.observed))
    return Confirmation(surface.scale, predicted, low, high, usual, mean, other, len(measured))
