"""Search for a configuration on training recordings, judged on recordings it never saw.

Optuna proposes configurations (multi-objective TPE; Ozaki et al. 2022). A configuration first runs on the early frames
of the training recordings, where a percentile pruner drops what is behind. All figures are ratios to the base
configuration on the same recording, so that recordings count equally. The proposals depend on the seed and on earlier
results only, and results are kept: a search that was stopped proposes the same again and finds its results.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import ConfigError
from dudmap.lab.benchmark.entries import Entry
from dudmap.lab.study.conduct import Progress, conduct
from dudmap.lab.study.designs import Point
from dudmap.lab.study.executor import Executor
from dudmap.lab.study.factors import Factor, configured
from dudmap.lab.study.plan import MAX_RUNS, Plan, checked_options, place_of
from dudmap.lab.study.responses import RESPONSES, check_truth
from dudmap.lab.study.store import StudyFolder
from dudmap.lab.study.tables import Table

if TYPE_CHECKING:
    import optuna

Numbers = NDArray[np.float64]

RATIOS = ("ate", "rpe", "mesh_accuracy", "ms", "memory")
"""Responses that are positive and whose ratio to the base configuration therefore means something."""
SIGNIFICANT = 0.05
"""Largest p (one-sided t test of the log ratios on the second set, corrected after Holm) of what is recommended."""
FEWEST_JUDGES = 3
"""Recordings of the second set at least; a t test of two ratios finds next to nothing."""
BATCH = 4
"""Configurations proposed at a time. A constant, so that the proposals do not depend on the number of workers."""
KEPT_PERCENT = 50.0
"""Share of the configurations that the pruner lets through, percent."""
MOST_JUDGED = 5
"""Configurations of the training front that are judged; each one more weakens the test of all."""


@dataclass(frozen=True)
class TuneOptions:
    """Table ``tune`` of a design file.

    Attributes:
        trials: Number of configurations.
        early: Share of the frames after which configurations are pruned; 0 prunes none.
        seed: Seed of the proposals.
    """

    trials: int = 40
    early: float = 0.34
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Verdict:
    """What one configuration of the training front is worth on the second set.

    Attributes:
        values: Values of the factors.
        training: Geometric mean, over the training recordings, of each response relative to the base configuration.
        judged: The same over the second set; NaN if a run failed.
        p: Probability of ratios like those of the first response on the second set if there were no improvement.
        more_lost: Whether a recording of the second set lost more frames than with the base configuration.
    """

    values: Point
    training: tuple[float, ...]
    judged: tuple[float, ...]
    p: float
    more_lost: bool

    @property
    def holds(self) -> bool:
        """Whether the improvement holds on the second set."""
        return self.p < SIGNIFICANT and self.judged[0] < 1 and not self.more_lost


def tune_options(table: Mapping[str, Any]) -> TuneOptions:
    """Checked options.

    Raises:
        ConfigError: One is unknown or invalid.
    """
    options = TuneOptions(**checked_options(table, TuneOptions, "tune"))
    if not 0 <= options.early < 1:
        raise ConfigError(f"tune has early = {options.early}; expected early from 0 to below 1")
    return options


def check_tune(plan: Plan, options: TuneOptions, max_runs: int = MAX_RUNS) -> None:
    """Check everything that can be known before anything is run.

    Raises:
        DudmapError: A response has no ratio, the second set is too small or was trained on, there are more runs than
            ``max_runs``, or a recording lacks what a response needs.
    """
    for name in plan.responses:
        if name not in RATIOS:
            raise ConfigError(f"tune cannot use the response {name}, which can be 0; it knows {', '.join(RATIOS)}")
    if len(plan.judges) < FEWEST_JUDGES:
        raise ConfigError(f"the second set has {len(plan.judges)} recordings (judge); expected {FEWEST_JUDGES} or more")
    trained = {_identity(entry) for _, _, entry in plan.entries}
    for _, _, entry in plan.judges:
        if _identity(entry) in trained:
            raise ConfigError(f"{entry.name} is in both sets; a judge must not have been trained on")
    early = len(plan.entries) if options.early else 0
    count = (options.trials + 1) * (early + len(plan.entries)) + (MOST_JUDGED + 1) * len(plan.judges)
    if count > max_runs:
        raise ConfigError(f"the search has up to {count} runs, more than --max-runs {max_runs}")
    for _, _, entry in (*plan.entries, *plan.judges):
        check_truth(entry, entry.open(), plan.responses)


def _identity(entry: Entry) -> str:
    return place_of(entry) or repr(sorted(dict(entry.parameters).items()))


class Search:
    """One search.

    Args:
        plan: Factors, training recordings, second set and responses.
        options: Trials, early frames, seed.
        out: Study folder.
        executor: Where the runs are done.
        report: Called after every run.
    """

    def __init__(
        self,
        plan: Plan,
        options: TuneOptions,
        out: Path,
        executor: Executor,
        report: Callable[[Progress], None] = lambda progress: None,
    ) -> None:
        self.plan, self.options = plan, options
        self._out, self._executor, self._report = out, executor, report

    def ratios(self, points: Sequence[Point], plan: Plan) -> list[Numbers | None]:
        """Ratios (recordings, responses) to the base configuration; None for a point with a failed run.

        A point that loses more frames than the base configuration on any recording counts as failed.
        """
        runs = [plan.runs_at(number, point) for number, point in enumerate([{}, *points])]
        conduct([run for same in runs for run in same], self._out, self._executor, report=self._report)
        base, *others = [self._figures([run.key for run in same]) for same in runs]
        if base is None:
            raise ConfigError("the base configuration fails on one of the recordings; nothing can be compared with it")
        return [
            None if found is None or np.any(found[:, -1] > base[:, -1]) else found[:, :-1] / base[:, :-1]
            for found in others
        ]

    def _figures(self, keys: Sequence[str]) -> Numbers | None:
        """Responses and lost frames (recordings, responses + 1); None if a run failed."""
        wanted = [RESPONSES[name].key for name in self.plan.responses] + ["lost"]
        rows = [(StudyFolder(self._out).result(key) or {"row": {}})["row"] for key in keys]
        found = np.array([[row.get(key) for key in wanted] for row in rows], dtype=float)
        return found if np.all(np.isfinite(found)) and np.all(found[:, :-1] > 0) else None

    def front(self) -> list[tuple[Point, tuple[float, ...]]]:
        """Configurations of the training front, best first response first, with their mean ratios."""
        import optuna

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        sampler = optuna.samplers.TPESampler(seed=self.options.seed)
        directions: Any = ["minimize"] * len(self.plan.responses)
        study = optuna.create_study(directions=directions, sampler=sampler)
        for begin in range(0, self.options.trials, BATCH):
            trials = [study.ask() for _ in range(min(BATCH, self.options.trials - begin))]
            points = [suggest(trial, self.plan.factors) for trial in trials]
            kept = [n for n, keep in enumerate(self._promising(points)) if keep]
            found = dict(zip(kept, self.ratios([points[n] for n in kept], self.plan), strict=True))
            for number, trial in enumerate(trials):
                trial.set_user_attr("point", points[number])
                ratios = found.get(number)
                if ratios is None:
                    study.tell(trial, state=optuna.trial.TrialState.PRUNED)
                else:
                    study.tell(trial, [float(x) for x in geometric_mean(ratios)])
        best = sorted(study.best_trials, key=lambda trial: trial.values) if study.trials else []
        different = {str(trial.user_attrs["point"]): trial for trial in reversed(best)}
        chosen = sorted(different.values(), key=lambda trial: trial.values)[:MOST_JUDGED]
        return [(trial.user_attrs["point"], tuple(trial.values)) for trial in chosen]

    def _promising(self, points: list[Point]) -> list[bool]:
        """Whether each point survives the early frames: Optuna's percentile pruner on the first response.

        Optuna prunes single-objective studies only, so the early frames have a study of their own.
        """
        import optuna

        if not self.options.early:
            return [True] * len(points)
        if not hasattr(self, "_early"):
            pruner = optuna.pruners.PercentilePruner(KEPT_PERCENT, n_startup_trials=BATCH)
            self._early = optuna.create_study(pruner=pruner)
        out = []
        for ratios in self.ratios(points, shortened(self.plan, self.options.early)):
            trial = self._early.ask()
            value = float("inf") if ratios is None else float(geometric_mean(ratios)[0])
            trial.report(value, step=1)
            out.append(ratios is not None and not trial.should_prune())
            if ratios is None:
                self._early.tell(trial, state=optuna.trial.TrialState.FAIL)
            else:
                self._early.tell(trial, value)
        return out

    def verdicts(self) -> list[Verdict]:
        """Judge the training front on the second set."""
        from statsmodels.stats.multitest import multipletests

        front = self.front()
        if not front:
            return []
        judges = replace(self.plan, entries=self.plan.judges)
        found = self.ratios([point for point, _ in front], judges)
        raw = [1.0 if ratios is None else improvement_p(ratios[:, 0]) for ratios in found]
        corrected: Any = multipletests(raw, method="holm")[1]
        nothing = (float("nan"),) * len(self.plan.responses)
        judged = [nothing if ratios is None else tuple(geometric_mean(ratios)) for ratios in found]
        return [
            Verdict(point, training, figures, float(p), ratios is None)
            for (point, training), figures, ratios, p in zip(front, judged, found, corrected, strict=True)
        ]


def improvement_p(ratios: Numbers) -> float:
    """Probability of ratios (recordings,) like these, or smaller ones, if their logarithms had the mean 0 (t test)."""
    from scipy import stats

    if np.ptp(ratios) == 0:  # no t: equal ratios below 1 are as sure as the test can be
        return float(ratios[0] >= 1)
    result: Any = stats.ttest_1samp(np.log(ratios), 0, alternative="less")
    return float(result.pvalue)


def geometric_mean(ratios: Numbers) -> Numbers:
    """Geometric mean over the recordings (axis 0)."""
    from scipy.stats import gmean

    return np.asarray(gmean(ratios, axis=0))


def suggest(trial: "optuna.trial.Trial", factors: Sequence[Factor]) -> Point:
    """Values of all factors that Optuna proposes."""
    point: Point = {}
    for factor in factors:
        if factor.levels:
            point[factor.key] = factor.levels[trial.suggest_categorical(factor.key, range(len(factor.levels)))]
        elif factor.whole:
            point[factor.key] = trial.suggest_int(
                factor.key, int(factor.low), int(factor.high), log=factor.scale == "log"
            )
        else:
            value = trial.suggest_float(factor.key, factor.low, factor.high, log=factor.scale == "log")
            point[factor.key] = float(f"{value:.4g}")
    return point


def shortened(plan: Plan, share: float) -> Plan:
    """Plan with the first frames of every training recording only."""
    entries = []
    for name, replicate, entry in plan.entries:
        count = entry.max_frames or len(entry.open())
        entries.append((name, replicate, replace(entry, max_frames=max(3, round(share * count)))))
    return replace(plan, entries=tuple(entries))


def run_tune(
    plan: Plan,
    out: Path,
    executor: Executor,
    *,
    max_runs: int = MAX_RUNS,
    report: Callable[[Progress], None] = lambda progress: None,
) -> str:
    """Search, judge, and write tune.csv, and recommended.toml if a configuration holds; return the outcome in words.

    Raises:
        DudmapError: The search is refused before anything is run (``check_tune``).
    """
    options = tune_options(plan.tune)
    check_tune(plan, options, max_runs)
    recommended = out / "recommended.toml"
    recommended.unlink(missing_ok=True)
    try:
        verdicts = Search(plan, options, out, executor, report).verdicts()
    finally:
        executor.close()
    table = verdict_table(verdicts, plan.responses)
    table.to_csv(out / "tune.csv", index=False)
    good = [verdict for verdict in verdicts if verdict.holds]
    if good:
        configured(plan.base, good[0].values).save(recommended)
    return describe(table, good, plan, options)


def verdict_table(verdicts: Sequence[Verdict], names: Sequence[str]) -> Table:
    """One row per judged configuration: its values, and each response relative to the base configuration."""
    import pandas as pd

    rows = []
    for verdict in verdicts:
        row: dict[str, Any] = {key.rpartition(".")[2]: value for key, value in verdict.values.items()}
        for name, training, judged in zip(names, verdict.training, verdict.judged, strict=True):
            row |= {f"{name}, training": training, f"{name}, second set": judged}
        rows.append(row | {"p": verdict.p, "holds": "yes" if verdict.holds else "no"})
    return pd.DataFrame(rows)


def describe(table: Table, good: Sequence[Verdict], plan: Plan, options: TuneOptions) -> str:
    """Outcome of a search in words."""
    from dudmap.lab.benchmark.table import grid
    from dudmap.lab.study.analysis import values_text
    from dudmap.lab.study.report import shown

    text = (
        f"{options.trials} configurations on {', '.join(entry.name for _, _, entry in plan.entries)}, judged on "
        f"{', '.join(entry.name for _, _, entry in plan.judges)}; figures relative to the base configuration:\n\n"
    )
    if table.empty:
        return text + "No configuration is recommended: none did as well as the base configuration in training."
    text += grid([*table.columns], [[shown(value) for value in row] for row in table.itertuples(index=False)], 0)
    if not good:
        name = plan.responses[0]
        return text + f"\nNo configuration is recommended: no improvement of {name} holds on the second set."
    return text + f"\nRecommended (recommended.toml): {values_text(good[0].values)}."
