"""Points of a design that no other point beats in all responses at once."""

from collections.abc import Sequence
from typing import Any

from dudmap.lab.study.responses import RESPONSES
from dudmap.lab.study.tables import Table


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
