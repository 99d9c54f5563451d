"""Plots of a run for the report, as SVG text."""

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from dudmap.app.viewing.run_files import RunFiles
from dudmap.errors import printable
from dudmap.evaluation.plots import LEGEND, draw_residuals

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POINTS = 400
"""Most points of a curve over time: a plot is about this many pixels wide."""
MAX_STAGES = 9
"""Stages with their own colour; the shortest ones are summed."""


def plots(run: RunFiles) -> dict[str, str]:
    """SVG text by title: time per stage, dynamic share, residuals, as far as there are data."""
    out: dict[str, str] = {}
    if run.frames and run.stages:
        out["Time per stage"] = _times(run)
    if run.frames:
        out["Share of the readings that move"] = _dynamic_share(run)
    if (run.folder / "residuals.npz").is_file():
        with _drawing("residuals") as (figure, picture):
            axes = figure.subplots()
            figure.subplots_adjust(left=0.13, top=0.8)  # room for numbers and legend
            draw_residuals(axes, run.folder / "residuals.npz")
        out["Residuals"] = picture[0]
    return out


def _times(run: RunFiles) -> str:
    t = _seconds(run)
    times = {stage: run.column(stage) for stage in run.stages}
    ranked = sorted(times, key=lambda stage: -float(times[stage].sum()))
    if len(ranked) > MAX_STAGES:
        rest = ranked[MAX_STAGES - 1 :]
        ranked = [*ranked[: MAX_STAGES - 1], "others"]
        times["others"] = np.sum([times[stage] for stage in rest], axis=0)
    curves = [_binned(t, times[stage]) for stage in ranked]
    # single frames may take very long, such as the first one, which loads the kernels
    highest = 1.3 * max(float(np.percentile(np.sum([curve[1] for curve in curves], axis=0), 95)), 1e-3)
    with _drawing("times") as (figure, picture):
        figure.subplots_adjust(right=0.72)  # room for the legend
        axes = figure.subplots()
        labels = [f"{printable(stage)[:30]}: {times[stage].mean():.1f} ms" for stage in ranked]
        axes.stackplot(curves[0][0], *(curve[1] for curve in curves), labels=labels, linewidth=0)
        axes.set(xlabel="time, s", ylabel="ms per frame", xlim=_limits(t), ylim=(0, highest))
        handles, names = axes.get_legend_handles_labels()
        axes.legend(handles[::-1], names[::-1], loc="upper left", bbox_to_anchor=(1, 1), frameon=False)
    return picture[0]


def _dynamic_share(run: RunFiles) -> str:
    t = _seconds(run)
    lost = t[np.array([row["state"] == "lost" for row in run.frames])]
    with _drawing("dynamic") as (figure, picture):
        axes = figure.subplots()
        at, share = _binned(t, 100 * run.column("dynamic_share"))
        axes.fill_between(at, share, color="#d95f02", alpha=0.6, linewidth=0)
        if len(lost):
            axes.plot(lost, np.zeros(len(lost)), "|", color="black", markersize=12, label=f"{len(lost)} frames lost")
            figure.subplots_adjust(top=0.88)  # room for the legend
            axes.legend(**LEGEND)
        axes.set(xlabel="time, s", ylabel="%", xlim=_limits(t), ylim=(0, None))
    return picture[0]


def _seconds(run: RunFiles) -> NDArray[np.float64]:
    """Times of the processed frames since the first, seconds."""
    stamps = run.column("timestamp")
    return stamps - stamps[0]


def _limits(t: NDArray[np.float64]) -> tuple[float, float]:
    return 0.0, max(float(t[-1]), 1e-3)


def _binned(t: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Means of about ``POINTS`` equal groups of consecutive frames, which bound the size of the plot."""
    starts = np.arange(0, len(t), max(1, len(t) // POINTS))
    counts = np.diff(np.append(starts, len(t)))
    return np.add.reduceat(t, starts) / counts, np.add.reduceat(y, starts) / counts


@contextmanager
def _drawing(name: str) -> "Iterator[tuple[Figure, list[str]]]":
    """Figure to draw into, and a list that holds its SVG text afterwards; equal data give equal text."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    picture: list[str] = []
    style = {
        "svg.fonttype": "none",
        "svg.hashsalt": name,
        "font.size": 9,
        "font.family": "sans-serif",
        "text.parse_math": False,
    }
    with matplotlib.rc_context(rc=cast("Any", style)):
        figure = Figure(figsize=(7.2, 2.8))
        figure.subplots_adjust(left=0.09, right=0.98, bottom=0.17, top=0.96)
        FigureCanvasSVG(figure)
        yield figure, picture
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r'\bid="((?:figure|axes|patch|line2d|text|xtick|ytick|matplotlib|legend|Fill)[^"]*)"', "", svg)
    picture.append(re.sub(r'<svg ([^>]*?)width="[^"]*" ', r"<svg \1", re.sub(r' height="[^"]*pt"', "", svg, count=1)))
