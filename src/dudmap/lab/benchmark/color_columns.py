"""Columns that show what colour brings: the default beside the registration with and without the colour term.

The default must not be worse than the better of the two by more than ``TOLERANCE``, on any recording.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

from dudmap.config import Config
from dudmap.errors import DudmapError
from dudmap.lab.benchmark.entries import Entry, Excerpt
from dudmap.lab.benchmark.measure import Row, in_own_process, measure_sequence
from dudmap.lab.benchmark.table import Column, grid, shown

SETTINGS: dict[str, tuple[str, ...]] = {
    "with colour": ("sensor.color_time_sigma=0",),
    "without colour": ("tracker.color_weight=0",),
    "default": (),
}
"""Differences of the columns from the given configuration. Only the default calibrates the colour camera first; the
others take it as given, and with colour it counts the same at any motion."""
TOLERANCE = 0.05
"""Relative amount by which the default may be worse than the better column."""
ATE = Column("ate_rmse_m", "ATE RMSE, mm", 1000, 1)
"""The figure that is compared."""


class Measurement(NamedTuple):
    """One recording with the configurations to measure it with, by column."""

    entry: Entry
    configs: dict[str, Config]


def measure_columns(
    entries: Iterable[Entry], config: Config, workers: int = 1, done: Callable[[Row], None] = lambda row: None
) -> list[Row]:
    """Measure every recording with the settings of every column; one row per recording and column.

    Args:
        entries: The recordings; a synthetic one is rendered once for all columns.
        config: Configuration that the settings are applied to.
        workers: Number of processes at a time.
        done: Called with every row when its recording is complete.
    """
    configs = {name: config.override(settings) for name, settings in SETTINGS.items()}

    def one(entry: Entry) -> list[Row]:
        answer = in_own_process(_measure, Measurement(entry, configs))
        rows = answer.get("rows") or [{"error": answer["error"]} for _ in configs]
        named = [{"sequence": entry.name, "system": name} | row for name, row in zip(configs, rows, strict=True)]
        for row in named:
            done(row)
        return named

    with ThreadPoolExecutor(workers) as pool:
        return [row for rows in pool.map(one, entries) for row in rows]


def _measure(measurement: Measurement) -> Row:
    from dudmap.lab.synthetic.recording import SyntheticSequence

    sequence = measurement.entry.open()
    if isinstance(sequence, SyntheticSequence):
        sequence = Excerpt(sequence).load()
    rows: list[Row] = []
    for name, config in measurement.configs.items():
        frames = measurement.entry.max_frames
        try:
            rows.append(measure_sequence(sequence, config, None, max_frames=frames, calibrate=name == "default"))
        except DudmapError as error:
            rows.append({"error": str(error)})
    return {"rows": rows}


def is_within(row_default: Row, others: Sequence[Row], figure: Column = ATE) -> bool | None:
    """Whether the default is at most ``TOLERANCE`` worse than the better of the others; None if a figure is missing."""
    values = [row.get(figure.key) for row in (row_default, *others)]
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return None
    return known[0] <= (1 + TOLERANCE) * min(known[1:])


def color_table(rows: Sequence[Row], figures: Mapping[str, Column] | None = None) -> str:
    """Markdown table with one line per recording: each column, the better of the first two, and the default over it.

    Args:
        rows: Result of ``measure_columns``.
        figures: Figures of the recordings that are not compared by their ATE.
    """
    lines, failed = [], []
    for name in dict.fromkeys(row["sequence"] for row in rows):
        figure = (figures or {}).get(name, ATE)
        own = {row["system"]: row for row in rows if row["sequence"] == name}
        failed += [f"- {name}, {system}: {row['error']}" for system, row in own.items() if "error" in row]
        others = [own["with colour"], own["without colour"]]
        within = is_within(own["default"], others, figure)
        better = min((row[figure.key] for row in others if row.get(figure.key) is not None), default=None)
        ratio = f"{own['default'][figure.key] / better:.2f}" if within is not None and better else ""
        lines.append(
            [
                name,
                figure.heading,
                *(_cell(own[column], figure) for column in SETTINGS),
                shown(better, figure),
                ratio,
                "" if within is None else "yes" if within else "NO",
            ]
        )
    header = ["sequence", "figure", *SETTINGS, "better of both", "default / better", f"within {TOLERANCE:.0%}"]
    return grid(header, lines) + ("\n" + "\n".join(failed) + "\n" if failed else "")


def _cell(row: Row, figure: Column) -> str:
    """Figure of one run, with the number of lost frames if there are any."""
    lost = f" ({row['lost']} lost)" if row.get("lost") else ""
    return "failed" if "error" in row else shown(row.get(figure.key), figure) + lost
