"""Columns that show what colour brings: the default beside the registration with and without the colour term.

The default must not be worse than the better of the two by more than ``TOLERANCE``, on any recording.
"""

from collections.abc import Callable, Iterable, Sequence

from dudmap.config import Config
from dudmap.errors import DudmapError
from dudmap.lab.benchmark.entries import Entry, Excerpt
from dudmap.lab.benchmark.measure import Row, measure_each, measure_sequence
from dudmap.lab.benchmark.table import grid

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
    """Measure every recording with the settings of every column; one row per recording and column.

    A synthetic recording is rendered once for all columns. ``done`` is called with every row when its recording is
    complete.
    """

    def rows_of(found: Row) -> list[Row]:
        failed = {"error": found.get("error")}
        return [{"sequence": found["sequence"], "system": name} | found.get(name, failed) for name in SETTINGS]

    jobs = [({"sequence": entry.name}, (entry, config)) for entry in entries]

    def measured(found: Row) -> None:
        for row in rows_of(found):
            done(row)

    return [row for found in measure_each(measure_recording, jobs, workers, measured) for row in rows_of(found)]


def measure_recording(job: tuple[Entry, Config]) -> Row:
    """Figures of one recording by the name of the column."""
    from dudmap.lab.synthetic.recording import SyntheticSequence

    entry, config = job
    sequence, rows = entry.open(), {}
    if isinstance(sequence, SyntheticSequence):
        sequence = Excerpt(sequence).load()
    for name, settings in SETTINGS.items():
        calibrate, frames = name == "default", entry.max_frames
        try:
            rows[name] = measure_sequence(
                sequence, config.override(settings), None, max_frames=frames, calibrate=calibrate
            )
        except DudmapError as error:
            rows[name] = {"error": str(error)}
    return rows


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
