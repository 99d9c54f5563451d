"""Search for a configuration on training recordings, judged on others.

Optuna proposes (multi-objective TPE; Ozaki et al. 2022). Metrics are ratios to the base configuration on the same
recording. Proposals depend on results and seed only, so that a search continues.

A search without judges raises a ``DudmapError`` before the first run.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import ConfigError
from dudmap.lab.benchmark.suites import Entry
from dudmap.lab.study.designs import Factor, Point, Table, configured
from dudmap.lab.study.plan import MAX_RUNS, Plan, place_of
from dudmap.lab.study.responses import RESPONSES, check_truth
from dudmap.lab.study.runs import Conduct

if TYPE_CHECKING:
    import optuna

Numbers = NDArray[np.float64]
Measure = Callable[[Sequence[Point], Plan], list[Numbers | None]]
"""Ratios (recordings, responses) to the base configuration per point; None if a run failed."""

RATIOS = ("ate", "rpe", "mesh_accuracy", "ms", "memory")
"""Positive responses."""
SIGNIFICANT = 0.05
"""Largest p of a recommendation: one-sided t test of log ratios on the second set (Holm)."""
FEWEST_JUDGES = 3
"""Fewest recordings of the second set for a t test."""
BATCH = 4
"""Configurations proposed at a time."""
MOST_JUDGED = 5
"""Judged configurations; each weakens all tests."""


def check_tune(plan: Plan, max_runs: int = MAX_RUNS) -> None:
    """Check everything known before the first run."""
    for name in plan.responses:
        if name not in RATIOS:
            raise ConfigError(f"tune cannot use the response {name}, which can be 0; it knows {', '.join(RATIOS)}")
    if len(plan.judges) < FEWEST_JUDGES:
        raise ConfigError(f"the second set has {len(plan.judges)} recordings (judge); expected {FEWEST_JUDGES} or more")
    trained = {_identity(entry) for _, _, entry in plan.entries}
    for _, _, entry in plan.judges:
        if _identity(entry) in trained:
            raise ConfigError(f"{entry.name} is in both sets; a judge must not have been trained on")
    count = (plan.tune.trials + 1) * len(plan.entries) + (MOST_JUDGED + 1) * len(plan.judges)
    if count > max_runs:
        raise ConfigError(f"the search has up to {count} runs, more than --max-runs {max_runs}")
    for _, _, entry in (*plan.entries, *plan.judges):
        check_truth(entry, entry.open(), plan.responses)


def _identity(entry: Entry) -> str:
    return place_of(entry) or repr(sorted(dict(entry.parameters).items()))


def ratios(points: Sequence[Point], plan: Plan, conduct: Conduct) -> list[Numbers | None]:
    """Ratios (recordings, responses) to the base configuration; None for a point with a failed run.

    A point that loses more frames on any recording has failed.
    """
    runs = [plan.runs_at(number, point) for number, point in enumerate([{}, *points])]
    rows = conduct([run for same in runs for run in same])
    wanted, size = [RESPONSES[name].key for name in plan.responses] + ["lost"], len(plan.entries)
    figures: list[Numbers | None] = []
    for start in range(0, len(rows), size):
        found = np.array([[row.get(key) for key in wanted] for row in rows[start : start + size]], dtype=float)
        figures.append(found if np.all(np.isfinite(found)) and np.all(found[:, :-1] > 0) else None)
    base, *others = figures
    if base is None:
        raise ConfigError("the base configuration fails on one of the recordings; nothing can be compared with it")
    return [
        None if found is None or np.any(found[:, -1] > base[:, -1]) else found[:, :-1] / base[:, :-1]
        for found in others
    ]


def training_front(plan: Plan, measure: Measure) -> list[tuple[Point, tuple[float, ...]]]:
    """The training front with mean ratios, best first response first."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    sampler = optuna.samplers.TPESampler(seed=plan.tune.seed)
    directions: Any = ["minimize"] * len(plan.responses)
    study = optuna.create_study(directions=directions, sampler=sampler)
    for begin in range(0, plan.tune.trials, BATCH):
        trials = [study.ask() for _ in range(min(BATCH, plan.tune.trials - begin))]
        points = [suggest(trial, plan.factors) for trial in trials]
        for trial, point, measured in zip(trials, points, measure(points, plan), strict=True):
            trial.set_user_attr("point", point)
            if measured is None:
                study.tell(trial, state=optuna.trial.TrialState.PRUNED)
            else:
                study.tell(trial, [float(x) for x in geometric_mean(measured)])
    different = {str(t.user_attrs["point"]): t for t in sorted(study.best_trials, key=lambda trial: trial.values)[::-1]}
    chosen = sorted(different.values(), key=lambda trial: trial.values)[:MOST_JUDGED]
    return [(trial.user_attrs["point"], tuple(trial.values)) for trial in chosen]


