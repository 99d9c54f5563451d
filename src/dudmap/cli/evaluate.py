"""``dudmap evaluate``: score a trajectory, a mesh or dynamic masks against the truth."""

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from dudmap.errors import ConfigError, DatasetError, DudmapError

if TYPE_CHECKING:
    import numpy as np

    from dudmap.geometry.mesh import Mesh
    from dudmap.geometry.trajectory import Trajectory

Figures = dict[str, Any]
"""Numbers by name and unit; None where there is none."""


class EvaluateGroup(TyperGroup):
    """``evaluate RUN`` is short for ``evaluate trajectory RUN``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:  # noqa: ANN401 - Typer's own types moved between versions
        """Put the command's name before arguments that start with none."""
        if args and args[0] not in self.commands and args[0] != "--help":
            args = ["trajectory", *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=EvaluateGroup,
    add_completion=False,
    no_args_is_help=True,
    help="Score a trajectory, a mesh or dynamic masks against the truth.\n\n"
    "`dudmap evaluate RUN` is short for `dudmap evaluate trajectory RUN`.",
)

JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of a table.")]
PlotsOption = Annotated[bool, typer.Option("--plots", help="Also draw PNG pictures, into the folder of the figures.")]
OutOption = Annotated[
    Path | None,
    typer.Option("--out", help="Folder for the JSON file and the pictures; default: beside what is scored."),
]
GapOption = Annotated[
    float, typer.Option("--max-difference", help="Times further apart belong to different frames, s.", metavar="S")
]


@app.command()
def trajectory(
    estimate: Annotated[
        Path, typer.Argument(help="Run folder, or trajectory in TUM format.", metavar="RUN|TRAJECTORY")
    ],
    reference: Annotated[
        Path | None,
        typer.Option(
            "--reference", help="True trajectory in TUM format, or the recording's folder with groundtruth.txt."
        ),
    ] = None,
    align: Annotated[
        str,
        typer.Option("--align", help="se3: best rigid motion; origin: first pose onto the first true pose; none."),
    ] = "se3",
    max_difference: GapOption = 0.02,
    as_json: JsonOption = False,
    plots: PlotsOption = False,
    out: OutOption = None,
) -> None:
    """Score a trajectory: ATE, RPE per second and per metre, share of frames tracked.

    Without a reference, groundtruth.txt in the run folder is taken; where there is none, only length and duration
    are told.
    """
    from dudmap.geometry.trajectory import Trajectory

    file, folder = _trajectory_of(estimate)
    found = Trajectory.load(file)
    truth = _reference_of(reference, folder)
    figures: Figures = {"estimate": str(file), "reference": str(truth) if truth else None}
    figures |= describe(found) | {"tracked_share": tracked_share(len(found), folder, truth)}
    pictures: list[Path] = []
    target = _target(out, folder if folder is not None else file.parent)
    if truth is not None:
        true = Trajectory.load(truth)
        figures |= compare(found, true, align, max_difference)
        if plots:
            pictures = _draw_trajectory(target, found, true, align, max_difference)
    if plots and folder is not None and (folder / "residuals.npz").is_file():
        from dudmap.evaluation.plots import plot_residuals

        plot_residuals(target / "residuals.png", folder / "residuals.npz")
        pictures.append(target / "residuals.png")
    if plots and not pictures:
        raise DatasetError("there is nothing to draw without a reference; name one with --reference")
    name = "evaluation.json" if folder is not None else f"{file.stem}.evaluation.json"
    _report(figures, target / name, pictures, as_json=as_json, title="trajectory")


