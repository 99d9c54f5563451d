"""Analysis of the runs of a study, response by response, as a report."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dudmap.errors import ConfigError
from dudmap.lab.study import figures, indices, judgement, response_surface, screening
from dudmap.lab.study.designs import DesignOptions, Point
from dudmap.lab.study.effects import anova, interactions, main_effects
from dudmap.lab.study.factors import Factor, coded_points
from dudmap.lab.study.report import Report
from dudmap.lab.study.responses import RESPONSES
from dudmap.lab.study.tables import Table

if TYPE_CHECKING:
    from dudmap.lab.study.response_surface import Optimum, Surface

MOST_FAILURES = 10
"""Failed runs that a report lists one by one."""
ENOUGH_TRACKED = 0.9
"""Share of the frames below which a run is named among those that lost frames."""
MOST_POINTS = 100
"""Points of a design whose means a report lists; runs.csv holds those of larger ones."""
MOST_INTERACTION_FACTORS = 6
"""Factors whose interactions are drawn; 36 plots fill a page."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Quadratic model of the first response, its optimum and the best point of the design.

    Attributes:
        surface: The model.
        best: Its optimum.
        point: Values of all factors at the optimum; those without numbers have their best level.
        best_point: Values of all factors at the best point of the design.
        reasons: What speaks against the optimum before it is confirmed, each a sentence.
    """

    surface: "Surface"
    best: "Optimum"
    point: Point
    best_point: Point
    reasons: tuple[str, ...]


def usable(table: Table, name: str, log: bool = False) -> Table:
    """Runs that have a response, under the column ``name``.

    Raises:
        ConfigError: No run has it, or its logarithm does not exist.
    """
    key = RESPONSES[name].key
    if key not in table or table[key].isna().all():
        errors = list(table["error"].dropna()) if "error" in table else []
        reason = f"; the first error: {errors[0]}" if errors else ""
        raise ConfigError(f"no run has the response {name}{reason}")
    out = table[table[key].notna()].copy()
    values = out[key].astype(float)
    if log and (values <= 0).any():
        raise ConfigError(f"the response {name} is 0 in some runs and has no logarithm there; take it out of log")
    out[name] = np.log(values) if log else values
    return out.reset_index(drop=True)


def predict_optimum(table: Table, factors: Sequence[Factor], name: str, log: bool = False) -> "Prediction | str":
    """Quadratic model of a response and its optimum, or a sentence that says why there is none."""
    data = usable(table, name, log)
    surface = response_surface.fit_surface(data, factors, name, RESPONSES[name].better)
    if isinstance(surface, str):
        return surface
    best = response_surface.optimum(surface)
    low = RESPONSES[name].better == "low"
    keys = [factor.key for factor in factors]
    complete = data.groupby("point").filter(lambda group: len(group) == data.groupby("point").size().max())
    means = complete.groupby("point")[name].mean()
    first = data[data["point"] == (means.idxmin() if low else means.idxmax())].iloc[0]
    point: dict[str, Any] = {}
    for factor in factors:
        levels = data.groupby(data[factor.key].map(str))[name].mean()
        label = levels.idxmin() if low else levels.idxmax()
        usual = data[factor.key][data[factor.key].map(str) == label].iloc[0]
        point[factor.key] = best.values.get(factor.key, _plain(usual))
    reasons = judgement.judge(surface, best, response_surface.lack_of_fit(surface), judgement.influence(surface))
    return Prediction(surface, best, point, {key: _plain(first[key]) for key in keys}, reasons)


def _plain(value: Any) -> Any:  # noqa: ANN401 - a value of a table as plain Python
    return value.item() if isinstance(value, np.generic) else value


def heading_of(name: str, log: bool) -> str:
    """Name of a response with its unit."""
    return f"log of {RESPONSES[name].heading}" if log else RESPONSES[name].heading


def describe_response(
    report: Report, table: Table, factors: Sequence[Factor], name: str, options: DesignOptions, log: bool
) -> None:
    """Add everything that is known about one response but the confirmation of its optimum."""
    data, heading = usable(table, name, log), heading_of(name, log)
    report.heading(heading)
    if options.kind == "plackett-burman":
        screening.describe_screening(report, screening.screen(data, factors, name), heading)
        return
    effects = main_effects(data, factors, name)
    report.figure(figures.main_effects_figure(effects, heading), "Main effects, with 95 % intervals of the means.")
    if 2 <= len(factors) <= MOST_INTERACTION_FACTORS:
        pairs = interactions(data, factors, name)
        report.figure(figures.interactions_figure(pairs, factors, heading), "Interactions: means of pairs of levels.")
    variance = anova(data, factors, name)
    if variance is None:
        report.text("There is no analysis of variance: the runs do not suffice, or the response does not vary.")
    else:
        report.text(f"Analysis of variance ({variance.formula}; {variance.residual_dof} residual degrees of freedom):")
        report.table(variance.table.reset_index(names="term"))
    describe_indices(report, table, data, factors, name, options, log)
    predicted = predict_optimum(table, factors, name, log)
    if isinstance(predicted, str):
        report.text(predicted)
    else:
        describe_surface(report, predicted, heading)


def describe_keys(
    report: Report, table: Table, factors: Sequence[Factor], names: Sequence[str], log: Sequence[str]
) -> Table:
    """Add the keys that matter for any response and the keys that do not; return all effects of all responses."""
    import pandas as pd

    effects = {}
    for name in names:
        try:
            effects[name] = screening.screen(usable(table, name, name in log), factors, name)
        except ConfigError:  # said under the heading of the response
            continue
    if not effects:
        return pd.DataFrame()
    found = screening.which_matter(effects).set_index("key")
    matter, rest = found.dropna(how="all"), found.index[found.isna().all(axis=1)]
    report.heading("Which keys matter")
    if len(matter):
        report.text("Largest significant effect in standard deviations of the residual:")
        report.table(matter.loc[matter.abs().max(axis=1).sort_values(ascending=False).index].reset_index())
    report.text(f"Without a significant effect on any response ({len(rest)}): {', '.join(rest)}.")
    return pd.concat(effects, names=["response"]).reset_index("response")


def describe_indices(
    report: Report,
    table: Table,
    data: Table,
    factors: Sequence[Factor],
    name: str,
    options: DesignOptions,
    log: bool,
) -> None:
    """Add the sensitivity indices of a sampled design."""
    if options.kind in ("latin-hypercube", "sobol"):
        found, text = indices.emulated_indices(data, factors, name, options.seed)
        report.text(text)
    elif options.kind in ("saltelli", "morris"):
        means = data.groupby("point")[name].mean()
        if len(data) < len(table) or len(means) != table["point"].nunique():
            report.text(f"There are no indices: {len(table) - len(data)} runs of the design have no {name}.")
            return
        values = means.sort_index().to_numpy()
        if options.kind == "morris":
            points = table.groupby("point")[[factor.key for factor in factors]].first().sort_index()
            coded = coded_points(factors, points.to_dict("records"))
            report.text("Elementary effects of Morris, from one end of a factor to the other:")
            report.table(indices.morris_indices(factors, coded, values))
            return
        if np.ptp(values) == 0:
            report.text("There are no indices: the response does not vary.")
            return
        found = indices.sobol_indices(factors, values, options.seed)
    else:
        return
    if found is not None:
        report.table(found)
        report.figure(figures.indices_figure(found), "Sobol indices with 95 % intervals.")


def describe_surface(report: Report, predicted: Prediction, heading: str) -> None:
    """Add the quadratic model, its optimum and what speaks against it."""
    surface, best = predicted.surface, predicted.best
    report.text(
        f"Full quadratic model: R2 = {surface.r2:.2f}, {surface.r2_predicted:.2f} when each run is left out in turn, "
        f"residual standard deviation {surface.residual_sd:.3g}."
    )
    fit = response_surface.lack_of_fit(surface)
    report.text(
        "Lack of fit cannot be tested: no point was repeated."
        if fit is None
        else f"Lack of fit: F = {fit.f:.2f}, p = {fit.p:.2g}, {fit.pure_dof} degrees of freedom of the pure error."
    )
    report.figure(figures.residuals_figure(surface), "Residuals, their normal quantiles, and Cook's distances.")
    report.figure(
        figures.surface_figure(surface, best, heading), "Prediction through the optimum, with 95 % intervals."
    )
    canonical = response_surface.canonical_analysis(surface)
    where = "outside the bounds" if canonical.values is None else values_text(canonical.values)
    eigenvalues = ", ".join(f"{value:.3g}" for value in canonical.eigenvalues)
    report.text(
        f"Stationary point: a {canonical.kind} of {canonical.predicted:.4g}, {where}; eigenvalues {eigenvalues}."
        if canonical.point is not None
        else f"There is no single stationary point; eigenvalues {eigenvalues}."
    )
    report.text(f"Optimum within the bounds: {best.predicted:.4g} at {values_text(best.values)}.")
    if not predicted.reasons:
        report.text("Nothing in the runs speaks against it; a confirmation is still needed.")
    else:
        report.text("Reasons to doubt it before it is measured:")
        report.items(predicted.reasons)


def values_text(values: Point | dict[str, float]) -> str:
    """Values of factors in words."""
    return ", ".join(
        f"{key.rpartition('.')[2]} {value:.4g}" if isinstance(value, float) else f"{key.rpartition('.')[2]} {value}"
        for key, value in values.items()
    )


def point_table(table: Table, factors: Sequence[Factor], names: Sequence[str]) -> Table:
    """Mean responses of every point all of whose runs succeeded."""
    keys = [RESPONSES[name].key for name in names]
    complete = table.dropna(subset=[key for key in keys if key in table])
    sizes = complete.groupby("point").size()
    whole = complete[complete["point"].map(sizes) == table.groupby("point").size().max()]
    means = whole.groupby("point").agg(
        {**{factor.key: "first" for factor in factors}, **{key: "mean" for key in keys if key in table}}
    )
    return means.rename(columns={RESPONSES[name].key: name for name in names}).reset_index(drop=True)


def pareto_front(points: Table, names: Sequence[str]) -> Table:
    """Rows of the Pareto front, sorted by the first response (Optuna's ``best_trials``).

    Args:
        points: One row per point with a column per response.
        names: Names of two or more responses.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    directions: Any = ["minimize" if RESPONSES[name].better == "low" else "maximize" for name in names]
    study = optuna.create_study(directions=directions)
    complete = points.dropna(subset=list(names))
    for number in complete.index:
        values = [float(value) for value in complete.loc[number, list(names)]]
        study.add_trial(optuna.trial.create_trial(values=values, user_attrs={"row": int(number)}))
    front = [trial.user_attrs["row"] for trial in study.best_trials] if len(complete) else []
    return complete.loc[front].sort_values(names[0], ascending=RESPONSES[names[0]].better == "low")


def describe_pareto(report: Report, table: Table, factors: Sequence[Factor], names: Sequence[str]) -> None:
    """Add the Pareto front of the first response and the time per frame, or else the second response."""
    if len(names) < 2:
        return
    pair = (names[0], "ms" if "ms" in names[1:] else names[1])
    points = point_table(table, factors, pair)
    if points.empty or any(name not in points for name in pair):
        return
    front = pareto_front(points, pair)
    headings = [RESPONSES[name].heading for name in pair]
    report.heading(f"Pareto front: {headings[0]} against {headings[1]}")
    report.figure(figures.pareto_figure(points, front, pair, headings), "Means of the points over all recordings.")
    report.table(front)


def describe_points(report: Report, table: Table, factors: Sequence[Factor], names: Sequence[str]) -> None:
    """Add the mean responses of all points, if a reader can take them in."""
    points = point_table(table, factors, names)
    if 0 < len(points) <= MOST_POINTS:
        report.heading("Means of all points over the recordings")
        report.table(points)


def describe_losses(report: Report, table: Table) -> None:
    """Add the runs that lost many frames: errors are those of the tracked frames only, and may be small for that."""
    if "tracked_share" not in table:
        return
    partial = table[table["tracked_share"] < ENOUGH_TRACKED]
    if partial.empty:
        return
    report.heading("Runs that lost frames")
    report.text(f"{len(partial)} of {len(table)} runs tracked less than {ENOUGH_TRACKED:.0%} of the frames. Trajectory "
                "errors are those of the tracked frames, so that such a run may look better than one that tracks all: "
                "read them together with the response lost.")  # fmt: skip
    counts = partial.groupby("sequence", sort=False).size()
    report.items(f"{name}: {count} of {(table['sequence'] == name).sum()}" for name, count in counts.items())


def describe_failures(report: Report, table: Table) -> None:
    """Add the runs that failed, which are missing from every figure above."""
    if "error" not in table or table["error"].isna().all():
        return
    failed = table[table["error"].notna()]
    report.heading("Failed runs")
    report.text(f"{len(failed)} of {len(table)} runs failed and are missing above. If they have something in common, "
                "the figures above are biased.")  # fmt: skip
    report.items(f"{row['sequence']}, run {row['run']}: {row['error']}"
                 for row in failed.head(MOST_FAILURES).to_dict("records"))  # fmt: skip
