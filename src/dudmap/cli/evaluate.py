"""``dudmap evaluate``: score a trajectory, a mesh or dynamic masks against the ground truth."""

import json
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
    from dudmap.evaluation.comparison import Score
    from dudmap.evaluation.trajectory import Align

Figures = dict[str, Any]
QUANTILES = {"median": "median", "mean": "mean", "p95": "95 %"}

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
    estimates: Annotated[
        list[str],
        Argument(
            help="Run folders, or trajectories (TUM, EuRoC or KITTI); NAME=PATH names the method.",
            metavar="[NAME=]PATH",
        ),
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
    table_format: Annotated[
        str | None, Option(help="Print one table only: md, csv or latex (booktabs).", metavar="FORMAT")
    ] = None,
    as_json: o.JsonOption = False,
    plots: PlotsOption = False,
    plot_format: FormatOption = None,
    out: OutOption = None,
) -> None:
    """Score trajectories: ATE, RPE per second and per metre, share of frames tracked.

    Several estimates give one table, and --plots draws them in one plot. The default reference of one run is
    groundtruth.txt in its folder. Without one, only path length and duration are given.
    """
    from dudmap.evaluation.comparison import COLUMNS, Manner, Named, compare, score
    from dudmap.evaluation.files import Clock
    from dudmap.evaluation.tables import FORMATS, table

    ending = _plot_ending(plots, plot_format)
    if estimate_format in FORMATS:
        raise ConfigError(f"--format is the format of the estimate; the table takes --table-format {estimate_format}")
    if table_format is not None and (table_format not in FORMATS or as_json):
        found = f"--table-format {table_format}{' and --json' if as_json else ''}"
        raise ConfigError(f"found {found}; expected one of {', '.join(FORMATS)}, or --json")
    seconds = None if time_offset == "auto" else o.numbers(time_offset, 1, "--time-offset")[0]
    alignment = cast("Align", align)  # checked by ate
    clock = Clock(times, fps)
    manner = Manner((estimate_format, reference_format), clock, alignment, max_difference, seconds, scale)
    named = [Named.of(text) for text in estimates]
    if len(named) == 1:
        scores = [score(named[0].path, named[0].name, reference, manner)]
    elif reference is None:
        raise ConfigError("several estimates need one reference; name it with --reference")
    else:
        scores = compare(named, reference, manner)
    for remark in dict.fromkeys(remark for one in scores for remark in one.remarks):
        say(f"dudmap: {remark}", err=True)
    first, several = scores[0], len(scores) > 1
    default = Path("evaluation") if several else first.run or first.file.parent
    target = _output_folder(out, default)
    pictures = _plot_trajectories(target, ending, scores) if ending else []
    if ending and not pictures:
        raise DatasetError("there is nothing to plot without a reference; name one with --reference")
    figures = {"estimates": [{"name": one.name} | one.figures for one in scores]} if several else first.figures
    stem = "evaluation" if several or first.run else f"{first.file.stem}.evaluation"
    written = [target / f"{stem}.json", *pictures]
    _write_json(written[0], figures)
    text = table([one.row for one in scores], COLUMNS, table_format or "md")
    if several or table_format:
        written.insert(1, target / f"{stem}.{FORMATS[table_format or 'md']}")
        write_text(written[1], text)
    if as_json or not (several or table_format):
        shown = {} if first.true is None else {
            "pairs": f"{first.figures['pairs']} of {len(first.found)} estimated and {len(first.true)} true poses"
        }  # fmt: skip
        _print(figures, written, as_json=as_json, title="trajectory", shown=shown)
        return
    say(text.rstrip("\n"))
    for one in scores:
        for hint in one.figures.get("hints", []):
            say(f"{one.name}: hint: {hint}", err=True)
    say("written: " + ", ".join(map(str, written)), err=True)


