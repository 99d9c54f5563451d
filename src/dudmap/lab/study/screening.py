"""Effect of all numeric keys on each recording. Bad tables, or too few runs, raise a ``ConfigError``."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from dudmap.errors import ConfigError
from dudmap.lab.study import report as figures
from dudmap.lab.study.designs import Factor, Table

if TYPE_CHECKING:
    from dudmap.lab.study.report import Report

FALSE_SHARE = 0.05
"""Share of false discoveries (Benjamini and Hochberg 1995)."""
MOST_SHOWN = 16


def screen(table: Table, factors: Sequence[Factor], response: str) -> Table:
    """Effect of every two-level factor on every recording, high minus low, by least squares with all factors
    (statsmodels).

    Probabilities are adjusted over keys and recordings (Benjamini and Hochberg 1995). Two-factor interactions of a
    foldover are in the residual.

    Returns:
        Per factor and recording: effect, 95 % interval (low, high), adjusted p, effect in residual standard deviations.
    """
    import pandas as pd
    import statsmodels.api as sm
    from statsmodels.stats.multitest import multipletests

    rows: list[tuple[Any, ...]] = []
    for name, part in table.groupby("sequence", sort=False):
        exog = np.column_stack([np.ones(len(part)), *(_signs(part[factor.key]) for factor in factors)])
        if len(part) <= exog.shape[1] or np.linalg.matrix_rank(exog) < exog.shape[1]:
            raise ConfigError(f"{len(part)} runs on {name} do not tell apart {len(factors)} factors")
        model = sm.OLS(part[response].to_numpy(float), exog).fit()
        interval, scatter = np.asarray(model.conf_int()), float(np.sqrt(model.mse_resid))
        for n, factor in enumerate(factors, 1):
            effect, (low, high) = 2 * float(model.params[n]), 2 * interval[n]
            p = float(model.pvalues[n]) if scatter > 0 else 1.0
            rows.append((factor.key, name, effect, low, high, p, effect / scatter if scatter > 0 else 0.0))
    out = pd.DataFrame(rows, columns=["key", "recording", "effect", "low", "high", "p", "relative"])
    out["p"] = multipletests(out["p"].to_numpy(), method="fdr_bh")[1]
    return out


def _signs(values: Table) -> Any:  # noqa: ANN401 - an array
    plain = values.map(lambda value: value[0] if isinstance(value, list | tuple) else value)
    return np.where(plain == plain.max(), 1.0, -1.0)


def strongest(effects: Table) -> list[str]:
    """Keys with a significant effect, largest in residual standard deviations first."""
    sure = effects[effects["p"] < FALSE_SHARE]
    return list(sure["relative"].abs().groupby(sure["key"]).max().sort_values(ascending=False).index)


def describe_screening(report: "Report", effects: Table, heading: str) -> None:
    """Add the keys that matter, with effects per recording."""
    order, count = strongest(effects), effects["key"].nunique()
    report.text(
        f"{len(order)} of {count} keys affect {heading} on at least one recording, from the low to the high end. At "
        f"most {FALSE_SHARE:.0%} of these effects are due to chance (Benjamini and Hochberg)."
    )
    if not order:
        return
    stars = effects["p"].lt(FALSE_SHARE).map({True: "*", False: ""})
    cells = effects.assign(effect=effects["effect"].map("{:.3g}".format) + stars)
    report.table(cells.pivot(index="key", columns="recording", values="effect").loc[order].reset_index())
    report.text("A star marks the effects that are significant.")
    shown = order[:MOST_SHOWN]
    figure = figures.screening_figure(effects[effects["key"].isin(shown)], shown, heading)
    report.figure(figure, "Effects with 95 % intervals.")


def summary(effects: Mapping[str, Table]) -> str:
    """Text on the keys that matter.

    Args:
        effects: Tables of ``screen`` by response.
    """
    if not effects:
        return "No response could be screened."
    by_response = {name: strongest(table) for name, table in effects.items()}
    keys = list(dict.fromkeys(key for table in effects.values() for key in table["key"]))
    rest = [key for key in keys if not any(key in found for found in by_response.values())]
    lines = [f"{len(keys) - len(rest)} of {len(keys)} keys have a significant effect:"]
    lines += [f"{name}: {', '.join(found)}" for name, found in by_response.items() if found]
    return "\n".join([*lines, f"Without a significant effect on any response: {', '.join(rest)}."])
