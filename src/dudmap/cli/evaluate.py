"""``dudmap evaluate``: score a trajectory, a mesh or dynamic masks against the ground truth."""

import json
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
from typer import Argument, Option

from dudmap.app.terminal import say
from dudmap.atomic_file import write_text, writing
from dudmap.cli import options as o
from dudmap.cli.output import DefaultGroup
from dudmap.errors import ConfigError, DatasetError

if TYPE_CHECKING:
    from dudmap.core.geometry.trajectory import Trajectory
    from dudmap.evaluation.trajectory import Align

Figures = dict[str, Any]
"""Figures by name and unit; None for a figure that could not be computed."""


app = typer.Typer(
    cls=DefaultGroup,
    add_completion=False,
    no_args_is_help=True,
    help="Score a trajectory, a mesh or dynamic masks against the ground truth, or the time per frame.\n\n"
    "`dudmap evaluate RUN` is short for `dudmap evaluate trajectory RUN`.",
)

PlotsOption = Annotated[bool, Option("--plots", help="Also write plots.")]
FormatOption = Annotated[
    str | None, Option("--plot-format", help="Write plots as png (default), pdf or svg.", metavar="FORMAT")
]
OutOption = Annotated[
    Path | None, Option("--out", help="Output folder for figures and plots; default: the folder of the estimate.")
]
GapOption = Annotated[
    float, Option("--max-difference", help="Largest time difference of associated poses, s.", metavar="S")
]


@app.command()
def trajectory(
    estimate: Annotated[
        Path, Argument(help="Run folder, or trajectory (TUM, EuRoC or KITTI).", metavar="RUN|TRAJECTORY")
    ],
    reference: Annotated[
        Path | None, Option(help="True trajectory (TUM, EuRoC or KITTI), or the recording.", metavar="FILE|FOLDER")
    ] = None,
    estimate_format: Annotated[
        str | None,
        Option("--format", help="Format of the estimate: tum, euroc or kitti; default: recognised.", metavar="NAME"),
    ] = None,
    reference_format: Annotated[
        str | None,
        Option(help="Format of the reference, also bonn (poses of the markers).", metavar="NAME"),
    ] = None,
    times: Annotated[
        Path | None,
        Option(help="File or recording with the times of poses without times (KITTI).", metavar="FILE|FOLDER"),
    ] = None,
    fps: Annotated[float | None, Option(min=0.001, help="Rate of poses without times (KITTI).", metavar="HZ")] = None,
    align: Annotated[
        str, Option(help="se3: least-squares rigid alignment; origin: first poses aligned; none.")
    ] = "se3",
    max_difference: GapOption = 0.02,
    time_offset: Annotated[
        str, Option(help="Seconds to add to the times of the estimate; auto: best agreement.", metavar="S|auto")
    ] = "0",
    scale: Annotated[
        bool, Option("--scale", help="Also fit the scale of the estimate (Sim(3) alignment), as for one camera.")
    ] = False,
    as_json: o.JsonOption = False,
    plots: PlotsOption = False,
    plot_format: FormatOption = None,
    out: OutOption = None,
) -> None:
    """Score a trajectory: ATE, RPE per second and per metre, share of frames tracked.

    The default reference is groundtruth.txt in the run folder. Without one, only path length and duration are given.
    """
    from dudmap.evaluation.files import Clock, find_reference, find_trajectory, load_trajectories, tracked_share
    from dudmap.evaluation.hints import hints
    from dudmap.evaluation.time_offset import MotionComparison
    from dudmap.evaluation.trajectory import adjusted, fit_scale, path_figures, trajectory_figures

    ending = _plot_ending(plots, plot_format)
    seconds = None if time_offset == "auto" else o.numbers(time_offset, 1, "--time-offset")[0]
    file, folder = find_trajectory(estimate)
    truth = find_reference(reference, folder)
    estimated, known = load_trajectories(file, truth, (estimate_format, reference_format), Clock(times, fps))
    found = estimated.trajectory
    for remark in (*found.remarks, *(known.trajectory.remarks if known else ())):
        say(f"dudmap: {remark}", err=True)
    figures: Figures = {"estimate": str(file), "reference": str(truth) if truth else None}
    figures |= {"estimate_format": estimated.format, "reference_format": known.format if known else None}
    figures |= path_figures(found) | {"tracked_share": tracked_share(len(found), folder, truth)}
    alignment = cast("Align", align)  # checked by ate
    pictures: list[Path] = []
    shown: dict[str, str] = {}
    target = _output_folder(out, folder if folder is not None else file.parent)
    if known is not None:
        true = known.trajectory
        seconds = MotionComparison(found, true).best().seconds if seconds is None else seconds
        found = adjusted(found, seconds)
        factor = fit_scale(found, true, max_difference) if scale else 1.0
        found = adjusted(found, scale=factor)
        figures |= ({"time_offset_s": round(seconds, 6)} if seconds else {}) | ({"scale": factor} if scale else {})
        errors = trajectory_figures(found, true, alignment, max_difference)
        figures |= {key: _rounded(value) if isinstance(value, float) else value for key, value in errors.items()}
        figures["hints"] = hints(found, true, max_difference)
        shown["pairs"] = f"{figures['pairs']} of {len(found)} estimated and {len(true)} true poses"
        if ending:
            pictures = _plot_trajectory(target, ending, found, true, alignment, max_difference)
    if ending and folder is not None and (folder / "residuals.npz").is_file():
        from dudmap.evaluation.plots import plot_residuals

        pictures.append(target / f"residuals.{ending}")
        plot_residuals(pictures[-1], folder / "residuals.npz")
    if ending and not pictures:
        raise DatasetError("there is nothing to plot without a reference; name one with --reference")
    name = "evaluation.json" if folder is not None else f"{file.stem}.evaluation.json"
    _report(figures, target / name, pictures, as_json=as_json, title="trajectory", shown=shown)


