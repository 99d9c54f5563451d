"""Main effects, interactions, analysis of variance, and sensitivity indices of one response."""

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.lab.study.designs import MORRIS_LEVELS, Factor, Table, coded_points, problem

CONFIDENCE = 0.95
"""Level of all confidence intervals."""
MOST_LEVELS = 6
"""A factor with more different values than this enters the analysis of variance as a linear term."""


def main_effects(table: Table, factors: Sequence[Factor], response: str) -> Table:
    """Mean of the response at every level of every factor, with the confidence interval of the mean (Student's t).

    A factor with more than ``MOST_LEVELS`` values is cut into that many groups of equal size.
    """
    import pandas as pd
    from statsmodels.stats.weightstats import DescrStatsW

    rows = []
    for factor in factors:
        levels = level_groups(table[factor.key])
        for level, group in table[response].groupby(levels, sort=True, observed=True):
            low, high = DescrStatsW(group).tconfint_mean(1 - CONFIDENCE) if len(group) > 1 else (np.nan, np.nan)
            rows.append((factor.key, level, len(group), group.mean(), low, high))
    return pd.DataFrame(rows, columns=["factor", "level", "runs", "mean", "low", "high"])


def level_groups(values: Table) -> Table:
    """Level of each run; of a factor with many values, the mean of its group."""
    import pandas as pd

    if values.nunique() <= MOST_LEVELS:
        return values
    groups = pd.qcut(values, MOST_LEVELS, duplicates="drop")
    return values.groupby(groups, observed=True).transform("mean")


def interactions(table: Table, factors: Sequence[Factor], response: str) -> dict[tuple[str, str], Table]:
    """Means of the response at all pairs of levels of two factors: one table per pair, rows of the first factor."""
    out = {}
    for a, b in combinations(factors, 2):
        first, second = level_groups(table[a.key]), level_groups(table[b.key])
        out[a.key, b.key] = table[response].groupby([first, second], observed=True).mean().unstack()
    return out


def anova(table: Table, factors: Sequence[Factor], response: str) -> tuple[Table, str] | None:
    """Analysis of variance with main effects and, if the runs suffice, all interactions of two factors.

    Sums of squares are of type II (statsmodels). Partial eta squared is SS / (SS + SS_residual). Recordings are blocks.

    Returns:
        One row per term (sum of squares, degrees of freedom, F, p, partial eta squared), the last that of the residual,
        and the model in words; None if the runs do not suffice even for the main effects, or the response does not
        vary.
    """
    import pandas as pd
    from statsmodels.formula.api import ols
    from statsmodels.stats.anova import anova_lm

    data, names = pd.DataFrame({"y": table[response], "block": table["sequence"]}), {}
    for number, factor in enumerate(factor for factor in factors if len(table[factor.key].unique()) > 1):
        many = factor.numeric and len(table[factor.key].unique()) > MOST_LEVELS
        data[f"x{number}"] = factor.coded(table[factor.key].to_numpy()) if many else table[factor.key].map(str)
        names[f"x{number}" if many else f"C(x{number})"] = factor.name
    block = " + C(block)" if len(data["block"].unique()) > 1 else ""
    if not names or len(data["y"].unique()) < 2:
        return None
    for order in (2, 1):
        model = ols(f"y ~ ({' + '.join(names)})**{order}{block}", data).fit()
        if model.df_resid >= 1 and np.linalg.matrix_rank(model.model.exog) == model.model.exog.shape[1]:
            break
    else:
        return None
    names |= {"C(block)": "recording", "Residual": "residual"}
    columns = {"sum_sq": "sum of squares", "df": "dof", "PR(>F)": "p"}
    found = anova_lm(model, typ=2).rename(columns=columns).astype({"dof": int})
    eta = found["sum of squares"] / (found["sum of squares"] + found.loc["Residual", "sum of squares"])
    found["partial eta2"] = eta.where(found.index != "Residual")
    found.index = [" x ".join(names[part] for part in str(term).split(":")) for term in found.index]
    words = "main effects and interactions of two factors" if order == 2 else "main effects"
    return found[["sum of squares", "dof", "F", "p", "partial eta2"]], words + (
        ", recordings as blocks" if block else ""
    )


