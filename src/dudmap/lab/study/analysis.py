"""Analysis of a study, response by response, as a report. Missing responses raise a ``ConfigError``."""

from typing import TYPE_CHECKING

from dudmap.lab.study import report as figures
from dudmap.lab.study import screening
from dudmap.lab.study.designs import Table
from dudmap.lab.study.effects import anova, interactions, main_effects
from dudmap.lab.study.report import Report
from dudmap.lab.study.response_surface import Prediction, predict_optimum, values_text
from dudmap.lab.study.responses import RESPONSES

if TYPE_CHECKING:
    from dudmap.lab.study.plan import Plan

MOST_FAILURES = 10
ENOUGH_TRACKED = 0.9
"""Share of tracked frames below which a run is listed."""
MOST_POINTS = 100
MOST_INTERACTION_FACTORS = 6


def describe_response(report: Report, plan: "Plan", table: Table, name: str) -> Table | None:
    """Add the analysis of one response; return the effects of a Plackett-Burman design."""
    scale, factors = plan.scale(name), plan.factors
    report.heading(scale.heading)
    data = scale.usable(table)
    if plan.options.kind == "plackett-burman":
        effects = screening.screen(data, factors, name)
        screening.describe_screening(report, effects, scale.heading)
        return effects
    means = figures.main_effects_figure(main_effects(data, factors, name), scale.heading)
    report.figure(means, "Main effects, with 95 % intervals of the means.")
    if 2 <= len(factors) <= MOST_INTERACTION_FACTORS:
        pairs = figures.interactions_figure(interactions(data, factors, name), factors, scale.heading)
        report.figure(pairs, "Interactions: means of pairs of levels.")
    variance = anova(data, factors, name)
    if variance is None:
        report.text("There is no analysis of variance: the runs do not suffice, or the response does not vary.")
    else:
        report.text(f"Analysis of variance ({variance[1]}):")
        report.table(variance[0].reset_index(names="term"))
    predicted = predict_optimum(data, factors, scale)
    if isinstance(predicted, str):
        report.text(predicted)
    else:
        describe_surface(report, predicted)
    return None


def describe_surface(report: Report, predicted: Prediction) -> None:
    """Add the quadratic model, its optimum and doubts."""
    surface, best = predicted.surface, predicted.best
    report.text(
        f"Full quadratic model: R2 = {surface.r2:.2f}, {surface.r2_predicted:.2f} by leave-one-out, "
        f"residual standard deviation {surface.residual_sd:.3g}{surface.scale.unit}."
    )
    figure = figures.surface_figure(surface, best, surface.scale.heading)
    report.figure(figure, "Prediction through the optimum, with 95 % intervals.")
    report.text(f"Optimum within the bounds: {surface.scale.text(best.predicted)} at {values_text(best.values)}.")
    if not predicted.reasons:
        report.text("Nothing in the runs speaks against it; a confirmation is still needed.")
    else:
        report.text("Reasons to doubt it before it is measured:")
        report.items(predicted.reasons)


def point_table(plan: "Plan", table: Table) -> Table:
    """Mean responses of every point without failed runs."""
    known = {name: RESPONSES[name] for name in plan.responses if RESPONSES[name].key in table}
    complete = table.dropna(subset=[response.key for response in known.values()])
    sizes = complete.groupby("point")["run"].transform("size")
    whole = complete[sizes == table.groupby("point").size().max()].groupby("point")
    means = whole[[factor.key for factor in plan.factors]].first()
    for name, response in known.items():
        means[name] = response.factor * whole[response.key].mean()
    return means.reset_index(drop=True)


def describe_points(report: Report, plan: "Plan", table: Table) -> None:
    """Add the means of all points, best first."""
    points = point_table(plan, table)
    known = [name for name in plan.responses if name in points]
    if not known or len(points) > MOST_POINTS:
        return
    points = points.sort_values(known[0], ascending=RESPONSES[known[0]].better == "low")
    report.heading("Means of all points over the recordings")
    report.table(points.rename(columns={name: RESPONSES[name].heading for name in known}))


def describe_losses(report: Report, table: Table) -> None:
    """Add the runs that lost many frames, whose errors may look small."""
    if "tracked_share" not in table or not (table["tracked_share"] < ENOUGH_TRACKED).any():
        return
    partial = table[table["tracked_share"] < ENOUGH_TRACKED]
    report.heading("Runs that lost frames")
    report.text(f"{len(partial)} of {len(table)} runs tracked less than {ENOUGH_TRACKED:.0%} of the frames. Trajectory "
                "errors cover tracked frames only, so that such a run may look better than one that tracks all: "
                "read them together with the response lost.")  # fmt: skip
    counts = partial.groupby("sequence", sort=False).size()
    report.items(f"{name}: {count} of {(table['sequence'] == name).sum()}" for name, count in counts.items())


def describe_failures(report: Report, table: Table) -> None:
    """Add the failed runs."""
    if "error" not in table or table["error"].isna().all():
        return
    failed = table[table["error"].notna()]
    report.heading("Failed runs")
    report.text(f"{len(failed)} of {len(table)} runs failed and are missing above. If they have something in common, "
                "the figures above are biased.")  # fmt: skip
    report.items(f"{row['sequence']}, run {row['run']}: {row['error']}"
                 for row in failed.head(MOST_FAILURES).to_dict("records"))  # fmt: skip
