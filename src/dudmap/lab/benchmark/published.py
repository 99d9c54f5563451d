"""Published figures of other systems, from published.toml."""

import math
import tomllib
from collections.abc import Collection
from importlib.resources import files
from typing import NamedTuple


class Published(NamedTuple):
    """One published figure.

    Attributes:
        sequence: Name of the recording: that of its folder in the data set.
        system: Name of the system.
        metric: Key of the figure in our tables.
        value: Value in the unit of our tables: metres, m/s, deg/s.
        source: Publication.
    """

    sequence: str
    system: str
    metric: str
    value: float
    source: str


def published(sequences: Collection[str] | None = None) -> list[Published]:
    """Published figures of all or of the given recordings, in the order of the data file."""
    content = tomllib.loads(files("dudmap.lab.benchmark").joinpath("published.toml").read_text(encoding="utf-8"))
    sources = content["sources"]
    return [
        Published(sequence, row["system"], table["metric"], round(value * table["factor"], 7), sources[row["source"]])
        for table in content["table"]
        for row in table["rows"]
        for sequence, value in zip(table["sequences"], row["values"], strict=True)
        if not math.isnan(value) and (sequences is None or sequence in sequences)
    ]