@app.command()
def mesh(
    estimate: Annotated[Path, Argument(help="Mesh file, or run folder with mesh.ply.", metavar="EST")],
    reference: Annotated[
        Path, Argument(help="True mesh, or folder with surface.ply (and surface_observed.ply).", metavar="REF")
    ],
    register_first: Annotated[
        bool, Option("--register", help="Register the mesh to the reference first (ICP).")
    ] = False,
    thresholds: Annotated[
        str, Option("--distances", help="Distances for precision and recall, comma-separated, m.", metavar="M,M,...")
    ] = "0.01,0.02,0.05",
    ghost_distance: Annotated[
        float, Option(help="Estimated surface farther than this from the true one counts as ghost, m.")
    ] = 0.05,
    samples: Annotated[int, Option(help="Number of sampled points per surface.")] = 300_000,
    points: Annotated[bool, Option("--points", help="Accept point clouds, which have no area.")] = False,
    error_mesh: Annotated[
        bool, Option("--error-mesh/--no-error-mesh", help="Write mesh_error.ply, coloured by the error.")
    ] = True,
    as_json: o.JsonOption = False,
    plots: PlotsOption = False,
    plot_format: FormatOption = None,
    out: OutOption = None,
) -> None:
    """Score a mesh: accuracy, completeness, precision, recall, F-score and ghosts.

    A run folder and a recording with groundtruth.txt are aligned at their first pose. Other surfaces must share one
    coordinate frame.
    """
    import numpy as np

    from dudmap.evaluation import reconstruction
    from dudmap.evaluation.files import first_pose_alignment, load_mesh
    from dudmap.evaluation.surface import moved, register

    ending = _plot_ending(plots, plot_format)
    file = estimate / "mesh.ply" if estimate.is_dir() else estimate
    true_file = reference / "surface.ply" if reference.is_dir() else reference
    found, true = load_mesh(file), load_mesh(true_file)
    observed_file = reference / "surface_observed.ply"
    observed = load_mesh(observed_file) if reference.is_dir() and observed_file.is_file() else None
    figures: Figures = {"estimate": str(file), "reference": str(true_file)}
    figures["observed"] = str(observed_file) if observed is not None else None
    T = first_pose_alignment(estimate, reference)
    if register_first:
        registration = register(found, true, T)
        T = registration.T_reference_estimate
        figures |= {"icp_rmse_m": round(registration.rmse, 6), "icp_iterations": registration.num_iterations}
        figures["icp_free_directions"] = registration.free_directions
    figures["T_reference_estimate"] = None if T is None else np.round(T, 9).tolist()
    found = found if T is None else moved(found, T)
    distances = o.numbers(thresholds, None, "--distances")
    result = reconstruction.compare_surfaces(
        found, true, observed=observed, thresholds=distances, ghost_distance=ghost_distance, samples=samples,
        points=points,
    )  # fmt: skip
    columns = result.histogram_edges, result.accuracy_histogram, result.completeness_histogram
    histogram = {name: np.round(column, 6).tolist()
                 for name, column in zip(("edges_m", "accuracy", "completeness"), columns, strict=True)}  # fmt: skip
    figures |= result.figures() | {"histogram": histogram}
    target = _output_folder(out, estimate if estimate.is_dir() else file.parent)
    stem = "mesh" if estimate.is_dir() else file.stem
    pictures: list[Path] = []
    if error_mesh:
        pictures.append(target / f"{stem}_error.ply")
        reconstruction.error_mesh(found, true, largest=ghost_distance, points=points).save(pictures[-1])
    if ending:
        from dudmap.evaluation.plots import plot_surface

        pictures.append(target / f"{stem}_error.{ending}")
        plot_surface(pictures[-1], result)
    _report(figures, target / f"{stem}.evaluation.json", pictures, as_json=as_json, title="mesh")


