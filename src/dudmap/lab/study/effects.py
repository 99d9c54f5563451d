"""Main effects, interactions and analysis of variance."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from dudmap.lab.study.designs import Factor, Table

CONFIDENCE = 0.95
"""Level of all confidence intervals."""
MOST_LEVELS = 6
"""Factors with more values are linear terms of the analysis of variance."""


def main_effects(table: Table, factors: Sequence[Factor], response: str) -> Table:
    """Mean at every level of every factor, with confidence interval (Student's t).

    Factors with more than ``MOST_LEVELS`` values are cut into groups.
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
    """Level of each run, or the mean of its group."""
    import pandas as pd

    if values.nunique() <= MOST_LEVELS:
        return values
    groups = pd.qcut(values, MOST_LEVELS, duplicates="drop")
    return values.groupby(groups, observed=True).transform("mean")


def interactions(table: Table, factors: Sequence[Factor], response: str) -> dict[tuple[str, str], Table]:
    """Means at all pairs of levels of two factors, rows of the first."""
    out = {}
    for a, b in combinations(factors, 2):
        first, second = level_groups(table[a.key]), level_groups(table[b.key])
        out[a.key, b.key] = table[response].groupby([first, second], observed=True).mean().unstack()
    return out


def anova(table: Table, factors: Sequence[Factor], response: str) -> tuple[Table, str] | None:
    """Analysis of variance with main effects and, if possible, all two-factor interactions.

    Sums of squares are of type II (statsmodels); partial eta squared is SS / (SS + SS_residual); recordings are blocks.

    Returns:
        One row per term (sum of squares, degrees of freedom, F, p, partial eta squared), residual last, and the model.
        None with too few runs or no variance.
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