@app.command()
def mesh(
    estimate: Annotated[Path, typer.Argument(help="Mesh file, or run folder with mesh.ply.", metavar="EST")],
    reference: Annotated[
        Path, typer.Argument(help="True mesh, or folder with surface.ply (and surface_observed.ply).", metavar="REF")
    ],
    align: Annotated[bool, typer.Option("--align", help="First register the mesh to the reference (ICP).")] = False,
    thresholds: Annotated[
        str, typer.Option("--distances", help="Distances for precision and recall, m, with commas.", metavar="M,M,...")
    ] = "0.01,0.02,0.05",
    ghost_distance: Annotated[
        float, typer.Option("--ghost-distance", help="Surface farther than this from the true one is a ghost, m.")
    ] = 0.05,
    samples: Annotated[int, typer.Option("--samples", help="Points drawn on each surface.")] = 300_000,
    points: Annotated[bool, typer.Option("--points", help="Accept point clouds; they have no area.")] = False,
    error_mesh: Annotated[
        bool, typer.Option("--error-mesh/--no-error-mesh", help="Write mesh_error.ply, coloured by the error.")
    ] = True,
    as_json: JsonOption = False,
    plots: PlotsOption = False,
    out: OutOption = None,
) -> None:
    """Score a mesh: accuracy, completeness, precision, recall, F-score and ghosts.

    A run folder scored against a recording's folder with groundtruth.txt is first moved so that the run's first
    pose is the true one; anything else is taken to be in one frame already.
    """
    from dudmap.evaluation import reconstruction
    from dudmap.evaluation.surface import moved, register

    file = estimate / "mesh.ply" if estimate.is_dir() else estimate
    true_file = reference / "surface.ply" if reference.is_dir() else reference
    found, true = _mesh(file), _mesh(true_file)
    observed_file = reference / "surface_observed.ply"
    observed = _mesh(observed_file) if reference.is_dir() and observed_file.is_file() else None
    figures: Figures = {"estimate": str(file), "reference": str(true_file)}
    figures["observed"] = str(observed_file) if observed is not None else None
    T = _start(estimate, reference)
    if align:
        registration = register(found, true, T)
        T = registration.T_reference_estimate
        figures |= {
            "icp_rmse_m": round(registration.rmse, 6),
            "icp_iterations": registration.num_iterations,
            "icp_free_directions": registration.free_directions,
        }
    figures["T_reference_estimate"] = None if T is None else [[round(float(x), 9) for x in row] for row in T]
    found = found if T is None else moved(found, T)
    result = reconstruction.compare_surfaces(
        found,
        true,
        observed=observed,
        thresholds=_distances(thresholds),
        ghost_distance=ghost_distance,
        samples=samples,
        points=points,
    )
    figures |= result.figures()
    figures["histogram"] = {
        "edges_m": [round(float(edge), 6) for edge in result.histogram_edges],
        "accuracy": [round(float(share), 6) for share in result.accuracy_histogram],
        "completeness": [round(float(share), 6) for share in result.completeness_histogram],
    }
    target = _target(out, estimate if estimate.is_dir() else file.parent)
    stem = "mesh" if estimate.is_dir() else file.stem
    pictures: list[Path] = []
    if error_mesh:
        pictures.append(target / f"{stem}_error.ply")
        reconstruction.error_mesh(found, true, largest=ghost_distance, points=points).save(pictures[-1])
    if plots:
        from dudmap.evaluation.plots import plot_surface

        pictures.append(target / f"{stem}_error.png")
        plot_surface(pictures[-1], result)
    _report(figures, target / f"{stem}.evaluation.json", pictures, as_json=as_json, title="mesh")