@app.command()
def masks(
    estimate: Annotated[Path, Argument(help="Run folder with masks/ (--save-masks).", metavar="RUN")],
    reference: Annotated[
        Path, Argument(help="Recording's folder with mask.txt, or folder of <timestamp>.png.", metavar="REF")
    ],
    per_frame: Annotated[
        bool, Option("--per-frame", help="Add the figures of every frame to the JSON output.")
    ] = False,
    as_json: o.JsonOption = False,
    plots: PlotsOption = False,
    plot_format: FormatOption = None,
    out: OutOption = None,
) -> None:
    """Score dynamic masks: precision, recall and IoU, per frame and overall."""
    from dudmap.evaluation.segmentation import SCORED_COVERAGE, compare_masks, mask_pairs

    ending = _plot_ending(plots, plot_format)
    result = compare_masks(*mask_pairs(estimate, reference))
    figures: Figures = {"estimate": str(estimate), "reference": str(reference), "frames": len(result.timestamps)}
    for key in ("overall_precision", "overall_recall", "overall_iou", "mean_iou", "false_alarm_share"):
        figures[key] = _rounded(getattr(result, key))
    figures |= {"scored_frames": result.num_scored, "scored_coverage": SCORED_COVERAGE}
    figures["missing_frames"] = result.num_missing
    if per_frame:
        columns = ("timestamps", "coverage", "found_share", "precision", "recall", "iou")
        figures["per_frame"] = {key: [_rounded(x, 6) for x in getattr(result, key)] for key in columns}
    target, pictures = _output_folder(out, estimate), []
    if ending:
        from dudmap.evaluation.plots import plot_masks

        pictures = [target / f"masks.{ending}"]
        plot_masks(pictures[0], result)
    _report(figures, target / "masks.evaluation.json", pictures, as_json=as_json, title="masks")


