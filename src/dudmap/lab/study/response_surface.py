"""Full quadratic response surface (Box and Wilson 1951): fit, optimum within bounds, stationary point, lack of fit."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.lab.study.effects import CONFIDENCE
from dudmap.lab.study.factors import Factor, coded_points
from dudmap.lab.study.tables import Table

Numbers = NDArray[np.float64]

MOST_STARTS = 3**6
"""Starting points of the search for the optimum at most; all corners, edges and faces of six factors."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Quadratic model y = b0 + sum b_i x_i + sum b_ij x_i x_j in coded units (-1 to 1) of K factors.

    Attributes:
        factors: The K numeric factors.
        features: Maps (N, K) coded values to (N, P) terms.
        model: Fitted model of statsmodels.
        blocks: Number of columns of the recordings after the P terms.
        observed: (N,) values of the response.
        coded: (N, K) coded values of the runs.
        labels: (N,) description of every run.
        better: Whether ``low`` or ``high`` values are good.
    """

    factors: tuple[Factor, ...]
    features: Any
    model: Any
    blocks: int
    observed: Numbers
    coded: Numbers
    labels: list[str]
    better: str

    @property
    def r2(self) -> float:
        """Share of the variance that the model explains; 0 of values that are all equal."""
        return float(self.model.rsquared) if np.ptp(self.observed) > 0 else 0.0

    @property
    def r2_predicted(self) -> float:
        """Share of the variance that it predicts when each run is left out in turn (PRESS)."""
        press = self.model.get_influence().resid_press
        return float(1 - np.sum(press**2) / np.sum((self.observed - self.observed.mean()) ** 2))

    @property
    def residual_sd(self) -> float:
        """Standard deviation of the residuals, with the degrees of freedom of the model taken off."""
        return float(np.sqrt(self.model.mse_resid))

    def predict(self, coded: Numbers) -> Numbers:
        """(N,) predictions at (N, K) coded values, for the mean over all recordings."""
        terms = self.features.transform(coded)
        return np.asarray(self.model.predict(self._exog(terms)))

    def interval(self, coded: Numbers, count: int = 1) -> tuple[float, float, float]:
        """Prediction at one point, and the interval in which the mean of ``count`` new runs should fall."""
        from scipy import stats

        frame = self.model.get_prediction(self._exog(self.features.transform(coded[None])))
        mean, se = float(frame.predicted_mean[0]), float(frame.se_mean[0])
        half = stats.t.ppf((1 + CONFIDENCE) / 2, self.model.df_resid) * np.hypot(se, self.residual_sd / np.sqrt(count))
        return mean, mean - float(half), mean + float(half)

    def mean_interval(self, coded: Numbers) -> Numbers:
        """(N, 3) prediction of the mean at (N, K) coded values, and its confidence interval."""
        frame = self.model.get_prediction(self._exog(self.features.transform(coded)))
        return np.column_stack([frame.predicted_mean, frame.conf_int(alpha=1 - CONFIDENCE)])

    @property
    def point_means(self) -> Numbers:
        """(M,) mean response of every different point over its recordings and replicates."""
        _, group = np.unique(self.coded.round(9), axis=0, return_inverse=True)
        return np.bincount(group.ravel(), self.observed) / np.bincount(group.ravel())

    @property
    def best_seen(self) -> float:
        """Best mean response of a point that was run."""
        return float(self.point_means.min() if self.better == "low" else self.point_means.max())

    def _exog(self, terms: Numbers) -> Numbers:
        return np.hstack([np.asarray(terms), np.zeros((len(terms), self.blocks))])

    @property
    def quadratic_form(self) -> tuple[Numbers, Numbers]:
        """(K,) linear coefficients b and (K, K) symmetric matrix B of y = b0 + b'x + x'Bx."""
        count = len(self.factors)
        b, B = np.zeros(count), np.zeros((count, count))
        for power, value in zip(self.features.powers_, self.model.params, strict=False):
            at = np.repeat(np.arange(count), power)
            if len(at) == 1:
                b[at[0]] = value
            elif len(at) == 2:
                B[at[0], at[1]] += value / 2
                B[at[1], at[0]] += value / 2
        return b, B


def fit_surface(table: Table, factors: Sequence[Factor], response: str, better: str = "low") -> Surface | str:
    """Fit the full quadratic model by least squares; recordings are blocks whose effects sum to zero.

    Returns:
        The model, or a sentence that says why there is none.
    """
    import statsmodels.api as sm
    from sklearn.preprocessing import OneHotEncoder, PolynomialFeatures

    used = tuple(factor for factor in factors if factor.numeric and table[factor.key].nunique() > 1)
    if not used:
        return "There is no response surface: no numeric factor varies."
    coded = coded_points(used, table[[factor.key for factor in used]].to_dict("records"))
    features = PolynomialFeatures(2).fit(coded)
    blocks = np.asarray(OneHotEncoder(sparse_output=False).fit_transform(table[["sequence"]]))
    effects = blocks[:, :-1] - blocks[:, -1:]
    exog = np.hstack([np.asarray(features.transform(coded)), effects])
    rank = np.linalg.matrix_rank(exog)
    if rank < exog.shape[1]:
        return (
            f"There is no response surface: the design tells apart {rank} of the {exog.shape[1]} terms of the full "
            "quadratic model; take three or more levels per factor (central-composite, box-behnken, full-factorial)."
        )
    if len(exog) <= exog.shape[1]:
        return f"There is no response surface: {len(exog)} runs leave nothing over for {exog.shape[1]} terms."
    observed = table[response].to_numpy(float)
    if np.ptp(observed) == 0:
        return "There is no response surface: the response is the same in all runs."
    labels = [
        ", ".join(f"{f.name} {row[f.key]:g}" for f in used) + f" on {row['sequence']}"
        for row in table.to_dict("records")
    ]
    model = sm.OLS(observed, exog).fit()
    return Surface(used, features, model, effects.shape[1], observed, coded, labels, better)


@dataclass(frozen=True)
class Optimum:
    """Best prediction within the bounds of the factors.

    Attributes:
        coded: (K,) coded values.
        values: Values by key.
        predicted: Predicted response.
    """

    coded: tuple[float, ...]
    values: dict[str, float]
    predicted: float


def optimum(surface: Surface) -> Optimum:
    """Best prediction inside the bounds: L-BFGS-B (scipy) from all corners, edges, faces and the centre."""
    from scipy.optimize import minimize
    from scipy.stats.qmc import Sobol

    sign = 1.0 if surface.better == "low" else -1.0
    count = len(surface.factors)
    if 3**count <= MOST_STARTS:
        starts = np.array(list(product((-1.0, 0.0, 1.0), repeat=count)))
    else:
        starts = 2 * Sobol(count, rng=np.random.default_rng(0)).random_base2(9) - 1
    b, B = surface.quadratic_form
    found = [
        minimize(
            lambda x: sign * (b @ x + x @ B @ x), start, jac=lambda x: sign * (b + 2 * B @ x), bounds=[(-1, 1)] * count
        )
        for start in starts
    ]
    best = min(found, key=lambda result: result.fun).x
    values = {f.key: f.value(float(x)) for f, x in zip(surface.factors, best, strict=True)}
    exact = coded_points(surface.factors, [values])[0]  # whole numbers were rounded
    return Optimum(tuple(map(float, exact)), values, float(surface.predict(exact[None])[0]))


@dataclass(frozen=True, eq=False)
class Canonical:
    """Canonical analysis: y = y_s + sum lambda_i w_i^2 around the stationary point.

    Attributes:
        point: (K,) coded stationary point; None if the surface has none.
        values: Its values by key, None outside the bounds of the factors.
        predicted: Predicted response there.
        eigenvalues: (K,) eigenvalues of B, ascending; all positive: a minimum; all negative: a maximum; else a saddle.
        directions: (K, K) eigenvectors, one per column.
    """

    point: Numbers | None
    values: dict[str, float] | None
    predicted: float
    eigenvalues: Numbers
    directions: Numbers

    @property
    def kind(self) -> str:
        """What the stationary point is."""
        tolerance = 1e-9 * np.abs(self.eigenvalues).max()
        if np.all(self.eigenvalues > tolerance):
            return "minimum"
        return "maximum" if np.all(self.eigenvalues < -tolerance) else "saddle"


def canonical_analysis(surface: Surface) -> Canonical:
    """Stationary point x_s = -B^-1 b / 2 and eigenvalues of B."""
    b, B = surface.quadratic_form
    eigenvalues, directions = np.linalg.eigh(B)
    if np.linalg.matrix_rank(B) < len(b):
        return Canonical(None, None, float("nan"), eigenvalues, directions)
    point = np.asarray(np.linalg.solve(-2 * B, b), float)
    inside = bool(np.all(np.abs(point) <= 1))
    values = {f.key: f.value(float(x)) for f, x in zip(surface.factors, point, strict=True)} if inside else None
    return Canonical(point, values, float(surface.predict(point[None])[0]), eigenvalues, directions)


@dataclass(frozen=True)
class LackOfFit:
    """Test of the model against the means of repeated points: F, p and degrees of freedom of the pure error."""

    f: float
    p: float
    pure_dof: int


def lack_of_fit(surface: Surface) -> LackOfFit | None:
    """F test of the quadratic against the saturated model (``anova_lm``); None without repeated points."""
    import statsmodels.api as sm
    from statsmodels.stats.anova import anova_lm

    blocks = (
        np.asarray(surface.model.model.exog)[:, -surface.blocks :]
        if surface.blocks
        else np.empty((len(surface.observed), 0))
    )
    cells = np.hstack([surface.coded, blocks]).round(9)
    _, group = np.unique(cells, axis=0, return_inverse=True)
    group = group.ravel()
    if group.max() + 1 in (len(group), surface.model.model.exog.shape[1]):
        return None
    saturated = sm.OLS(surface.observed, np.eye(group.max() + 1)[group]).fit()
    row = anova_lm(surface.model, saturated).iloc[1]
    return LackOfFit(float(row["F"]), float(row["Pr(>F)"]), int(saturated.df_resid))
