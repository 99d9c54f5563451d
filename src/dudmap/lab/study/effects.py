"""Main effects, interactions and analysis of variance of one response."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from dudmap.lab.study.factors import Factor
from dudmap.lab.study.tables import Table

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


def effects_by_recording(table: Table, factors: Sequence[Factor], response: str) -> Table:
    """Main effects on every recording on its own.

    Returns:
        One row per recording, factor and level: mean of the response, and partial eta squared and p of the factor in
        the analysis of variance of that recording.
    """
    import pandas as pd

    parts = []
    for recording, part in table.groupby("sequence", sort=False):
        part = part.reset_index(drop=True)
        means, variance = main_effects(part, factors, response), anova(part, factors, response)
        terms = variance.table if variance is not None else pd.DataFrame(columns=["partial eta2", "p"])
        names = {factor.key: factor.name for factor in factors}
        for column in ("partial eta2", "p"):
            means[column] = means["factor"].map(lambda key: terms[column].get(names[key], np.nan))  # noqa: B023
        parts.append(means.assign(recording=recording))
    columns = ["recording", "factor", "level", "mean", "partial eta2", "p"]
    return pd.concat(parts)[columns].reset_index(drop=True)


def level_groups(values: Table) -> Table:
    """Level of each run; of a factor with many values, the mean of its group."""
    import pandas as pd

    if values.nunique() <= MOST_LEVELS:
        return values
    groups = pd.qcut(values, MOST_LEVELS, duplicates="drop")
    return values.groupby(groups, observed=True).transform("mean")


def interactions(table: Table, factors: Sequence[Factor], response: str) -> dict[tuple[str, str], Any]:
    """Means of the response at all pairs of levels of two factors: one table per pair, rows of the first factor."""
    out = {}
    for a, b in combinations(factors, 2):
        first, second = level_groups(table[a.key]), level_groups(table[b.key])
        out[a.key, b.key] = table[response].groupby([first, second], observed=True).mean().unstack()
    return out


@dataclass(frozen=True, eq=False)
class Anova:
    """Analysis of variance.

    Attributes:
        table: One row per term: sum of squares, degrees of freedom, F, p, partial eta squared with its confidence
            interval, and omega squared. The last row is the residual.
        formula: The model in words.
        residual_dof: Degrees of freedom of the residual.
    """

    table: Table
    formula: str
    residual_dof: int


def anova(table: Table, factors: Sequence[Factor], response: str) -> Anova | None:
    """Analysis of variance with main effects and, if the runs suffice, all interactions of two factors.

    Sums of squares are of type II (statsmodels). Partial eta squared is SS / (SS + SS_residual); its interval comes
    from that of the noncentrality of F (``confint_effectsize_oneway``). Recordings are blocks.

    Returns:
        None if the runs do not suffice even for the main effects, or the response does not vary.
    """
    from statsmodels.formula.api import ols
    from statsmodels.stats.anova import anova_lm

    data, terms = _columns(table, factors, response)
    block = " + C(block)" if data["block"].nunique() > 1 else ""
    if not terms or data["y"].nunique() < 2:
        return None
    for order in (2, 1):
        model = ols(f"y ~ ({' + '.join(terms)})**{order}{block}", data).fit()
        if model.df_resid >= 1 and np.linalg.matrix_rank(model.model.exog) == model.model.exog.shape[1]:
            break
    else:
        return None
    found = anova_lm(model, typ=2)
    names = dict(zip(terms, (factor.name for factor in factors if _varies(table, factor)), strict=True))
    result = _with_effect_sizes(found, int(model.df_resid))
    result.index = [_readable(str(term), names) for term in found.index]
    words = "main effects and interactions of two factors" if order == 2 else "main effects"
    return Anova(result, words + (", recordings as blocks" if block else ""), int(model.df_resid))


def _varies(table: Table, factor: Factor) -> bool:
    return table[factor.key].nunique() > 1


def _columns(table: Table, factors: Sequence[Factor], response: str) -> tuple[Table, list[str]]:
    """Columns with names that a formula can hold, and the term of every factor that varies."""
    import pandas as pd

    data, terms = pd.DataFrame({"y": table[response], "block": table["sequence"]}), []
    for number, factor in enumerate(factors):
        if not _varies(table, factor):
            continue
        many = factor.numeric and table[factor.key].nunique() > MOST_LEVELS
        data[f"x{number}"] = factor.coded(table[factor.key].to_numpy()) if many else table[factor.key].map(str)
        terms.append(f"x{number}" if many else f"C(x{number})")
    return data, terms


def _readable(term: str, names: dict[str, str]) -> str:
    if term == "C(block)":
        return "recording"
    return " x ".join(names.get(part, part.lower()) for part in term.split(":"))


def _with_effect_sizes(found: Table, residual_dof: int) -> Table:
    import pandas as pd
    from statsmodels.stats.oneway import confint_effectsize_oneway

    intervals: Any = confint_effectsize_oneway
    rows = []
    residual = float(found.loc["Residual", "sum_sq"])
    total = float(found["sum_sq"].sum())
    for term, row in found.iterrows():
        squares, dof, f = float(row["sum_sq"]), float(row["df"]), float(row["F"])
        eta, low, high, omega = (np.nan,) * 4
        if term != "Residual":
            eta = squares / (squares + residual) if squares + residual else np.nan
            omega = (squares - dof * residual / residual_dof) / (total + residual / residual_dof)
            if np.isfinite(f):
                with np.errstate(divide="ignore"):  # a lower limit of zero
                    low, high = intervals(f, (dof, residual_dof), alpha=1 - CONFIDENCE).eta2
        rows.append((squares, int(dof), f, float(row["PR(>F)"]), eta, max(low, 0.0), high, omega))
    columns = ["sum of squares", "dof", "F", "p", "partial eta2", "eta2 low", "eta2 high", "omega2"]
    return pd.DataFrame(rows, columns=columns)
