"""Plots of a run for the report, as SVG text."""

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from dudmap.app.viewing.run_files import RunFiles
from dudmap.core.geometry import se3
from dudmap.evaluation.plots import ESTIMATE, LEGEND, REFERENCE, SECOND, draw_residuals
from dudmap.evaluation.trajectory import AteResult, Statistics

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POINTS = 400
"""Points of a curve over time: its pixels."""


def plots(run: RunFiles) -> dict[str, str]:
    """SVG text by title: trajectory, error, dynamic share, residuals."""
    out: dict[str, str] = {}
    if len(run.trajectory) > 1:
        out["Trajectory seen from above"] = _from_above(run)
    if run.errors is not None:
        out["Error over time, after least-squares alignment"] = _errors(run, run.errors)
    if run.frames:
        out["Share of the readings that move"] = _dynamic_share(run)
    if (run.folder / "residuals.npz").is_file():
        with _drawing("residuals") as (figure, picture):
            draw_residuals(figure.subplots(), run.folder / "residuals.npz")
        out["Residuals"] = picture[0]
    return out


def _from_above(run: RunFiles) -> str:
    across, frames = _ground_axes(run), run.figures()
    places = [np.full(3, np.nan) if frame.T_world_camera is None else frame.T_world_camera[:3, 3] for frame in frames]
    path = np.array(places) @ across.T
    known = np.flatnonzero(np.isfinite(path[:, 0]))
    with _drawing("above", height=4.4) as (figure, picture):
        axes = figure.subplots()
        if run.errors is not None and run.truth is not None:
            T = se3.inverse(run.errors.T_reference_estimate)
            true = (T @ run.truth.Ts_world_camera)[:, :3, 3] @ across.T
            stamps = run.truth.timestamps
            during = (stamps >= frames[0].timestamp - 0.1) & (stamps <= frames[-1].timestamp + 0.1)
            axes.plot(*_thinned(true[during]).T, color=REFERENCE, linewidth=1, label="true")
        axes.plot(*_thinned(path).T, color=SECOND, linewidth=1.5, label="estimated")
        bridges = [path[[a, b]] for a, b in pairwise(known) if b > a + 1]
        for number, bridge in enumerate(bridges):
            label = f"lost ({len(bridges)} gap{'s' * (len(bridges) > 1)})" if number == 0 else None
            axes.plot(*bridge.T, "--x", color=ESTIMATE, linewidth=1.5, label=label)
        axes.plot(*path[known[0]], "o", color=SECOND, markersize=7, label="start")
        axes.plot(*path[known[-1]], "s", color=SECOND, markersize=6, label="end")
        axes.set(xlabel="to the right, m", ylabel="ahead, m")
        axes.set_aspect("equal", adjustable="datalim")
        axes.legend(**LEGEND | {"ncols": 5})
    return picture[0]


def _ground_axes(run: RunFiles) -> NDArray[np.float64]:
    Ts = run.trajectory.Ts_world_camera
    given = (run.metrics.get("up") or {}).get("direction")
    up = -Ts[:, :3, 1].mean(axis=0) if given is None else np.array(given, dtype=float)
    right = np.cross(Ts[0, :3, 2], up)
    if np.linalg.norm(right) < 0.1 * np.linalg.norm(up):  # the first camera looks along the vertical
        right = Ts[0, :3, 0]
    axes = np.array([right, np.cross(up, right)])
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


def _thinned(path: NDArray[np.float64]) -> NDArray[np.float64]:
    return path[:: max(1, len(path) // (5 * POINTS))]


def _errors(run: RunFiles, errors: AteResult) -> str:
    t = errors.timestamps - (run.column("timestamp")[0] if run.frames else errors.timestamps[0])
    with _drawing("errors", height=3.6) as (figure, picture):
        position, orientation = figure.subplots(2, 1, sharex=True)
        parts = (position, 1000 * errors.trans_errors, "mm"), (orientation, errors.rot_errors_deg, "deg")
        for axes, values, unit in parts:
            rmse = Statistics.of(values).rmse
            axes.plot(*_binned(t, values), color=SECOND, linewidth=1.2, label=f"RMSE {rmse:.3g} {unit}")
            axes.set(ylabel=unit, xlim=_limits(t), ylim=(0, None))
        lost = _lost(run)
        if len(lost):
            position.plot(lost, np.zeros(len(lost)), "|", color=ESTIMATE, markersize=12, label="lost")
        position.set_title("position", loc="left", fontsize="medium")
        orientation.set_title("orientation", loc="left", fontsize="medium")
        orientation.set(xlabel="time, s")
        for axes in (position, orientation):
            axes.legend(**LEGEND)
    return picture[0]


def _dynamic_share(run: RunFiles) -> str:
    t, lost = _seconds(run), _lost(run)
    with _drawing("dynamic") as (figure, picture):
        axes = figure.subplots()
        at, share = _binned(t, 100 * run.column("dynamic_share"))
        axes.fill_between(at, share, color="#d95f02", alpha=0.6, linewidth=0)
        if len(lost):
            axes.plot(lost, np.zeros(len(lost)), "|", color="black", markersize=12, label=f"{len(lost)} frames lost")
            axes.legend(**LEGEND)
        axes.set(xlabel="time, s", ylabel="%", xlim=_limits(t), ylim=(0, None))
    return picture[0]


def _seconds(run: RunFiles) -> NDArray[np.float64]:
    stamps = run.column("timestamp")
    return stamps - stamps[0]


def _lost(run: RunFiles) -> NDArray[np.float64]:
    return _seconds(run)[[row["state"] == "lost" for row in run.frames]] if run.frames else np.empty(0)


def _limits(t: NDArray[np.float64]) -> tuple[float, float]:
    return 0.0, max(float(t[-1]), 1e-3)


def _binned(t: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    starts = np.arange(0, len(t), max(1, len(t) // POINTS))
    counts = np.diff(np.append(starts, len(t)))
    return np.add.reduceat(t, starts) / counts, np.add.reduceat(y, starts) / counts


@contextmanager
def _drawing(name: str, height: float = 2.8) -> "Iterator[tuple[Figure, list[str]]]":
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    picture: list[str] = []
    style = {
        "svg.fonttype": "none",
        "svg.hashsalt": name,
        "font.size": 11,
        "font.family": "sans-serif",
        "text.parse_math": False,
    }
    with matplotlib.rc_context(rc=cast("Any", style)):
        figure = Figure(figsize=(6.4, height), layout="constrained")
        FigureCanvasSVG(figure)
        yield figure, picture
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r'\bid="((?:figure|axes|patch|line2d|text|xtick|ytick|matplotlib|legend|Fill)[^"]*)"', "", svg)
    picture.append(re.sub(r'<svg ([^>]*?)width="[^"]*" ', r"<svg \1", re.sub(r' height="[^"]*pt"', "", svg, count=1)))