@app.command()
def masks(
    estimate: Annotated[Path, typer.Argument(help="Run folder with masks/ (--save-masks).", metavar="RUN")],
    reference: Annotated[
        Path, typer.Argument(help="Recording's folder with mask.txt, or folder of <timestamp>.png.", metavar="REF")
    ],
    per_frame: Annotated[
        bool, typer.Option("--per-frame", help="Also give every frame's figures (JSON, CSV).")
    ] = False,
    as_json: JsonOption = False,
    plots: PlotsOption = False,
    out: OutOption = None,
) -> None:
    """Score dynamic masks: precision, recall and IoU, per frame and overall."""
    from dudmap.evaluation.segmentation import MaskFolders, compare_masks

    pairs = MaskFolders(estimate, reference)
    result = compare_masks(pairs, num_missing=pairs.num_missing)
    figures: Figures = {"estimate": str(estimate), "reference": str(reference), "frames": len(result.timestamps)}
    for key in ("overall_precision", "overall_recall", "overall_iou", "mean_iou", "false_alarm_share"):
        figures[key] = _rounded(getattr(result, key))
    figures |= {"scored_frames": result.num_scored, "scored_coverage": result.scored_coverage}
    figures["missing_frames"] = result.num_missing
    if per_frame:
        columns = ("timestamps", "coverage", "found_share", "precision", "recall", "iou")
        figures["per_frame"] = {key: [_rounded(x, 6) for x in getattr(result, key)] for key in columns}
    target, pictures = _target(out, estimate), []
    if plots:
        from dudmap.evaluation.plots import plot_masks

        pictures = [target / "masks.png"]
        plot_masks(pictures[0], result)
    _report(figures, target / "masks.evaluation.json", pictures, as_json=as_json, title="masks")


def describe(found: "Trajectory") -> Figures:
    """What a trajectory tells without a reference."""
    import numpy as np

    steps = np.linalg.norm(np.diff(found.Ts_world_camera[:, :3, 3], axis=0), axis=1)
    duration = float(found.timestamps[-1] - found.timestamps[0])
    return {"poses": len(found), "duration_s": round(duration, 6), "path_length_m": round(float(steps.sum()), 6)}


def compare(found: "Trajectory", true: "Trajectory", align: str, max_difference: float) -> Figures:
    """Absolute and relative errors; a relative one is None where the recording is too short for it."""
    from dudmap.evaluation.trajectory import ate, rpe

    absolute = ate(found, true, align, max_difference)  # pyright: ignore[reportArgumentType] - checked inside
    out: Figures = {"pairs": absolute.num_pairs, "alignment": absolute.alignment}
    for key in ("rmse", "mean", "median", "max"):
        out[f"ate_{key}_m"] = _rounded(getattr(absolute, key))
    for key in ("rmse", "mean", "median", "max"):
        out[f"ate_rot_{key}_deg"] = _rounded(getattr(absolute, f"rot_{key}_deg"))
    start = ate(found, true, "origin", max_difference)
    out |= {"drift_rmse_m": _rounded(start.rmse), "rotation_rmse_deg": _rounded(start.rot_rmse_deg)}
    for unit in ("s", "m"):
        names = [f"rpe_trans_{key}_m_per_{unit}" for key in ("rmse", "mean", "median", "max")]
        names += [f"rpe_rot_{key}_deg_per_{unit}" for key in ("rmse", "mean", "median", "max")]
        try:
            relative = rpe(found, true, 1.0, unit, max_difference)
        except DatasetError as error:
            out |= dict.fromkeys(names) | {f"rpe_per_{unit}_missing": str(error)}
            continue
        values = [getattr(relative, f"trans_{key}") for key in ("rmse", "mean", "median", "max")]
        values += [getattr(relative, f"rot_{key}_deg") for key in ("rmse", "mean", "median", "max")]
        out |= {name: _rounded(value) for name, value in zip(names, values, strict=True)}
    return out


def tracked_share(poses: int, folder: Path | None, truth: Path | None) -> float | None:
    """Share of the recording's frames that have a pose; None where the number of frames is not known.

    It is known from a run's metrics.json, or else from the lists of images beside the true trajectory.
    """
    from dudmap.geometry.association import read_list, read_pairs

    if folder is not None and (folder / "metrics.json").is_file():
        try:
            frames = int(json.loads((folder / "metrics.json").read_text(encoding="utf-8"))["frames"])
        except (ValueError, KeyError, TypeError) as error:
            raise DatasetError(f"{folder / 'metrics.json'} does not tell the number of frames: {error}") from error
    elif truth is not None and (truth.parent / "associations.txt").is_file():
        frames = len(read_pairs(truth.parent / "associations.txt"))
    elif truth is not None and (truth.parent / "depth.txt").is_file():
        frames = len(read_list(truth.parent / "depth.txt"))
    else:
        return None
    return round(poses / frames, 6) if frames else None


