"""Plots of trajectory, surface and mask errors. Each function writes one file: PNG, PDF or SVG, as its name ends.

A plot that cannot be written is a ``DudmapError``.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import atomic_path
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError, DudmapError
from dudmap.evaluation.reconstruction import SurfaceResult
from dudmap.evaluation.segmentation import SCORED_COVERAGE, MaskResult
from dudmap.evaluation.trajectory import AteResult, RpeResult
from dudmap.input_files import DAMAGE, open_arrays

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ESTIMATE, REFERENCE, SECOND = "#c8322d", "#3a3a3a", "#2f6fb5"
LEGEND: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1, 1), "ncols": 2, "frameon": False}
"""Place of a legend: above the axes on the right, where it covers no curve; titles stand on the left."""


def plot_trajectories(path: Path, estimate: Trajectory, reference: Trajectory, result: AteResult) -> None:
    """Aligned estimate and reference, projected along the direction of least motion, and per axis over time."""
    aligned = (result.T_reference_estimate @ estimate.Ts_world_camera)[:, :3, 3]
    start, end = result.timestamps[0] - 0.1, result.timestamps[-1] + 0.1
    during = (reference.timestamps >= start) & (reference.timestamps <= end)
    true, t0 = reference.Ts_world_camera[during, :3, 3], result.timestamps[0]
    across, up = np.sort(np.argsort(-np.ptp(true, axis=0), kind="stable")[:2])
    figure, (view, by_time) = _figure(2, width=13)
    view.plot(true[:, across], true[:, up], color=REFERENCE, linewidth=1.5, label="reference")
    _line_with_gaps(view, estimate.timestamps, aligned[:, across], aligned[:, up], "estimate, aligned")
    view.plot(*true[0, [across, up]], "o", color=REFERENCE, markersize=6, label="start")
    view.set(xlabel=f"{'xyz'[across]}, m", ylabel=f"{'xyz'[up]}, m")
    view.set_title(f"ATE RMSE {1000 * result.rmse:.1f} mm", loc="left")
    view.set_aspect("equal", adjustable="datalim")
    view.legend(**LEGEND)
    for axis, color in enumerate(("#b03a2e", "#2e8b57", "#2f6fb5")):
        offset = true[0, axis]
        by_time.plot(reference.timestamps[during] - t0, true[:, axis] - offset, color=color, alpha=0.45, linewidth=2.5)
        by_time.plot(
            estimate.timestamps - t0, aligned[:, axis] - offset, ".", color=color, markersize=2.5, label="xyz"[axis]
        )
    by_time.set(xlabel="time, s", ylabel="position from the start, m")
    by_time.set_title("band: reference; dots: estimate", loc="left")
    by_time.legend(markerscale=4, **LEGEND | {"ncols": 3})
    _save(figure, path)


def plot_errors(path: Path, result: AteResult | RpeResult) -> None:
    """Absolute or relative errors of position and orientation over time."""
    if isinstance(result, AteResult):
        title = f"absolute error, alignment: {result.alignment}"
        labels = "position error, mm", "orientation error, deg", "time, s"
    else:
        per = f"over {result.delta:g} {result.unit}"
        title = f"relative pose error {per}"
        labels = f"translation, mm {per}", f"rotation, deg {per}", "time of the first pose, s"
    figure, (translation, rotation) = _figure(2, rows=True)
    t = result.timestamps - result.timestamps[0]
    translation.plot(t, 1000 * result.trans_errors, ".-", color=ESTIMATE, markersize=3, linewidth=0.8)
    _rules(translation, {"RMSE": 1000 * result.trans.rmse, "median": 1000 * result.trans.median}, "mm")
    translation.set_ylabel(labels[0])
    translation.set_title(title, loc="left")
    rotation.plot(t, result.rot_errors_deg, ".-", color=SECOND, markersize=3, linewidth=0.8)
    _rules(rotation, {"RMSE": result.rot_deg.rmse, "median": result.rot_deg.median}, "deg")
    rotation.set(xlabel=labels[2], ylabel=labels[1])
    _save(figure, path)


def plot_residuals(path: Path, residuals: Path) -> None:
    """Plot of the registration residuals as a file; see ``draw_residuals``."""
    figure, (axes,) = _figure(1)
    draw_residuals(axes, residuals)
    axes.set_title("registration", loc="left")
    _save(figure, path)


def draw_residuals(axes: "Axes", residuals: Path) -> None:
    """Histogram of the registration residuals with the fitted mixture.

    Args:
        axes: Where to draw.
        residuals: NPZ file with the histogram, ``edges`` (B + 1,) in standard deviations of the reading and ``counts``
            (B,), and the fitted mixture of two half-normal densities (static, dynamic), ``prior`` (2,), ``sigma`` (2,).
    """
    try:
        with open_arrays(residuals) as data:
            edges, counts, prior, sigma = (data[key].astype(float) for key in ("edges", "counts", "prior", "sigma"))
    except DAMAGE as error:
        raise DatasetError(f"{residuals} does not hold edges, counts, prior and sigma of residuals: {error}") from error
    widths, r = np.diff(edges), np.linspace(edges[0], edges[-1], 600)
    density = counts / max(counts.sum(), 1) / widths
    axes.stairs(density, edges, fill=True, color="#b9c4d0", label="residuals")
    parts = [p * np.sqrt(2 / np.pi) / s * np.exp(-0.5 * (r / s) ** 2) for p, s in zip(prior, sigma, strict=True)]
    for part, name, color, p, s in zip(parts, ("static", "dynamic"), (SECOND, ESTIMATE), prior, sigma, strict=True):
        axes.plot(r, part, color=color, label=f"{name}: {100 * p:.1f} %, sigma {s:.2f}")
    axes.plot(r, sum(parts), color=REFERENCE, linewidth=1, linestyle="--", label="mixture")
    axes.set(xlabel="residual, standard deviations of the reading", ylabel="density", yscale="log")
    axes.yaxis.set_major_formatter("{x:g}")  # powers would be written as formulas, which the report does not parse
    low = counts[counts > 0].min() / counts.sum() / widths.max() if counts.any() else 1e-6
    highest = counts.max() / max(counts.sum(), 1) / widths.min()
    axes.set_ylim(low / 2, 3 * max(highest, low))
    axes.legend(**LEGEND)


def plot_surface(path: Path, result: SurfaceResult) -> None:
    """Histograms of accuracy and completeness, and their cumulative shares."""
    figure, (histogram, cumulated) = _figure(2, width=13)
    edges, width = 1000 * result.histogram_edges, 1000 * float(np.diff(result.histogram_edges[:2])[0])
    rows = (
        ("estimate to reference (accuracy)", result.accuracy_histogram, result.accuracy, ESTIMATE),
        ("reference to estimate (completeness)", result.completeness_histogram, result.completeness, SECOND),
    )
    for name, shares, statistics, color in rows:
        label = f"{name}\nmean {1000 * statistics.mean:.1f}, median {1000 * statistics.median:.1f} mm"
        histogram.stairs(100 * shares, edges, color=color, label=label, fill=False, linewidth=1.5)
        cumulated.plot(edges[1:-1], 100 * np.cumsum(shares)[:-1], color=color, label=name)
    histogram.set(xlabel=f"distance, mm (last bin: {edges[-2]:.0f} and more)", yscale="log")
    histogram.set_ylabel(f"% of the surface per {width:.0f} mm")
    histogram.legend(**LEGEND)
    for row, score in enumerate(result.scores):
        cumulated.axvline(1000 * score.distance, color="#999999", linewidth=0.8)
        text = f"{1000 * score.distance:g} mm: F {score.f_score:.3f}"
        at = (1000 * score.distance, 3 + 6 * (row % 6))
        cumulated.annotate(text, at, xytext=(4, 0), textcoords="offset points", fontsize=9)
    area = "" if result.ghost_area_m2 is None else f" ({result.ghost_area_m2:.2f} m2)"
    beyond = f"{100 * result.ghost_share:.2f} %{area} farther than {1000 * result.ghost_distance:g} mm"
    cumulated.set(xlabel="distance, mm", ylabel="% of the surface within", ylim=(0, 101))
    cumulated.set_title(f"ghosts: {beyond}", loc="left")
    _save(figure, path)


def plot_masks(path: Path, result: MaskResult) -> None:
    """Precision, recall and intersection over union, and the true and estimated dynamic shares, over time."""
    figure, (quality, shares) = _figure(2, rows=True)
    t = result.timestamps - result.timestamps[0]
    scored = result.coverage > SCORED_COVERAGE
    quality.plot(t[scored], result.iou[scored], ".", color=ESTIMATE, markersize=4, label="IoU")
    quality.plot(t[scored], result.recall[scored], color=SECOND, linewidth=0.8, label="recall")
    quality.plot(t[scored], result.precision[scored], color="#2e8b57", linewidth=0.8, label="precision")
    quality.set(ylim=(0, 1.02), ylabel=f"frames with > {100 * SCORED_COVERAGE:g} % dynamic")
    quality.set_title(f"mean IoU {result.mean_iou:.3f} over {result.num_scored} frames", loc="left")
    quality.legend(**LEGEND | {"ncols": 3})
    shares.fill_between(t, 100 * result.coverage, color="#b9c4d0", label="true mask")
    shares.plot(t, 100 * result.found_share, color=ESTIMATE, linewidth=1, label="estimated mask")
    shares.set(xlabel="time, s", ylabel="% of the image")
    shares.legend(**LEGEND)
    _save(figure, path)


def _figure(count: int, *, rows: bool = False, width: float = 9.0) -> "tuple[Figure, NDArray[np.object_]]":
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, 6.5 if rows else 5.5), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(count, 1, sharex=True, squeeze=False) if rows else figure.subplots(1, count, squeeze=False)
    for one in axes.ravel():
        one.grid(alpha=0.25)
    return figure, axes.ravel()


def _line_with_gaps(axes: "Axes", stamps: NDArray, x: NDArray, y: NDArray, label: str) -> None:
    """Plot a line that is interrupted where frames are missing."""
    x, y = x.copy(), y.copy()
    steps = np.diff(stamps)
    breaks = np.flatnonzero(steps > 3 * np.median(steps)) + 1 if len(steps) else np.array([], dtype=int)
    axes.plot(np.insert(x, breaks, np.nan), np.insert(y, breaks, np.nan), color=ESTIMATE, linewidth=1.2, label=label)


def _rules(axes: "Axes", levels: dict[str, float], unit: str) -> None:
    """Horizontal lines at named levels."""
    for style, (name, level) in zip(("--", ":"), levels.items(), strict=True):
        axes.axhline(level, color=REFERENCE, linestyle=style, linewidth=1, label=f"{name} {level:.3g} {unit}")
    axes.set_ylim(bottom=0)
    axes.legend(**LEGEND)


def _save(figure: "Figure", path: Path) -> None:
    try:
        with atomic_path(path) as temporary:
            figure.savefig(temporary)
    except OSError as error:
        raise DudmapError(f"cannot write the plot {path}: {error.strerror or error}") from error