@app.command()
def timings(run: o.RunArgument, as_json: o.JsonOption = False, out: OutOption = None) -> None:
    """Score the time per frame: median, mean and 95 % quantile of every stage, also as a LaTeX table (timings.tex)."""
    import numpy as np

    from dudmap.app.viewing.run_files import RunFiles

    found = RunFiles.load(run)
    if not found.frames:
        raise DatasetError(f"{run} holds no times per frame (timings.csv); name a folder of dudmap run")
    figures: Figures = {"estimate": str(run), "frames": len(found.frames)}
    lines = [r"\begin{tabular}{lrrr}", r"stage & median & mean & 95\,\% \\ \hline"]
    for stage in ["total", *found.stages]:
        times = found.column(stage)
        row = float(np.median(times)), float(times.mean()), float(np.percentile(times, 95))
        for name, value in zip(("median", "mean", "p95"), row, strict=True):
            figures[f"{stage}_{name}_ms"] = round(value, 3)
        cells = " & ".join(f"{value:.1f}" for value in row)
        lines.append(f"{stage.replace('_', ' ')} & {cells} \\\\")
    target = _output_folder(out, run)
    write_text(target / "timings.tex", "\n".join([*lines, r"\end{tabular} % milliseconds per frame"]) + "\n")
    _report(figures, target / "timings.evaluation.json", [target / "timings.tex"], as_json=as_json, title="timings")


def _plot_ending(plots: bool, plot_format: str | None) -> str:
    """Ending of the files of plots, empty if none are wanted."""
    ending = (plot_format or "png").lower()
    if ending not in ("png", "pdf", "svg"):
        raise ConfigError(f"found --plot-format {plot_format}; expected png, pdf or svg")
    return ending if plots or plot_format else ""


def _plot_trajectory(
    target: Path, ending: str, found: "Trajectory", true: "Trajectory", align: "Align", max_difference: float
) -> list[Path]:
    from dudmap.evaluation import plots
    from dudmap.evaluation.trajectory import ate, rpe

    absolute = ate(found, true, align, max_difference)
    pictures = [target / f"trajectory.{ending}", target / f"error.{ending}"]
    plots.plot_trajectories(pictures[0], found, true, absolute)
    plots.plot_errors(pictures[1], absolute)
    try:
        relative = rpe(found, true, 1.0, "s", max_difference)
    except DatasetError:  # the reason is among the figures
        return pictures
    plots.plot_errors(target / f"rpe.{ending}", relative)
    return [*pictures, target / f"rpe.{ending}"]


def _output_folder(out: Path | None, default: Path) -> Path:
    target = out or default
    with writing(f"into the folder {target}"):
        target.mkdir(parents=True, exist_ok=True)
    return target


def _report(
    figures: Figures,
    file: Path,
    pictures: list[Path],
    *,
    as_json: bool,
    title: str,
    shown: dict[str, str] | None = None,
) -> None:
    """Write the figures as JSON and print them, those in ``shown`` as they stand there, and hints below the table."""
    text = json.dumps(figures, allow_nan=False)
    with writing(file):
        write_text(file, text + "\n")
    if as_json:
        say(text)
        return
    from rich.table import Table

    from dudmap.app.terminal import plain_console

    table = Table(title=title, show_header=False)
    for key, value in (figures | (shown or {})).items():
        if value is not None and not isinstance(value, list | dict):
            table.add_row(*_shown(key, value))
    console = plain_console()
    console.print(table)
    for hint in figures.get("hints", []):
        console.print(f"hint: {hint}", soft_wrap=True)
    console.print("written: " + ", ".join(str(path) for path in [file, *pictures]), soft_wrap=True)


def _shown(key: str, value: object) -> tuple[str, str]:
    """Name and value of a figure for people: errors of a trajectory in millimetres and degrees."""
    match = re.fullmatch(r"((?:ate|rpe|drift|rotation)_\w+?)_(m|deg)(?:_per_(m|s))?", key)
    if not isinstance(value, float) or match is None:
        digits = 16 if key == "time_offset_s" else 6
        return key, f"{value:.{digits}g}" if isinstance(value, float) else str(value)
    name, unit, per = match.groups()
    text = f"{1000 * value:.1f} mm" if unit == "m" else f"{value:.2f} deg"
    note = " (see rotation_rmse)" if name.startswith("ate_rot") else ""
    return (f"{name} per {per}" if per else name) + note, text


def _rounded(value: float, digits: int = 9) -> float | None:
    return round(float(value), digits) if math.isfinite(value) else None
