"""Heat maps of the limit of dynamics, and the limits as a table."""

from collections.abc import Sequence as Listing
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.lab.benchmark.limits import LARGEST_ATE, Sweep, limit
from dudmap.lab.benchmark.measure import Row
from dudmap.lab.benchmark.table import Column, grid


class Quantity(NamedTuple):
    """One row of heat maps: figure, range of the colours from good to bad, and whether they are logarithmic."""

    figure: Column
    good: float
    bad: float
    logarithmic: bool = False


QUANTITIES = (
    Quantity(Column("ate_rmse_m", "ATE RMSE, mm", 1000, 1), 2, 500, True),
    Quantity(Column("mask_iou_mean", "mask IoU", 1, 2), 1, 0),
    Quantity(Column("ghost_area_m2", "ghost area, m²", 1, 1), 0.5, 20, True),
    Quantity(Column("lost_share", "share of frames lost, %", 100, 0), 0, 100),
)


def values(rows: Listing[Row], sweep: Sweep, system: str, key: str) -> NDArray[np.float64]:
    """Array (coverages, xs) of one figure of a system, NaN where there is none."""
    out = np.full((len(sweep.coverages), len(sweep.xs)), np.nan)
    for row in rows:
        if (row["sweep"], row["system"]) == (sweep.name, system) and row.get(key) is not None:
            out[sweep.coverages.index(row["coverage"]), sweep.xs.index(row["x"])] = row[key]
    return out


def save_heat_maps(rows: Listing[Row], sweep: Sweep, systems: Listing[str], path: Path) -> None:
    """Write the heat maps of a sweep: one row per figure, one column per system; green is good.

    A framed cell is a condition with which the system copes (ATE within the limit, no frame lost). Grey cells have no
    value. A star marks an ATE that excludes lost frames.
    """
    from matplotlib import colormaps
    from matplotlib.colors import LogNorm, Normalize
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    width, height = 0.62 * len(sweep.xs) + 0.9, 0.34 * len(sweep.coverages) + 0.9
    figure = Figure((width * len(systems) + 0.6, height * len(QUANTITIES) + 0.6), layout="constrained")
    axes = figure.subplots(len(QUANTITIES), len(systems), squeeze=False)
    for line, (column, good, bad, logarithmic) in zip(axes, QUANTITIES, strict=True):
        colors = colormaps["RdYlGn_r" if good < bad else "RdYlGn"].with_extremes(bad="#d0d0d0")
        scale = (LogNorm if logarithmic else Normalize)(min(good, bad), max(good, bad), clip=True)
        for axis, system in zip(line, systems, strict=True):
            shown = values(rows, sweep, system, column.key) * column.factor
            copes, lost = (values(rows, sweep, system, key) for key in ("copes", "lost"))
            axis.imshow(np.ma.masked_invalid(shown), colors, scale, origin="lower", aspect="auto", alpha=0.65)
            for (r, c), value in np.ndenumerate(shown):
                text = "–" if np.isnan(value) else f"{value:.{0 if value >= 10 else column.digits}f}"
                text += "*" if column.key == "ate_rmse_m" and lost[r, c] > 0 else ""
                axis.text(c, r, text, ha="center", va="center", fontsize=7)
                if copes[r, c] == 1:
                    axis.add_patch(Rectangle((c - 0.46, r - 0.44), 0.92, 0.88, fill=False, lw=1.2))
            axis.set_xticks(range(len(sweep.xs)), [str(x) for x in sweep.xs], fontsize=7)
            labels = [f"{100 * share:.0f} %" for share in sweep.coverages]
            axis.set_yticks(range(len(labels)), labels, fontsize=7)
            axis.set_title(f"{system}: {column.heading}", fontsize=8)
        line[0].set_ylabel("mover coverage", fontsize=7)
    for axis in axes[-1]:
        axis.set_xlabel(sweep.x, fontsize=7)
    copes_if = f"framed: ATE RMSE ≤ {1000 * LARGEST_ATE:g} mm and no frame lost"
    figure.suptitle(f"Limit of dynamics; {copes_if}; *: error of the frames not lost", fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def limits_table(rows: Listing[Row], sweeps: Listing[Sweep], systems: Listing[str]) -> str:
    """Markdown table of the largest coverage with which each system copes, per value of every sweep."""
    text = ""
    for sweep in sweeps:
        body = []
        for x in sweep.xs:
            reached = [limit(list(rows), sweep.name, system, x) for system in systems]
            body.append([str(x), *("none" if share is None else f"{100 * share:.0f} %" for share in reached)])
        text += f"\n{grid([sweep.x, *systems], body, words=1)}"
    return text


def cells_table(rows: Listing[Row], sweeps: Listing[Sweep], systems: Listing[str]) -> str:
    """Markdown table of all cells: ATE in mm and share of lost frames, bold where the system copes."""
    text = ""
    for sweep in sweeps:
        found = {(row["x"], row["coverage"], row["system"]): row for row in rows if row["sweep"] == sweep.name}
        body = [
            [str(x), f"{100 * coverage:.0f} %", *(_cell(found.get((x, coverage, name), {})) for name in systems)]
            for x in sweep.xs
            for coverage in sweep.coverages
        ]
        text += f"\n{grid([sweep.x, 'coverage', *systems], body)}"
    return text


def _cell(row: Row) -> str:
    if row.get("ate_rmse_m") is None:
        return "no pose" if row.get("error") else ""
    text = f"{1000 * row['ate_rmse_m']:.1f}" + (f" ({100 * row['lost_share']:.0f} % lost)" if row["lost"] else "")
    return f"**{text}**" if row["copes"] else text