@app.command()
def mesh(
    estimate: Annotated[Path, Argument(help="Mesh file, or run folder with mesh.ply.", metavar="EST")],
    reference: Annotated[
        Path,
        Argument(
            help="True mesh, folder with surface.ply (and surface_observed.ply), or ICL-NUIM recording.",
            metavar="REF",
        ),
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

    A run folder and a recording with ground truth are aligned at their first pose. Other surfaces must share one
    coordinate frame.
    """
    import numpy as np

    from dudmap.evaluation import reconstruction
    from dudmap.evaluation.files import TrueSurface, first_pose_alignment, load_mesh, true_surface
    from dudmap.evaluation.surface import moved, register

    ending = _plot_ending(plots, plot_format)
    file = estimate / "mesh.ply" if estimate.is_dir() else estimate
    found, truth = load_mesh(file), true_surface(reference) if reference.is_dir() else None
    if truth is None:
        true_file = reference / "surface.ply" if reference.is_dir() else reference
        truth = TrueSurface(true_file, load_mesh(true_file))
    true, observed = truth.whole, truth.observed
    figures: Figures = {"estimate": str(file), "reference": str(truth.path)}
    figures["observed"] = str(truth.observed_path) if truth.observed_path is not None else None
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
    from dudmap.evaluation.comparison import rounded
    from dudmap.evaluation.segmentation import SCORED_COVERAGE, compare_masks, mask_pairs

    ending = _plot_ending(plots, plot_format)
    result = compare_masks(*mask_pairs(estimate, reference))
    figures: Figures = {"estimate": str(estimate), "reference": str(reference), "frames": len(result.timestamps)}
    for key in ("overall_precision", "overall_recall", "overall_iou", "mean_iou", "false_alarm_share"):
        figures[key] = rounded(getattr(result, key))
    figures |= {"scored_frames": result.num_scored, "scored_coverage": SCORED_COVERAGE}
    figures["missing_frames"] = result.num_missing
    if per_frame:
        columns = ("timestamps", "coverage", "found_share", "precision", "recall", "iou")
        figures["per_frame"] = {key: [rounded(x, 6) for x in getattr(result, key)] for key in columns}
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
    from dudmap.evaluation.tables import Column, table

    found = RunFiles.load(run)
    if not found.frames:
        raise DatasetError(f"{run} holds no times per frame (timings.csv); name a folder of dudmap run")
    figures: Figures = {"estimate": str(run), "frames": len(found.frames)}
    columns = [Column("stage", "stage")] + [Column(key, f"{said}, ms", digits=1) for key, said in QUANTILES.items()]
    rows: list[Figures] = []
    for stage in ["total", *found.stages]:
        times = found.column(stage)
        numbers = float(np.median(times)), float(times.mean()), float(np.percentile(times, 95))
        rows.append({"stage": stage.replace("_", " ")} | dict(zip(QUANTILES, numbers, strict=True)))
        figures |= {f"{stage}_{key}_ms": round(rows[-1][key], 3) for key in QUANTILES}
    target = _output_folder(out, run)
    written = [target / "timings.evaluation.json", target / "timings.tex"]
    _write_json(written[0], figures)
    with writing(written[1]):
        write_text(written[1], table(rows, columns, "latex"))
    if as_json:
        say(json.dumps(figures, allow_nan=False))
        return
    say(table(rows, columns, "md").rstrip("\n"))
    say("written: " + ", ".join(map(str, written)), err=True)


def _plot_ending(plots: bool, plot_format: str | None) -> str:
    ending = (plot_format or "png").lower()
    if ending not in ("png", "pdf", "svg"):
        raise ConfigError(f"found --plot-format {plot_format}; expected png, pdf or svg")
    return ending if plots or plot_format else ""


def _plot_trajectories(target: Path, ending: str, scores: "list[Score]") -> list[Path]:
    from dudmap.evaluation import plots

    written: list[Path] = []
    if scores[0].true is not None:
        written = [target / f"{name}.{ending}" for name in ("trajectory", "error", "path")]
        plots.plot_trajectories(written[0], scores)
        plots.plot_errors(written[1], scores)
        plots.plot_error_paths(written[2], scores)
        if plots.plot_relative_errors(target / f"rpe.{ending}", scores):
            written.append(target / f"rpe.{ending}")
    run = scores[0].run
    if len(scores) == 1 and run is not None and (run / "residuals.npz").is_file():
        written.append(target / f"residuals.{ending}")
        plots.plot_residuals(written[-1], run / "residuals.npz")
    return written


def _output_folder(out: Path | None, default: Path) -> Path:
    target = out or default
    with writing(f"into the folder {target}"):
        target.mkdir(parents=True, exist_ok=True)
    return target


def _report(figures: Figures, file: Path, pictures: list[Path], *, as_json: bool, title: str) -> None:
    _write_json(file, figures)
    _print(figures, [file, *pictures], as_json=as_json, title=title, shown={})


def _write_json(file: Path, figures: Figures) -> None:
    with writing(file):
        write_text(file, json.dumps(figures, allow_nan=False) + "\n")


def _print(figures: Figures, written: list[Path], *, as_json: bool, title: str, shown: dict[str, str]) -> None:
    if as_json:
        say(json.dumps(figures, allow_nan=False))
        return
    from rich.table import Table

    from dudmap.app.terminal import plain_console

    table = Table(title=title, show_header=False)
    for key, value in (figures | shown).items():
        if value is not None and not isinstance(value, list | dict):
            table.add_row(*_shown(key, value))
    console = plain_console()
    console.print(table)
    for hint in figures.get("hints", []):
        console.print(f"hint: {hint}", soft_wrap=True)
    console.print("written: " + ", ".join(map(str, written)), soft_wrap=True)


def _shown(key: str, value: object) -> tuple[str, str]:
    match = re.fullmatch(r"((?:ate|rpe|drift|rotation)_\w+?)_(m|deg)(?:_per_(m|s))?", key)
    if not isinstance(value, float) or match is None:
        digits = 16 if key == "time_offset_s" else 6
        return key, f"{value:.{digits}g}" if isinstance(value, float) else str(value)
    name, unit, per = match.groups()
    text = f"{1000 * value:.1f} mm" if unit == "m" else f"{value:.2f} deg"
    note = " (see rotation_rmse)" if name.startswith("ate_rot") else ""
    return (f"{name} per {per}" if per else name) + note, text
