"""The largest dynamic share of the image at which tracking succeeds.

Shares of people grow at several speeds, camera paths, and from the start (``suites.toml``). ``docs/limits.md`` defines
the metrics.
"""

from collections.abc import Collection
from typing import Any

from dudmap.evaluation.tables import Row, grid
from dudmap.lab.data import tables

LARGEST_ATE = 0.02
"""Largest ATE RMSE of a coped world, metres, without a lost frame."""
DATA = tables("benchmark/suites.toml")["limits"]
SWEEPS: dict[str, dict[str, Any]] = DATA["sweeps"]
"""Values of one parameter, and the shares of people with each."""


def worlds() -> dict[str, dict[str, Any]]:
    """Parameters of all worlds by name."""
    return {
        name_of(sweep, value, share): DATA["world"] | {sweep["parameter"]: value, "coverage": share}
        for sweep in SWEEPS.values()
        for value in sweep["values"]
        for share in sweep["coverages"]
    }


def name_of(sweep: dict[str, Any], value: object, share: float) -> str:
    """Name of a value's and share's world."""
    return f"{sweep['parameter']}-{value}-{100 * share:.0f}"


def limits_table(rows: Collection[Row], systems: Collection[str]) -> str:
    """Markdown table of the largest coped share per value of every sweep."""
    found = {(row["sequence"], row["system"]): row for row in rows}
    text = "\nLargest dynamic share of the image with an ATE RMSE of at most 20 mm and no frame lost:\n"
    for sweep in SWEEPS.values():
        body = []
        for value in sweep["values"]:
            cells = [str(value)]
            for system in systems:
                named = [(share, name_of(sweep, value, share)) for share in sorted(sweep["coverages"])]
                measured = [(share, found[name, system]) for share, name in named if (name, system) in found]
                reached = "none" if measured else ""
                for share, row in measured:
                    if not copes(row):
                        break
                    reached = f"{100 * share:.0f} %"
                cells.append(reached)
            body.append(cells)
        text += f"\n{grid([sweep['label'], *systems], body, words=1)}"
    return text


def copes(row: Row) -> bool:
    """Whether a system copes with a world."""
    return row.get("lost") == 0 and (row.get("ate_rmse_m") or float("inf")) <= LARGEST_ATE
