"""Screening of many keys: all numeric keys as factors, and the effect of each on each recording.

A malformed table, or too few runs for all factors, raises a ``ConfigError``.
"""

from collections.abc import Collection, Mapping, Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from dudmap.config import Config, keys
from dudmap.errors import ConfigError
from dudmap.lab.study import report as figures
from dudmap.lab.study.designs import Factor, Table, is_number

if TYPE_CHECKING:
    from dudmap.lab.study.report import Report

FALSE_SHARE = 0.05
"""Share of the effects called significant that may be due to chance (Benjamini and Hochberg 1995)."""
MOST_SHOWN = 16


def numeric_factors(given: object, base: Config, chosen: Collection[str] = ()) -> tuple[Factor, ...]:
    """Every numeric key as a factor between its value divided by a ratio and its value times the ratio.

    - Both ends are kept inside the bounds of the key; for an exclusive bound, the end lies halfway between value and
      bound.
    - A whole number changes by 1 at least.
    - All elements of a list change together, with two levels.
    - Keys with the value 0, keys ``chosen`` by the design file, and keys in its table (``ratio``, ``without``) are
      skipped.
    """
    if not isinstance(given, dict) or set(given) - {"ratio", "without"}:
        raise ConfigError(f"all_numeric is {given!r}; expected, for example, all_numeric = {{ ratio = 1.5 }}")
    ratio, without = given.get("ratio", 1.5), given.get("without", [])
    if not is_number(ratio) or not ratio > 1:
        raise ConfigError(f"ratio of all_numeric is {ratio!r}; expected a number above 1")
    if not isinstance(without, list):
        raise ConfigError(f"without of all_numeric is {without!r}; expected a list of configuration keys")
    for key in without:
        if key not in keys():
            raise ConfigError(f"all_numeric leaves out {key!r}, which is no configuration key")
    out = []
    for key in keys():
        value = attrgetter(key)(base)
        foreign = key.startswith("thesis.") != (base.system == "thesis")
        if key in without or key in chosen or foreign:
            continue
        if isinstance(value, tuple):
            ends = [[_scaled(element, factor) for element in value] for factor in (1 / ratio, ratio)]
            out.append(Factor(key, tuple(ends)))
        elif isinstance(value, int | float) and not isinstance(value, bool) and value != 0:
            low, high = _ends(key, value, ratio)
            whole = isinstance(value, int)
            out.append(Factor(key, (), low, high, "linear" if whole or low <= 0 else "log", whole))
    return tuple(out)


def _ends(key: str, value: float, ratio: float) -> tuple[float, float]:
    low, high = sorted((_scaled(value, 1 / ratio), _scaled(value, ratio)))
    if isinstance(value, int):
        low, high = min(low, value - 1), max(high, value + 1)
    bounds = bounds_of(key)
    low = max(low, bounds.get("ge", low))
    high = min(high, bounds.get("le", high))
    if low <= bounds.get("gt", -np.inf):
        low = (value + bounds["gt"]) / 2
    if high >= bounds.get("lt", np.inf):
        high = (value + bounds["lt"]) / 2
    return float(low), float(high)


def _scaled(value: float, factor: float) -> float:
    return max(round(value * factor), 1) if isinstance(value, int) else float(f"{value * factor:.6g}")


def bounds_of(key: str) -> dict[str, float]:
    """Bounds of a numeric key by their kind: ``ge``, ``gt``, ``le``, ``lt``."""
    section, _, name = key.rpartition(".")
    found = type(getattr(Config(), section)).model_fields[name].metadata
    return {kind: getattr(item, kind) for item in found for kind in ("ge", "gt", "le", "lt") if hasattr(item, kind)}


def screen(table: Table, factors: Sequence[Factor], response: str) -> Table:
    """Effect of every two-level factor on every recording: mean at its high end minus mean at its low end.

    Least squares with all factors together (statsmodels) per recording. The probabilities are adjusted for the number
    of keys and recordings together (Benjamini and Hochberg 1995). In a design that is folded over, interactions of two
    factors are in the residual.

    Returns:
        One row per factor and recording: effect, its 95 % interval (low, high), adjusted p, and the effect in standard
            deviations of the residual.
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
    """Keys with a significant effect on any recording, the largest in standard deviations of the residual first."""
    sure = effects[effects["p"] < FALSE_SHARE]
    return list(sure["relative"].abs().groupby(sure["key"]).max().sort_values(ascending=False).index)


def describe_screening(report: "Report", effects: Table, heading: str) -> None:
    """Add the keys that matter for a response, with their effects per recording."""
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
    """Text on the keys that matter for each response.

    Args:
        effects: Tables of ``screen`` by the name of the response.
    """
    if not effects:
        return "No response could be screened."
    by_response = {name: strongest(table) for name, table in effects.items()}
    keys = list(dict.fromkeys(key for table in effects.values() for key in table["key"]))
    rest = [key for key in keys if not any(key in found for found in by_response.values())]
    lines = [f"{len(keys) - len(rest)} of {len(keys)} keys have a significant effect:"]
    lines += [f"{name}: {', '.join(found)}" for name, found in by_response.items() if found]
    return "\n".join([*lines, f"Without a significant effect on any response: {', '.join(rest)}."])
