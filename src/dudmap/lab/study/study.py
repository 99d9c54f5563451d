"""A whole study: its runs, its confirmation, its tables and its report."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from dudmap.errors import ConfigError
from dudmap.lab.study.conduct import Progress, conduct, table_of
from dudmap.lab.study.effects import effects_by_recording
from dudmap.lab.study.executor import Executor
from dudmap.lab.study.plan import MAX_RUNS, Plan, Run, sequence_names
from dudmap.lab.study.tables import Table

if TYPE_CHECKING:
    from dudmap.lab.study.analysis import Prediction
    from dudmap.lab.study.judgement import Confirmation


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

    Args:
        plan: The study.
        out: Its folder.
        executor: Where the runs are done; it is closed.
        max_runs: Largest number of runs.
        keep: Keep whole run folders.
        report: Called after every run.

    Returns:
        The outcome in words.

    Raises:
        DudmapError: The study is refused before anything is run (``Plan.check``), or no run has a response.
    """
    from dudmap.lab.study.analysis import predict_optimum

    try:
        plan.check(max_runs)
        runs = plan.runs()
        do = partial(conduct, root=out, executor=executor, keep=keep, report=report)
        state = do(runs)
        table = table_of(runs, out)
        table.to_csv(out / "runs.csv", index=False)
        predicted = predict_optimum(table, plan.factors, plan.responses[0], plan.responses[0] in plan.log)
        confirmation: Confirmation | str = "There is nothing to confirm."
        if not isinstance(predicted, str) and plan.confirm:
            confirmation = _confirm(plan, predicted, out, do)
        each = confirm_each(plan, table, out, do) if plan.each else None
    finally:
        executor.close()
    return write_report(plan, table, predicted, confirmation, out, executor.workers, state, each)


def confirm_each(plan: Plan, table: Table, out: Path, do: Callable[[Sequence[Run]], Progress]) -> Table:
    """Model, optimum and confirmation of every recording on its own; also written to each.csv.

    One row per recording: values of the factors at the optimum, R2 of the model, R2 when each run is left out in turn,
    prediction, mean of the confirmation runs, best point of the design on the same recordings, frames lost in the
    confirmation runs, whether the model held, and whether anything spoke against it before.
    """
    import numpy as np
    import pandas as pd

    from dudmap.lab.study.analysis import predict_optimum

    name, rows = plan.responses[0], []
    plain = np.exp if name in plan.log else np.asarray
    for recording in sequence_names(plan):
        alone = replace(plan, entries=tuple(entry for entry in plan.entries if entry[0] == recording))
        predicted = predict_optimum(table[table["sequence"] == recording], plan.factors, name, name in plan.log)
        if isinstance(predicted, str):
            rows.append({"recording": recording, "held": predicted})
            continue
        point = {key.rpartition(".")[2]: value for key, value in predicted.point.items()}
        surface = predicted.surface
        row = {"recording": recording, **point, "R2": surface.r2, "R2 left out": surface.r2_predicted}
        row |= {"best run": float(plain(surface.best_seen)), "predicted": float(plain(predicted.best.predicted))}
        file = f"confirmation-{recording}.csv"
        found = _confirm(alone, predicted, out, do, file)
        if isinstance(found, str):
            rows.append(row | {"held": found})
            continue
        row |= {"measured": float(plain(found.measured)), "best point": float(plain(found.best_point))}
        runs = pd.read_csv(out / file)
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

    from dudmap.lab.study.analysis import usable
    from dudmap.lab.study.judgement import confirm

    name = plan.responses[0]
    at_optimum, at_best = plan.confirmation_runs(predicted.point), plan.confirmation_runs(predicted.best_point)
    do([*at_optimum, *at_best])
    tables = [table_of(at_optimum, out), table_of(at_best, out)]
    pd.concat(tables, keys=["optimum", "best point of the design"], names=["at"]).reset_index("at").to_csv(
        out / file, index=False
    )
    try:
        measured, best = (usable(table, name, name in plan.log) for table in tables)
    except ConfigError as error:
        return f"The prediction was not confirmed: a confirmation failed, {error}."
    if len(measured) < len(at_optimum):
        failed = f"{len(at_optimum) - len(measured)} of {len(at_optimum)} confirmation runs failed"
        return f"The prediction was not confirmed: {failed}."
    return confirm(predicted.surface, predicted.best, measured[name].tolist(), best[name].tolist())


def write_report(
    plan: Plan,
    table: Table,
    predicted: "Prediction | str",
    confirmation: "Confirmation | str",
    out: Path,
    workers: int,
    state: Progress | None = None,
    each: Table | None = None,
) -> str:
    """Write report.md and report.html; return the outcome in words."""
    from dudmap.app.pipeline.environment import machine, versions
    from dudmap.lab.study import analysis, screening
    from dudmap.lab.study.report import Report

    report = Report(f"Study {plan.name}")
    died = f" {state.deaths} workers died." if state and state.deaths else ""
    report.text(
        f"{plan.options.kind} design of {len(plan.factors)} factors, {table['point'].nunique()} points, "
        f"{len(table)} runs on {', '.join(sequence_names(plan))}; {workers} at a time.{died}"
    )
    report.items(
        f"{f.key}: {', '.join(map(str, f.levels)) if f.levels else f'{f.low:g} to {f.high:g} ({f.scale})'}"
        for f in plan.factors
    )
    report.text(f"Base configuration: {plan.base.preset}. {machine()['cpu']}, {versions()}".replace("'", ""))
    for name in plan.responses:
        try:
            analysis.describe_response(report, table, plan.factors, name, plan.options, name in plan.log)
        except ConfigError as error:
            report.heading(name)
            report.text(f"{error}.")
        if name == plan.responses[0]:
            report.heading("Confirmation")
            report.text(str(confirmation))
            if each is not None:
                report.heading(f"{analysis.heading_of(name, False)}: each recording on its own")
                report.table(each)
                levels = effects_by_recording(analysis.usable(table, name, name in plan.log), plan.factors, name)
                levels.to_csv(out / "levels.csv", index=False)
                report.text(f"Mean {analysis.heading_of(name, name in plan.log)} at every level:")
                report.table(levels)
    effects = None
    if plan.options.kind == "plackett-burman":
        effects = analysis.describe_keys(report, table, plan.factors, plan.responses, plan.log)
        effects.to_csv(out / "effects.csv", index=False)
    else:
        analysis.describe_pareto(report, table, plan.factors, plan.responses)
        analysis.describe_points(report, table, plan.factors, plan.responses)
    analysis.describe_losses(report, table)
    analysis.describe_failures(report, table)
    report.save(out)
    heading = analysis.heading_of(plan.responses[0], plan.responses[0] in plan.log)
    return outcome(heading, predicted, confirmation) if effects is None else screening.summary(effects)


def outcome(heading: str, predicted: "Prediction | str", confirmation: "Confirmation | str") -> str:
    """What a study found of the response with a heading, name and unit, in words."""
    from dudmap.lab.study.analysis import values_text

    if isinstance(predicted, str):
        return predicted
    lines = [f"{heading}: predicted optimum {predicted.best.predicted:.4g} at {values_text(predicted.point)}."]
    if predicted.reasons:
        lines += ["Reasons to doubt it before it is measured:", *(f"- {reason}" for reason in predicted.reasons)]
    return "\n".join([*lines, f"Confirmation runs: {confirmation}"])