def judged(plan: Plan, measure: Measure) -> list[tuple[Point, dict[str, Any]]]:
    """Search, and judge the training front on the second set.

    Returns:
        Values of the factors, and a row: per response and set the geometric mean ratio (NaN if failed), p of the first
        response without improvement, and whether it holds.
    """
    from statsmodels.stats.multitest import multipletests

    front, rows = training_front(plan, measure), []
    if not front:
        return []
    found = measure([point for point, _ in front], replace(plan, entries=plan.judges))
    raw = [1.0 if measured is None else improvement_p(measured[:, 0]) for measured in found]
    corrected: Any = multipletests(raw, method="holm")[1]
    for (point, training), measured, p in zip(front, found, corrected, strict=True):
        second = np.full(len(plan.responses), np.nan) if measured is None else geometric_mean(measured)
        row: dict[str, Any] = {key.rpartition(".")[2]: value for key, value in point.items()}
        for name, ratio, other in zip(plan.responses, training, second, strict=True):
            row |= {f"{name}, training": ratio, f"{name}, second set": float(other)}
        holds = "yes" if p < SIGNIFICANT and second[0] < 1 else "no"
        rows.append((point, row | {"p": float(p), "holds": holds}))
    return rows


def improvement_p(ratios: Numbers) -> float:
    """Probability of ratios (recordings,) like these, or smaller ones, if their logarithms had the mean 0 (t test)."""
    from scipy import stats

    if np.ptp(ratios) == 0:  # no t: equal ratios below 1 are as sure as the test can be
        return float(ratios[0] >= 1)
    result: Any = stats.ttest_1samp(np.log(ratios), 0, alternative="less")
    return float(result.pvalue)


def geometric_mean(ratios: Numbers) -> Numbers:
    """Geometric mean over the recordings (axis 0)."""
    return np.exp(np.log(ratios).mean(axis=0))


def suggest(trial: "optuna.trial.Trial", factors: Sequence[Factor]) -> Point:
    """Values of all factors that Optuna proposes."""
    point: Point = {}
    for factor in factors:
        key, log = factor.key, factor.scale == "log"
        if factor.levels:
            point[key] = factor.levels[trial.suggest_categorical(key, range(len(factor.levels)))]
        elif factor.whole:
            point[key] = trial.suggest_int(key, int(factor.low), int(factor.high), log=log)
        else:
            point[key] = float(f"{trial.suggest_float(key, factor.low, factor.high, log=log):.4g}")
    return point


def run_tune(plan: Plan, out: Path, conduct: Conduct, max_runs: int = MAX_RUNS) -> str:
    """Search, judge, write tune.csv, and recommended.toml if one holds; the outcome in words."""
    import pandas as pd

    check_tune(plan, max_runs)
    recommended = out / "recommended.toml"
    recommended.unlink(missing_ok=True)
    rows = judged(plan, partial(ratios, conduct=conduct))
    table = pd.DataFrame([row for _, row in rows])
    table.to_csv(out / "tune.csv", index=False)
    good = [point for point, row in rows if row["holds"] == "yes"]
    if good:
        configured(plan.base, good[0]).save(recommended)
    return describe(table, good, plan)


def describe(table: Table, good: Sequence[Point], plan: Plan) -> str:
    """Outcome of a search in words."""
    from dudmap.evaluation.tables import grid
    from dudmap.lab.study.report import shown
    from dudmap.lab.study.response_surface import values_text

    trained, second = (", ".join(entry.name for _, _, entry in some) for some in (plan.entries, plan.judges))
    text = (
        f"{plan.tune.trials} configurations on {trained}, judged on {second}; relative to the base configuration:\n\n"
    )
    if table.empty:
        return text + "No configuration is recommended: none did as well as the base configuration in training."
    text += grid([*table.columns], [[shown(value) for value in row] for row in table.itertuples(index=False)], 0)
    if not good:
        first = plan.responses[0]
        return text + f"\nNo configuration is recommended: no improvement of {first} holds on the second set."
    return text + f"\nRecommended (recommended.toml): {values_text(good[0])}."
