"""``dudmap benchmark``: suites of recordings, the accuracy gate, the limit of dynamics, speed, and GPUs."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from dudmap.app.terminal import say
from dudmap.cli import options as o
from dudmap.cli.benchmark_changes import changes
from dudmap.cli.benchmark_machine import RUNS, QuickOption, compile_, gpu, soak, speed
from dudmap.cli.output import answer
from dudmap.lab.benchmark.suites import SUITES

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    help="Run a suite of recordings, the accuracy gate, the limit of dynamics, or a speed measurement.",
)

SystemsOption = Annotated[
    str,
    Option(
        "--systems",
        help="Comma-separated names (docs/benchmarks.md) or .toml files. Default: dudmap; ablation and sensors have "
        "systems of their own.",
    ),
]

DataOption = Annotated[
    Path | None, Option("--data", help="Folder of the recordings; nothing is downloaded.", metavar="FOLDER")
]


def suite_command(
    context: typer.Context,
    systems: SystemsOption = "",
    out: Annotated[Path | None, Option(help="Default: runs/benchmark/<suite>.")] = None,
    data: DataOption = None,
    jobs: o.JobsOption = 1,
    quick: QuickOption = False,
    score: Annotated[
        list[str] | None,
        Option(
            metavar="NAME=FOLDER",
            help="Score results of another system, FOLDER/<sequence>/trajectory.txt and mesh.ply; repeatable.",
        ),
    ] = None,
    as_json: o.JsonOption = False,
) -> None:
    """Measure every recording of the suite; write Markdown, CSV and JSON."""
    from dudmap.lab.benchmark.report import named_folders, run_suite
    from dudmap.lab.benchmark.suites import USUAL, find_suite
    from dudmap.lab.benchmark.suites import systems as find_systems

    name = str(context.info_name)
    wanted, others = find_systems(systems or USUAL.get(name, "dudmap")), named_folders(score or [])
    suite = find_suite(name, data, quick=quick)
    out = out or RUNS / name
    tree, text = run_suite(suite, wanted, others, out, workers=jobs, done=_print_outcome)
    answer(tree, text, as_json=as_json, out=out)


for _command in (changes, speed, gpu, soak):
    app.command()(_command)
app.command("compile")(compile_)
for _name, _help in SUITES.items():
    app.command(_name, help=_help)(suite_command)


def _print_outcome(row: dict[str, Any]) -> None:
    outcome = row.get("error") or f"{row.get('tracked', row.get('frames'))} of {row.get('frames')} frames"
    say(f"{row['sequence']}, {row['system']}: {outcome}", err=True)


@app.command()
def random(
    number: Annotated[int, Option("--count", min=1, help="Number of worlds.")] = 40,
    seed: o.SeedOption = 0,
    only: Annotated[str, Option(help="Comma-separated numbers of worlds, instead of --count.")] = "",
    out: Annotated[Path, Option(help="Output folder for the rows and the report.")] = RUNS / "random",
    jobs: o.JobsOption = 1,
    assignments: o.SetOption = None,
    as_json: o.JsonOption = False,
) -> None:
    """Measure random worlds with random sensors: distribution of the ATE, silent failures, and the worst worlds.

    Every world is written to the folder as soon as it is measured; an interrupted run of the same code continues.
    """
    from dudmap.errors import ConfigError
    from dudmap.lab.benchmark.random_worlds import measure_worlds, report

    try:
        numbers = [int(world) for world in only.split(",") if world] or list(range(number))
    except ValueError:
        raise ConfigError(f"cannot understand --only {only!r}; expected numbers of worlds, such as 3,17") from None
    rows = measure_worlds(seed, numbers, o.read_config(None, None, assignments), out, jobs, _print_world)
    text = report(rows, seed)
    (out / f"seed-{seed}.md").write_text(text, encoding="utf-8")
    answer({"rows": rows}, text, as_json=as_json, out=out)


def _print_world(row: dict[str, Any]) -> None:
    ate = row.get("ate_rmse_m")
    figure = row.get("error") or "no ATE" if ate is None else f"{1000 * ate:.1f} mm, {row['lost']} lost"
    say(f"world {row['world']}: {figure}", err=True)


@app.command()
@o.grouped
def calls(
    reading: o.ReadingOptions,
    recording: Annotated[Path | None, Argument(help="Recording; default: a synthetic room with a person.")] = None,
    max_frames: Annotated[int, Option(min=44, help="Number of frames; the first 40 are not counted.")] = 60,
    assignments: o.SetOption = None,
    as_json: o.JsonOption = False,
) -> None:
    """Count the kernel launches, barriers, Python calls and source files of an ordinary frame, and time its stages."""
    from dudmap.lab.benchmark.calls import count_calls, memory_rate, stage_table, summary
    from dudmap.lab.benchmark.suites import Entry

    room = Entry("room-person", parameters={"frames": max_frames, "start_dynamic": False})
    source = room.open() if recording is None else reading.open(recording)
    costs = count_calls(source, o.read_config(None, None, assignments), max_frames)
    tree = summary(costs)
    text = ", ".join(f"{value:.0f} {name}" for name, value in tree.items())
    answer(tree, f"{text}\n{stage_table(costs, memory_rate())}", as_json=as_json)


@app.command()
@o.grouped
def faults(
    reading: o.ReadingOptions,
    recording: Annotated[
        Path | None, Argument(help="Recording with true poses; default: a synthetic room with people.")
    ] = None,
    max_frames: Annotated[int, Option(min=20, help="Number of frames of the recording.")] = 120,
    width: Annotated[int, Option(min=80, help="Width of the synthetic images, pixels.")] = 320,
    seed: o.SeedOption = 0,
    only: Annotated[str, Option(help="Comma-separated faults; default: all.")] = "",
    out: Annotated[Path | None, Option(help="Also write the table to this file (Markdown).")] = None,
    assignments: o.SetOption = None,
    as_json: o.JsonOption = False,
) -> None:
    """Inject every fault of a stream into a recording; fail on a wrong tracked pose, or if tracking stays lost."""
    from dudmap.lab.benchmark.stream_faults import default_room, fault_row, measure_stream_faults, table_head

    config = o.read_config(None, None, assignments)
    source = default_room(max_frames, width, seed) if recording is None else reading.open(recording)
    lines, failed, rows = [table_head(source.name, max_frames)], 0, []
    say(lines[0], err=as_json)
    for run, clean in measure_stream_faults(source, config, [name for name in only.split(",") if name], max_frames):
        lines.append(fault_row(run, clean))
        outcome = run.outcome(clean)
        rows.append({"fault": run.fault, "outcome": outcome, "rejected": run.rejected, "lost": run.lost})
        failed += outcome.startswith("FAILED")
        say(lines[-1], err=as_json)
    if as_json:
        answer({"recording": source.name, "frames": max_frames, "faults": rows}, "", as_json=True)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text("\n".join(lines) + "\n", encoding="utf-8")
    if failed:
        say(f"dudmap: {failed} of {len(lines) - 1} streams failed; see the column outcome", err=True)
        raise typer.Exit(1)


@app.command()
def gate(
    figures: Annotated[Path, Option(help="File of recorded figures and margins.")] = Path("tests/gate.toml"),
    fixtures: Annotated[Path, Option(help="Folder with the real excerpt freiburg1_xyz.")] = Path("tests/fixtures"),
    update: Annotated[bool, Option("--update", help="Record the measured figures; margins are kept.")] = False,
    assignments: o.SetOption = None,
    as_json: o.JsonOption = False,
) -> None:
    """Fail if accuracy on a small fixed set of recordings is worse than recorded."""
    from dudmap.lab.benchmark import gate as gates

    old = gates.load_figures(figures) if figures.is_file() or not update else None
    rows = gates.measure_gate(gates.gate_entries(fixtures), o.read_config(None, None, assignments))
    if update:
        gates.save_figures(figures, rows, old["margins"] if old else None)
        text = f"recorded in {figures}; review the difference before committing it"
        answer({"recorded": figures, "rows": rows}, text, as_json=as_json)
        return
    assert old is not None
    checks = gates.compare(rows, old)
    failed = sum(not check["passed"] for check in checks)
    tree = {"failed": failed, "checks": checks}
    answer(tree, gates.verdict(checks), as_json=as_json)
    if failed:
        say(f"dudmap: {failed} of {len(checks)} figures are worse than recorded in {figures}", err=True)
        raise typer.Exit(1)


@app.command()
def texture(
    run: o.RunArgument,
    size: Annotated[int, Option("--texture-size", help="Width of the texture.", metavar="PIXELS")] = 4096,
    max_triangles: Annotated[int | None, Option(min=4, help="Most triangles of the mesh.", metavar="N")] = None,
    sheet: Annotated[
        Path | None, Option(help="Picture (.png): recorded image, texture, vertex colours.", metavar="FILE")
    ] = None,
    sequence: Annotated[
        Path | None, Option(help="The recording of the run; default: its own.", metavar="SEQUENCE")
    ] = None,
    as_json: o.JsonOption = False,
) -> None:
    """Compare images that a texture was not made from with renderings of the texture and of vertex colours."""
    from dataclasses import asdict

    from dudmap.io.exporting.run_content import ExportOptions, RunContent
    from dudmap.lab.benchmark.texture import measure_texture

    options = ExportOptions(texture=size, max_triangles=max_triangles, sequence=sequence)
    found = measure_texture(RunContent.load(run), options, sheet)
    text = (
        f"PSNR over {found.views} held-out views: texture {found.texture_db:.2f} dB, vertex colours "
        f"{found.vertices_db:.2f} dB; {found.seen:.0%} of the texels were seen"
    )
    answer(asdict(found), text, as_json=as_json)


@app.command()
@o.grouped
def consistency(
    reading: o.ReadingOptions,
    recording: Annotated[Path, Argument(help="Recording.")],
    trajectories: Annotated[
        list[Path] | None, Argument(help="Trajectories of it in TUM text, or folders of runs.")
    ] = None,
    calibration: Annotated[
        Path | None,
        Option(metavar="FILE", help="calibration.toml for poses outside of run folders; default: the recording's."),
    ] = None,
    max_frames: Annotated[int | None, Option(min=2, help="Number of frames from the start.")] = None,
    as_json: o.JsonOption = False,
) -> None:
    """Compare how well trajectories, and the published poses, explain a recording's own depth and intensities.

    Each run is judged with the calibration of its folder: rolling shutters, delays, vignetting.
    """
    from dudmap.core.geometry.calibration import Calibration
    from dudmap.core.geometry.trajectory import Trajectory
    from dudmap.errors import DatasetError
    from dudmap.io.exporting.run_content import RunContent
    from dudmap.lab.benchmark.consistency import measure_consistency

    source = reading.open(recording)
    runs = {str(path): RunContent.load(path) for path in trajectories or [] if path.is_dir()}
    found = {} if source.ground_truth is None else {"published": source.ground_truth}
    found |= {str(path): Trajectory.load(path) for path in trajectories or [] if not path.is_dir()}
    if not found and not runs:
        raise DatasetError(f"{recording} comes without poses; name the trajectories to compare, such as a run's folder")
    cameras = {} if calibration is None else dict.fromkeys(found, Calibration.load(calibration))
    found |= {name: run.trajectory for name, run in runs.items()}
    cameras |= {name: replace(run.calibration, depth_late=0.0) for name, run in runs.items() if run.calibration}
    result = measure_consistency(source, found, max_frames=max_frames, calibrations=cameras)
    low, high = result.intervals()
    answer(result._asdict() | {"means": result.means(), "low": low, "high": high}, result.table(), as_json=as_json)
