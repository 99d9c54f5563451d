"""A whole study: its runs, its confirmation, its tables and its report."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from dudmap.errors import ConfigError
from dudmap.lab.study.conduct import Progress, conduct, table_of
from dudmap.lab.study.designs import Table
from dudmap.lab.study.plan import MAX_RUNS, Plan, Run
from dudmap.lab.study.worker import Executor

if TYPE_CHECKING:
    from dudmap.lab.study.response_surface import Confirmation, Prediction

NOTHING = "There is nothing to confirm."


def run_study(
    plan: Plan,
    out: Path,
    executor: Executor,
    *,
    max_runs: int = MAX_RUNS,
    keep: bool = False,
    report: Callable[[Progress], None] = lambda progress: None,
) -> str:
    """Do all runs that are missing, confirm the optimum, and write runs.csv, confirmation.csv and the report.

    The executor is closed. ``keep`` keeps whole run folders; ``report`` is called after every run.

    Returns:
        The outcome in words.

    Raises:
        DudmapError: The study is refused before anything is run (``Plan.check``), or no run has a response.
    """
    from dudmap.lab.study.response_surface import predict_optimum

    try:
        plan.check(max_runs)
        runs, scale = plan.runs(), plan.scale(plan.responses[0])
        do = partial(conduct, root=out, executor=executor, keep=keep, report=report)
        state = do(runs)
        table = table_of(runs, out)
        table.to_csv(out / "runs.csv", index=False)
        predicted = predict_optimum(scale.usable(table), plan.factors, scale)
        confirmation = NOTHING if isinstance(predicted, str) or not plan.confirm else _confirm(plan, predicted, out, do)
        each = confirm_each(plan, table, out, do) if plan.each else None
    finally:
        executor.close()
    died = f"; {state.deaths} workers died" if state.deaths else ""
    return write_report(plan, table, predicted, confirmation, out, f"{executor.workers} at a time{died}", each)


def confirm_each(plan: Plan, table: Table, out: Path, do: Callable[[Sequence[Run]], Progress]) -> Table:
    """Model, optimum and confirmation of every recording on its own; also written to each.csv.

    One row per recording: values of the factors at the optimum, R2 of the model, R2 when each run is left out in turn,
    prediction, mean of the confirmation runs, best point of the design on the same recordings, frames lost in the
    confirmation runs, whether the model held, and whether anything spoke against it before.
    """
    import pandas as pd

    from dudmap.lab.study.response_surface import predict_optimum

    scale, rows = plan.scale(plan.responses[0]), []
    for recording in plan.recordings:
        alone = replace(plan, entries=tuple(entry for entry in plan.entries if entry[0] == recording))
        predicted = predict_optimum(scale.usable(table[table["sequence"] == recording]), plan.factors, scale)
        if isinstance(predicted, str):
            rows.append({"recording": recording, "held": predicted})
            continue
        point, surface = {key.rpartition(".")[2]: value for key, value in predicted.point.items()}, predicted.surface
        row = {"recording": recording, **point, "R2": surface.r2, "R2 left out": surface.r2_predicted}
        row |= {"best run": scale.plain(surface.best_seen), "predicted": scale.plain(predicted.best.predicted)}
        file = f"confirmation-{recording}.csv"
        found = _confirm(alone, predicted, out, do, file)
        if isinstance(found, str):
            rows.append(row | {"held": found})
            continue
        runs = pd.read_csv(out / file)
        row |= {"measured": scale.plain(found.measured), "best point": scale.plain(found.best_point)}
        row["lost at the optimum"] = float(runs.loc[runs["at"] == "optimum", "lost"].mean())
        warned = "yes" if predicted.reasons else "no"
        rows.append(row | {"held": "yes" if found.held else "no", "warned before": warned})
    each = pd.DataFrame(rows)
    each.to_csv(out / "each.csv", index=False)
    return each


def _confirm(
    plan: Plan,
    predicted: "Prediction",
    out: Path,
    do: Callable[[Sequence[Run]], Progress],
    file: str = "confirmation.csv",
) -> "Confirmation | str":
    """Run the optimum and the best point of the design on the same recordings."""
    import pandas as pd

    from dudmap.lab.study.response_surface import confirm

    scale = plan.scale(plan.responses[0])
    at_optimum, at_best = plan.confirmation_runs(predicted.point), plan.confirmation_runs(predicted.best_point)
    do([*at_optimum, *at_best])
    tables = {"optimum": table_of(at_optimum, out), "best point of the design": table_of(at_best, out)}
    pd.concat(tables, names=["at"]).reset_index("at").to_csv(out / file, index=False)
    try:
        measured, best = (scale.usable(table)[scale.response].tolist() for table in tables.values())
    except ConfigError as error:
        return f"The prediction was not confirmed: a confirmation failed, {error}."
    if len(measured) < len(at_optimum):
        failed = f"{len(at_optimum) - len(measured)} of {len(at_optimum)} confirmation runs failed"
        return f"The prediction was not confirmed: {failed}."
    return confirm(predicted.surface, predicted.best, measured, best)


def write_report(
    plan: Plan,
    table: Table,
    predicted: "Prediction | str",
    confirmation: "Confirmation | str",
    out: Path,
    how: str,
    each: Table | None = None,
) -> str:
    """Write report.md and report.html; return the outcome in words."""
    from dudmap.app.pipeline.environment import machine, versions
    from dudmap.lab.study import analysis, screening
    from dudmap.lab.study.report import Report
    from dudmap.lab.study.response_surface import values_text

    report, first = Report(f"Study {plan.name}"), plan.scale(plan.responses[0])
    report.text(
        f"{plan.options.kind} design of {len(plan.factors)} factors, {table['point'].nunique()} points, "
        f"{len(table)} runs on {', '.join(plan.recordings)}; {how}."
    )
    report.items(
        f"{f.key}: {', '.join(map(str, f.levels)) if f.levels else f'{f.low:g} to {f.high:g} ({f.scale})'}"
        for f in plan.factors
    )
    report.text(f"Base configuration: {plan.base.preset}. {machine()['cpu']}, {versions()}".replace("'", ""))
    effects: dict[str, Table] = {}
    for name in plan.responses:
        try:
            found = analysis.describe_response(report, plan, table, name)
            effects |= {} if found is None else {name: found}
        except ConfigError as error:
            report.text(f"{error}.")
        if name == first.response:
            report.heading("Confirmation")
            report.text(str(confirmation))
            if each is not None:
                report.heading(f"{plan.scale(name)._replace(log=False).heading}: each recording on its own")
                report.table(each)
    screened = plan.options.kind == "plackett-burman"
    if screened:
        import pandas as pd

        report.heading("Which keys matter")
        report.text(screening.summary(effects))
        if effects:
            pd.concat(effects, names=["response"]).reset_index("response").to_csv(out / "effects.csv", index=False)
    else:
        analysis.describe_points(report, plan, table)
    analysis.describe_losses(report, table)
    analysis.describe_failures(report, table)
    report.save(out)
    if screened or isinstance(predicted, str):
        return screening.summary(effects) if screened else str(predicted)
    best = first.text(predicted.best.predicted)
    lines = [f"{first.heading}: predicted optimum {best} at {values_text(predicted.point)}."]
    if predicted.reasons:
        lines += ["Reasons to doubt it before it is measured:", *(f"- {reason}" for reason in predicted.reasons)]
    return "\n".join([*lines, f"Confirmation runs: {confirmation}"])
