"""Columns that show what colour brings: the default beside the registration with and without the colour term.

The default must not be worse than the better of the two by more than ``TOLERANCE``, on any recording.
"""

from collections.abc import Callable, Iterable, Sequence

from dudmap.config import Config
from dudmap.lab.benchmark.measure import Job, Row, grid, measure_all
from dudmap.lab.benchmark.suites import Entry

SETTINGS: dict[str, tuple[str, ...]] = {
    "with colour": ("sensor.color_time_sigma=0",),
    "without colour": ("tracker.color_weight=0",),
    "default": (),
}
"""Differences of the columns from the given configuration. Only the default calibrates the colour camera first; the
others take it as given, and with colour it counts the same at any motion."""
TOLERANCE = 0.05
"""Relative amount by which the default may be worse than the better column."""


def measure_columns(
    entries: Iterable[Entry], config: Config, workers: int = 1, done: Callable[[Row], None] = lambda row: None
) -> list[Row]:
    """Measure every recording with the settings of every column; one row per recording and column."""
    configs = {name: config.override(settings) for name, settings in SETTINGS.items()}
    jobs = [Job(entry, name, configs[name], calibrate=name == "default") for entry in entries for name in configs]
    return measure_all(jobs, workers, done)


def color_table(rows: Sequence[Row]) -> str:
    """Markdown table of the ATE: each column, the better of the first two, and whether the default is within 5 %.

    Args:
        rows: Result of ``measure_columns``.
    """
    lines, failed = [], []
    for name in dict.fromkeys(row["sequence"] for row in rows):
        own = {row["system"]: row for row in rows if row["sequence"] == name}
        failed += [f"- {name}, {system}: {row['error']}" for system, row in own.items() if "error" in row]
        ates = [own[column].get("ate_rmse_m") for column in SETTINGS]
        better = min((ate for ate in ates[:2] if ate is not None), default=None)
        line = [name, *(_cell(own[column]) for column in SETTINGS), "" if better is None else f"{1000 * better:.1f}"]
        if better is None or any(ate is None for ate in ates):
            lines.append([*line, "", ""])
        else:
            lines.append([*line, f"{ates[2] / better:.2f}", "yes" if ates[2] <= (1 + TOLERANCE) * better else "NO"])
    header = ["ATE RMSE, mm", *SETTINGS, "better of both", "default / better", f"within {TOLERANCE:.0%}"]
    return grid(header, lines, words=1) + ("\n" + "\n".join(failed) + "\n" if failed else "")


def _cell(row: Row) -> str:
    """ATE of one run, with the number of lost frames if there are any."""
    ate = row.get("ate_rmse_m")
    lost = f" ({row['lost']} lost)" if row.get("lost") else ""
    return "failed" if "error" in row else ("" if ate is None else f"{1000 * ate:.1f}") + lost
