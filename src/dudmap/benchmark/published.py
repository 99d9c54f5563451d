"""Published figures of other systems, from the data file beside this module."""

import math
import tomllib
from collections.abc import Collection
from importlib.resources import files
from typing import NamedTuple


class Published(NamedTuple):
    """One printed figure.

    Attributes:
        sequence: Name of the recording, as its data set calls the folder.
        system: Who was measured.
        metric: Key of the figure in our tables.
        value: In the unit our tables store: metres, m/s, deg/s.
        source: Where it is printed.
    """

    sequence: str
    system: str
    metric: str
    value: float
    source: str


def published(sequences: Collection[str] | None = None) -> list[Published]:
    """All published figures, or those of some recordings, in the order of the data file."""
    content = tomllib.loads(files("dudmap.benchmark").joinpath("published.toml").read_text(encoding="utf-8"))
    sources = content["sources"]
    return [
        Published(sequence, row["system"], table["metric"], round(value * table["factor"], 7), sources[row["source"]])
        for table in content["table"]
        for row in table["rows"]
        for sequence, value in zip(table["sequences"], row["values"], strict=True)
        if not math.isnan(value) and (sequences is None or sequence in sequences)
    ]