FOLDS = 5
"""Folds of the cross-validation of an emulator."""
ENOUGH_PREDICTED = 0.5
"""Smallest share of the variance that an emulator must predict in cross-validation for its indices to be shown."""
EMULATED = 1024
"""Base samples of the indices of an emulator; their error is then small beside that of the emulator."""


def sobol_indices(factors: Sequence[Factor], values: NDArray[np.float64], seed: int = 0) -> Table:
    """First- and second-order and total Sobol indices with their confidence intervals (SALib).

    ``values`` (N (2 K + 2),) are the response of all rows of a Saltelli design of K factors, in its order.
    """
    import pandas as pd
    from SALib.analyze.sobol import analyze

    scaled = (values - values.mean()) / values.std()  # the estimators assume a small mean
    found = analyze(problem(factors), scaled, calc_second_order=True, seed=seed)
    rows = []
    for n, factor in enumerate(factors):
        rows.append((factor.name, "first", found["S1"][n], found["S1_conf"][n]))
        rows.append((factor.name, "total", found["ST"][n], found["ST_conf"][n]))
    for a, b in combinations(range(len(factors)), 2):
        name = f"{factors[a].name} x {factors[b].name}"
        rows.append((name, "second", found["S2"][a, b], found["S2_conf"][a, b]))
    return pd.DataFrame(rows, columns=["term", "order", "index", "95 % +-"])


def emulated_indices(table: Table, factors: Sequence[Factor], response: str, seed: int = 0) -> tuple[Table, str]:
    """Sobol indices of a Gaussian process (scikit-learn) fitted to the runs, and how much it predicts, in words.

    They are None if it predicts too little.
    """
    import warnings

    from SALib.sample.sobol import sample
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
    from sklearn.model_selection import KFold, cross_val_predict

    means = table.groupby([factor.key for factor in factors], as_index=False)[response].mean()
    x = coded_points(factors, means)
    y = means[response].to_numpy(float)
    if len(y) < 2 * FOLDS or np.ptp(y) == 0:
        return None, f"{len(y)} different points are too few for an emulator, or the response does not vary."
    lengths: Any = np.ones(len(factors))  # one per factor, which the annotation of scikit-learn forgets
    kernel = ConstantKernel() * RBF(lengths) + WhiteKernel(1e-2)
    process = GaussianProcessRegressor(kernel, normalize_y=True, random_state=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a length at its bound; cross-validation judges the fit
        guess = cross_val_predict(process, x, y, cv=KFold(FOLDS, shuffle=True, random_state=seed))
        process.fit(x, y)
    share = float(1 - np.sum((guess - y) ** 2) / np.sum((y - y.mean()) ** 2))
    text = f"A Gaussian process predicts {max(share, 0):.0%} of the variance between the points in cross-validation"
    if share < ENOUGH_PREDICTED:
        return None, f"{text}; Sobol indices of it would mean nothing."
    values = process.predict(sample(problem(factors), EMULATED, calc_second_order=True, seed=seed))
    return sobol_indices(factors, np.asarray(values), seed), f"{text}; the indices are those of the process."


def morris_indices(factors: Sequence[Factor], coded: NDArray[np.float64], values: NDArray[np.float64]) -> Table:
    """Mean absolute elementary effect mu* with its interval, mean mu and standard deviation sigma (SALib).

    ``coded`` (N (K + 1), K) is a Morris design of K factors and ``values`` (N (K + 1),) the response, in its order.
    """
    import pandas as pd
    from SALib.analyze.morris import analyze

    found = analyze(problem(factors), coded, values, num_levels=MORRIS_LEVELS, seed=0)
    names = [factor.name for factor in factors]
    columns = {"mu*": found["mu_star"], "95 % +-": found["mu_star_conf"], "mu": found["mu"], "sigma": found["sigma"]}
    frame = pd.DataFrame({"factor": names} | {key: np.asarray(value) for key, value in columns.items()})
    return frame.sort_values("mu*", ascending=False, ignore_index=True)
