"""A whole study, and the thesis' chapter 6 as studies. Impossible ones raise a ``DudmapError`` before the first run."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dudmap.errors import ConfigError
from dudmap.lab.data import find
from dudmap.lab.study.designs import Table
from dudmap.lab.study.plan import MAX_RUNS, Plan, make_plan
from dudmap.lab.study.responses import RESPONSES
from dudmap.lab.study.runs import Conduct, table_of

if TYPE_CHECKING:
    from dudmap.lab.study.response_surface import Confirmation, Prediction

NOTHING = "There is nothing to confirm."


def run_study(plan: Plan, out: Path, conduct: Conduct, max_runs: int = MAX_RUNS) -> str:
    """Do all runs, confirm the optimum, write runs.csv, confirmation.csv and report; the outcome in words."""
    from dudmap.lab.study.response_surface import predict_optimum

    plan.check(max_runs)
    runs, scale = plan.runs(), plan.scale(plan.responses[0])
    table = table_of(runs, conduct(runs))
    table.to_csv(out / "runs.csv", index=False)
    predicted = predict_optimum(scale.usable(table), plan.factors, scale)
    confirmation = (
        NOTHING if isinstance(predicted, str) or not plan.file.confirm else _confirm(plan, predicted, out, conduct)
    )
    return write_report(plan, table, predicted, confirmation, out)


def _confirm(plan: Plan, predicted: "Prediction", out: Path, conduct: Conduct) -> "Confirmation | str":
    import pandas as pd

    from dudmap.lab.study.response_surface import confirm

    scale = plan.scale(plan.responses[0])
    at_optimum, at_best = plan.confirmation_runs(predicted.point), plan.confirmation_runs(predicted.best_point)
    rows = conduct([*at_optimum, *at_best])
    tables = {"optimum": table_of(at_optimum, rows[: len(at_optimum)]),
              "best point of the design": table_of(at_best, rows[len(at_optimum) :])}  # fmt: skip
    pd.concat(tables, names=["at"]).reset_index("at").to_csv(out / "confirmation.csv", index=False)
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
) -> str:
    """Write report.md and report.html; return the outcome in words."""
    from dudmap.app.pipeline.environment import machine, versions
    from dudmap.lab.study import analysis, screening
    from dudmap.lab.study.report import Report
    from dudmap.lab.study.response_surface import values_text

    report, first = Report(f"Study {plan.name}"), plan.scale(plan.responses[0])
    report.text(
        f"{plan.options.kind} design of {len(plan.factors)} factors, {table['point'].nunique()} points, "
        f"{len(table)} runs on {', '.join(plan.recordings)}."
    )
    report.items(
        f"{f.key}: {', '.join(map(str, f.levels)) if f.levels else f'{f.low:g} to {f.high:g} ({f.scale})'}"
        for f in plan.factors
    )
    report.text(f"System: {plan.base.system}. {machine()['cpu']}, {versions()}".replace("'", ""))
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
    lines = [f"{RESPONSES[first.response].name}: predicted optimum {best} at {values_text(predicted.point)}."]
    if predicted.reasons:
        lines += ["Reasons to doubt it before it is measured:", *(f"- {reason}" for reason in predicted.reasons)]
    return "\n".join([*lines, f"Confirmation runs: {confirmation}"])


HUBER, DAMPING, VOXEL, WEIGHT = "thesis.rho", "thesis.lambda_0", "thesis.tau", "thesis.upsilon"
TABLES: Mapping[str, dict[str, list[Any]]] = {
    "6.1": {HUBER: [0.005, 0.01, 0.025], DAMPING: [0.002, 0.01, 0.02], VOXEL: [0.01, 0.02, 0.05],
            WEIGHT: [0.025, 0.1, 0.175]},
    "6.2": {WEIGHT: [0.1, 0.11, 0.12, 0.125, 0.1275, 0.13, 0.1325, 0.14, 0.15, 0.175]},
    "6.3": {VOXEL: [0.005, 0.01, 0.02, 0.05], WEIGHT: [0.01, 0.025, 0.04]},
    "4.1": {HUBER: [0.002, 0.005, 0.01, 0.02], DAMPING: [0.002, 0.005, 0.02, 0.1]},
    "4.2": {"thesis.iterations": [1, 2, 3, 6], "thesis.subsample": ["original", "quarter"]},
    "figure 4.5": {"thesis.similarity": [0.6, 0.7, 0.75, 0.8, 0.84, 0.9, 1.0]},
}  # fmt: skip
"""Factors and levels of the thesis' tables 4.1, 4.2, 6.1 (figures 6.1, 6.2, 6.4), 6.2 (6.3), 6.3, figures 4.5 and 4.6;
the band is fixed in metres."""
ROOM: dict[str, Any] = {
    "name": "room", "scene": "room", "movers": ["person"], "frames": 240, "camera": [320, 240],
}  # fmt: skip
"""Default recording: a room with a walking person. The thesis took freiburg3_walking_xyz (6.1, 6.2) and
freiburg3_walking_static (6.3)."""
PUBLISHED_CONFIRMATION = 89.0
"""ATE at the thesis' quadratic optimum, millimetres (section 6.1)."""


def thesis_plan(table: str = "6.1", recordings: Sequence[Path] = (), frames: int | None = None) -> Plan:
    """Plan of one of ``TABLES``, on ``ROOM`` by default."""
    some = {} if frames is None else {"frames": frames}
    return make_plan(
        {
            "name": f"thesis, {table}" if " " in table else f"thesis, table {table}",
            "base": ["system=thesis"],
            "factors": find(table, TABLES, "table"),
            "sequences": [{"path": str(path.absolute()), **some} for path in recordings] or [{**ROOM, **some}],
        }
    )


def published_table() -> Table:
    """The 81 values of table 6.1: ATE RMSE in metres, freiburg3_walking_xyz."""
    import pandas as pd

    with (files("dudmap.lab.study") / "thesis_table_6_1.csv").open(encoding="utf-8") as file:
        given = pd.read_csv(file)
    columns = {"huber": HUBER, "damping": DAMPING, "voxel_size": VOXEL, "color_weight": WEIGHT, "ate_m": "ate_rmse_m"}
    return given.rename(columns=columns).assign(
        run=given.index, point=given.index, sequence="freiburg3_walking_xyz", replicate=0
    )


def published_report(out: Path) -> str:
    """Analyse the printed table 6.1; write the report and return the outcome.

    Confirmed by the thesis: 0.089 m at its optimum, 0.080 m at the best design point.
    """
    from dudmap.lab.study.response_surface import confirm, predict_optimum

    plan, table = thesis_plan(), published_table()
    recording = (str(table["sequence"][0]), 0, plan.entries[0][2])
    plan = replace(plan, name="thesis, table 6.1 as published", entries=(recording,), responses=("ate",))
    out.mkdir(parents=True, exist_ok=True)
    table.to_csv(out / "runs.csv", index=False)
    scale = plan.scale("ate")
    data = scale.usable(table)
    predicted = predict_optimum(data, plan.factors, scale)
    assert not isinstance(predicted, str)
    confirmation = confirm(predicted.surface, predicted.best, [PUBLISHED_CONFIRMATION], [float(data["ate"].min())])
    return write_report(plan, table, predicted, confirmation, out)
