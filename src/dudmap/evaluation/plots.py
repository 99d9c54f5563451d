"""Plots of trajectory, surface and mask errors: PNG, PDF or SVG, by ending. A failed write raises ``DudmapError``."""

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import atomic_path
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError, DudmapError
from dudmap.evaluation.comparison import Score
from dudmap.evaluation.reconstruction import SurfaceResult
from dudmap.evaluation.segmentation import SCORED_COVERAGE, MaskResult
from dudmap.evaluation.trajectory import PoseErrors, Statistics, gaps
from dudmap.input_files import DAMAGE, open_arrays

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ESTIMATE, REFERENCE, SECOND = "#c8322d", "#3a3a3a", "#2f6fb5"
COLORS = ESTIMATE, SECOND, "#2e8b57", "#d98a00", "#7b4fa3", "#14949b", "#8c564b", "#d65fa5"
LEGEND: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1, 1), "ncols": 2, "frameon": False}
"""Above the axes on the right."""


def plot_trajectories(path: Path, scores: list[Score]) -> None:
    """Aligned estimates and reference: along the direction of least motion, and each axis over time."""
    true, t0 = _compared_reference(scores)
    figure, places = _figure_of([["view", axis] for axis in "xyz"], (13, 5.5), width_ratios=[1.1, 1])
    positions = true.Ts_world_camera[:, :3, 3]
    across, up = _widest_axes(positions)
    view = places["view"]
    view.plot(positions[:, across], positions[:, up], color=REFERENCE, linewidth=1.5, label="reference")
    view.plot(*positions[0, [across, up]], "o", color=REFERENCE, markersize=6, label="start")
    for number, name in enumerate("xyz"):
        places[name].plot(true.timestamps - t0, positions[:, number], color=REFERENCE, linewidth=1.5)
        places[name].set(ylabel=f"{name}, m")
        places[name].tick_params(labelbottom=name == "z")
    for color, score in zip(cycle(COLORS), scores, strict=False):
        aligned = _aligned(score)
        label = f"{score.name}: ATE {1000 * score.absolute.rmse:.1f} mm"
        lines = [(view, aligned[:, across], aligned[:, up])]
        lines += [(places[name], score.found.timestamps - t0, aligned[:, number]) for number, name in enumerate("xyz")]
        for axes, x, y in lines:
            _line_with_gaps(axes, score.found.timestamps, x, y, color, label)
    view.set(xlabel=f"{'xyz'[across]}, m", ylabel=f"{'xyz'[up]}, m")
    view.set_aspect("equal", adjustable="datalim")
    view.legend(**LEGEND)
    places["z"].set(xlabel="time, s")
    _save(figure, path)


def plot_errors(path: Path, scores: list[Score]) -> None:
    """Absolute errors of position and orientation over time."""
    title = f"absolute error, alignment: {scores[0].absolute.alignment}"
    labels = "position error, mm", "orientation error, deg", "time, s"
    _plot_errors(path, title, labels, [(score.name, score.absolute) for score in scores])


def plot_relative_errors(path: Path, scores: list[Score]) -> bool:
    """Plot relative errors over time; returns whether there are any."""
    found = [(score.name, score.relative) for score in scores if score.relative is not None]
    labels = "translation, mm over 1 s", "rotation, deg over 1 s", "time of the first pose, s"
    if found:
        _plot_errors(path, "relative pose error over 1 s", labels, found)
    return bool(found)