def _trajectory_of(estimate: Path) -> tuple[Path, Path | None]:
    """The trajectory's file, and the run folder if it is one."""
    if not estimate.is_dir():
        return estimate, None
    file = estimate / "trajectory.txt"
    if not file.is_file():
        raise DatasetError(f"{estimate} is no run folder: it holds no trajectory.txt")
    return file, estimate


def _reference_of(reference: Path | None, folder: Path | None) -> Path | None:
    if reference is not None:
        file = reference / "groundtruth.txt" if reference.is_dir() else reference
        if not file.is_file():
            raise DatasetError(f"there is no true trajectory {file}; name a file in TUM format or a recording's folder")
        return file
    beside = None if folder is None else folder / "groundtruth.txt"
    return beside if beside is not None and beside.is_file() else None


def _mesh(file: Path) -> "Mesh":
    from dudmap.errors import MapError
    from dudmap.geometry.mesh import Mesh

    if not file.is_file():
        raise MapError(f"there is no mesh {file}; name a mesh file, or a folder that holds {file.name}")
    return Mesh.load(file)


def _start(estimate: Path, reference: Path) -> "np.ndarray | None":
    """What brings a run's first pose onto the true one, if both are folders with trajectories.

    The run's world is its first camera. Aligning all positions would turn the map: on a short path they hardly
    determine the rotation.
    """
    from dudmap.evaluation.trajectory import ate
    from dudmap.geometry.trajectory import Trajectory

    found, true = estimate / "trajectory.txt", reference / "groundtruth.txt"
    if not (found.is_file() and true.is_file()):
        return None
    return ate(Trajectory.load(found), Trajectory.load(true), "origin").T_reference_estimate


def _distances(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"--distances is {text!r}; expected metres with commas, e.g. 0.01,0.02,0.05") from None


def _draw_trajectory(
    target: Path, found: "Trajectory", true: "Trajectory", align: str, max_difference: float
) -> list[Path]:
    from dudmap.evaluation import plots
    from dudmap.evaluation.trajectory import ate, rpe

    absolute = ate(found, true, align, max_difference)  # pyright: ignore[reportArgumentType] - checked before
    pictures = [target / "trajectory.png", target / "error.png"]
    plots.plot_trajectories(pictures[0], found, true, absolute)
    plots.plot_error(pictures[1], absolute)
    try:
        relative = rpe(found, true, 1.0, "s", max_difference)
    except DatasetError:  # the figures say why there is none
        return pictures
    plots.plot_rpe(target / "rpe.png", relative)
    return [*pictures, target / "rpe.png"]


def _target(out: Path | None, default: Path) -> Path:
    target = out or default
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DudmapError(f"cannot make the folder {target}: {error.strerror or error}") from error
    return target


def _report(figures: Figures, file: Path, pictures: list[Path], *, as_json: bool, title: str) -> None:
    """Save the figures and print them."""
    text = json.dumps(figures, allow_nan=False)
    try:
        file.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise DudmapError(f"cannot write {file}: {error.strerror or error}; name a folder with --out") from error
    if as_json:
        typer.echo(text)
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, show_header=False)
    for key, value in figures.items():
        if value is not None and not isinstance(value, list | dict):
            table.add_row(key, f"{value:.6g}" if isinstance(value, float) else str(value))
    console = Console()
    console.print(table)
    console.print("written: " + ", ".join(str(path) for path in [file, *pictures]), soft_wrap=True, highlight=False)


def _rounded(value: float, digits: int = 9) -> float | None:
    return round(float(value), digits) if math.isfinite(value) else None