def plot_error_paths(path: Path, scores: list[Score]) -> None:
    """Position error as colour along each path; one scale."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    true, _ = _compared_reference(scores)
    positions = true.Ts_world_camera[:, :3, 3]
    across, up = _widest_axes(positions)
    width, height = np.ptp(positions[:, [across, up]], axis=0)
    columns = min(len(scores), 3)
    rows = -(-len(scores) // columns)
    panel = float(np.clip(4.5 * height / width, 1.5, 6)) if width else 4.5
    mosaic = [[str(row * columns + column) for column in range(columns)] for row in range(rows)]
    figure, _ = _figure_of(mosaic, (5 * columns + 1.5, (panel + 1) * rows))
    scale = ScalarMappable(Normalize(0, 1000 * max(score.absolute.trans.max for score in scores)), "turbo")
    for axes in figure.axes[len(scores) :]:
        axes.set_axis_off()
    for axes, score in zip(figure.axes, scores, strict=False):
        absolute = score.absolute
        compared = _aligned(score)[np.isin(score.found.timestamps, absolute.timestamps)]
        axes.plot(positions[:, across], positions[:, up], color=REFERENCE, linewidth=0.8, alpha=0.5)
        axes.scatter(
            compared[:, across], compared[:, up], c=scale.to_rgba(1000 * absolute.trans_errors), s=12, zorder=2
        )
        axes.set(xlabel=f"{'xyz'[across]}, m", ylabel=f"{'xyz'[up]}, m")
        axes.set_title(f"{score.name}: ATE {1000 * absolute.rmse:.1f} mm", loc="left")
        axes.set_aspect("equal")
    figure.colorbar(scale, ax=figure.axes, label="position error, mm")
    _save(figure, path)


def _plot_errors(
    path: Path, title: str, labels: tuple[str, str, str], results: Sequence[tuple[str, PoseErrors]]
) -> None:
    figure, (translation, rotation) = _figure(2, rows=True)
    t0 = min(result.timestamps[0] for _, result in results)
    for color, (name, result) in zip(cycle(COLORS), results, strict=False):
        parts = (translation, 1000 * result.trans_errors, "mm"), (rotation, result.rot_errors_deg, "deg")
        for axes, errors, unit in parts:
            levels = Statistics.of(errors)
            label = f"{name}: RMSE {levels.rmse:.3g}, median {levels.median:.3g} {unit}"
            _line_with_gaps(axes, result.timestamps, result.timestamps - t0, errors, color, label)
    translation.set_title(title, loc="left")
    translation.set(ylabel=labels[0], ylim=(0, None))
    rotation.set(xlabel=labels[2], ylabel=labels[1], ylim=(0, None))
    for axes in (translation, rotation):
        axes.legend(**LEGEND | {"ncols": 1 if len(results) > 2 else 2, "fontsize": "small"})
    _save(figure, path)


def _compared_reference(scores: list[Score]) -> tuple[Trajectory, float]:
    start, end = (f(g(score.absolute.timestamps) for score in scores) for f, g in ((min, np.min), (max, np.max)))
    true = scores[0].true
    assert true is not None
    during = (true.timestamps >= start - 0.1) & (true.timestamps <= end + 0.1)
    return Trajectory(true.timestamps[during], true.Ts_world_camera[during]), float(start)


def _widest_axes(positions: NDArray) -> tuple[int, int]:
    first, second = sorted(np.argsort(-np.ptp(positions, axis=0), kind="stable")[:2].tolist())
    return first, second


def _aligned(score: Score) -> NDArray[np.float64]:
    return (score.absolute.T_reference_estimate @ score.found.Ts_world_camera)[:, :3, 3]


def plot_residuals(path: Path, residuals: Path) -> None:
    """Plot of the registration residuals as a file; see ``draw_residuals``."""
    figure, (axes,) = _figure(1)
    draw_residuals(axes, residuals)
    axes.set_title("registration", loc="left")
    _save(figure, path)


def draw_residuals(axes: "Axes", residuals: Path) -> None:
    """Histogram of the registration residuals with the fitted mixture.

    Args:
        residuals: NPZ file: ``edges`` (B + 1,), standard deviations, ``counts`` (B,), ``prior`` (2,) and ``sigma`` (2,)
            of half-normal densities, static and dynamic.
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
    """Histograms of accuracy and completeness, and cumulative shares."""
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
    """Precision, recall, intersection over union, true and estimated dynamic shares over time."""
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


def _figure(count: int, *, rows: bool = False, width: float = 9.0) -> "tuple[Figure, list[Axes]]":
    names = [str(number) for number in range(count)]
    figure, axes = _figure_of(
        [[name] for name in names] if rows else [names], (width, 6.5 if rows else 5.5), sharex=rows
    )
    for one in list(axes.values())[:-1]:
        one.tick_params(labelbottom=not rows)
    return figure, list(axes.values())


def _figure_of(mosaic: Any, size: tuple[float, float], **options: Any) -> "tuple[Figure, dict[str, Axes]]":  # noqa: ANN401
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplot_mosaic(mosaic, **options)
    for one in axes.values():
        one.grid(alpha=0.25)
    return figure, axes


def _line_with_gaps(axes: "Axes", stamps: NDArray, x: NDArray, y: NDArray, color: str, label: str) -> None:
    breaks = gaps(stamps)
    axes.plot(np.insert(x, breaks, np.nan), np.insert(y, breaks, np.nan), color=color, linewidth=1.2, label=label)


def _save(figure: "Figure", path: Path) -> None:
    try:
        with atomic_path(path) as temporary:
            figure.savefig(temporary)
    except OSError as error:
        raise DudmapError(f"cannot write the plot {path}: {error.strerror or error}") from error
