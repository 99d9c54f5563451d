"""``dudmap benchmark``: suites of recordings, the accuracy gate, the limit of dynamics, and speed."""

from pathlib import Path
from typing import Annotated, Any

import typer

from dudmap.benchmark.suites import SUITES

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    help="Run a suite of recordings and print one table; check against recorded figures; find the limit of dynamics.",
)

SystemsOption = Annotated[
    str,
    typer.Option(
        "--systems", help="Comma-separated: dudmap, thesis, threshold, none, em, or paths of .toml configurations."
    ),
]
JobsOption = Annotated[int, typer.Option("--jobs", min=1, help="Runs at a time; times per frame mean most with 1.")]
QuickOption = Annotated[bool, typer.Option("--quick", help="Less of everything, to see that it works.")]


def suite_command(
    context: typer.Context,
    systems: SystemsOption = "dudmap",
    out: Annotated[Path | None, typer.Option("--out", help="Default: runs/benchmark/<suite>.")] = None,
    data: Annotated[
        Path | None, typer.Option("--data", help="Folder that holds the recordings; nothing is downloaded.")
    ] = None,
    jobs: JobsOption = 1,
    quick: QuickOption = False,
    score: Annotated[
        list[str] | None,
        typer.Option(
            "--score",
            metavar="NAME=FOLDER",
            help="Score what another system computed: FOLDER/<sequence>/trajectory.txt and mesh.ply; may be repeated.",
        ),
    ] = None,
) -> None:
    """Measure every recording of the suite; write Markdown, CSV and JSON."""
    from dudmap.benchmark.report import named_folders, run_suite
    from dudmap.benchmark.suites import find_suite
    from dudmap.benchmark.systems import systems as find_systems

    name = str(context.info_name)
    wanted, others = find_systems(systems), named_folders(score or [])
    suite = find_suite(name, data, quick=quick)
    out = out or Path("runs/benchmark") / name
    typer.echo(run_suite(suite, wanted, others, out, workers=jobs, done=_say))
    typer.echo(f"written to {out}")


for _name, _help in SUITES.items():
    app.command(_name, help=_help)(suite_command)


def _say(row: dict[str, Any]) -> None:
    outcome = row.get("error") or f"{row.get('tracked', row.get('frames'))} of {row.get('frames')} frames"
    typer.echo(f"{row['sequence']}, {row['system']}: {outcome}", err=True)


@app.command()
def gate(
    figures: Annotated[
        Path, typer.Option("--figures", help="The reviewed file of recorded figures and margins.")
    ] = Path("tests/gate.toml"),
    fixtures: Annotated[
        Path, typer.Option("--fixtures", help="Folder that holds the real excerpt freiburg1_xyz.")
    ] = Path("tests/fixtures"),
    record: Annotated[
        bool, typer.Option("--record", help="Rewrite the figures with what is measured now; margins stay.")
    ] = False,
    assignments: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change a parameter; may be repeated.")
    ] = None,
) -> None:
    """Fail if accuracy on a small fixed set of recordings is worse than recorded."""
    from dudmap.benchmark import gate as gates
    from dudmap.config import Config

    old = gates.load_figures(figures) if figures.is_file() or not record else None
    rows = gates.measure_gate(gates.gate_entries(fixtures), Config().override(assignments or []))
    if record:
        gates.save_figures(figures, rows, old["margins"] if old else None)
        typer.echo(f"recorded in {figures}; review the difference before committing it")
        return
    assert old is not None
    checks = gates.compare(rows, old)
    typer.echo(gates.verdict(checks))
    failed = sum(not check.passed for check in checks)
    if failed:
        typer.echo(f"dudmap: {failed} of {len(checks)} figures are worse than recorded in {figures}", err=True)
        raise typer.Exit(1)


@app.command()
def limits(
    systems: SystemsOption = "dudmap,none,threshold,em",
    out: Annotated[Path, typer.Option("--out", help="Folder for heat maps and figures.")] = Path(
        "runs/benchmark/limits"
    ),
    jobs: JobsOption = 1,
    quick: QuickOption = False,
) -> None:
    """Find how much may move, how fast and from when on, before tracking and mapping break down.

    Writes heat maps (PNG) of ATE, mask IoU, ghost area and the share of frames lost, and limits.md, .csv and .json.
    What the same code has measured before into the same folder is not measured again: a run that was stopped goes on.
    """
    from dudmap.benchmark import limits as sweeping
    from dudmap.benchmark.heatmaps import cells_table, limits_table, save_heat_maps
    from dudmap.benchmark.systems import systems as find_systems
    from dudmap.benchmark.table import save
    from dudmap.pipeline.environment import machine, versions

    wanted = find_systems(systems)
    sweeps = sweeping.QUICK_SWEEPS if quick else sweeping.SWEEPS
    cells = sweeping.grid_cells(sweeps, sweeping.QUICK_FRAMES if quick else sweeping.FRAMES)
    with typer.progressbar(length=len({cell.condition for cell in cells}), label="conditions") as bar:
        rows = sweeping.measure_cells(cells, wanted, out / "measured", jobs, bar.update)
    for sweep in sweeps:
        save_heat_maps(rows, sweep, list(wanted), out / f"limits-{sweep.name}.png")
    text = "Largest share of the image that may move, ATE RMSE at most 2 cm and no frame lost:\n"
    text += limits_table(rows, sweeps, list(wanted))
    text += "\nATE RMSE in cm, and the share of frames lost; bold: the system copes:\n"
    text += cells_table(rows, sweeps, list(wanted))
    save(rows, text, out, "limits", {"machine": machine(), "versions": versions()})
    typer.echo(text)
    typer.echo(f"written to {out}")


@app.command()
def speed(
    out: Annotated[Path, typer.Option("--out", help="Folder for speed.md and speed.json.")] = Path(
        "runs/benchmark/speed"
    ),
    long: Annotated[
        bool, typer.Option("--long", help="Also walk through new space for 2000 frames: does the time grow?")
    ] = False,
    open3d: Annotated[
        Path | None,
        typer.Option(
            "--open3d", metavar="PYTHON", help="A Python that has open3d, to time its dense SLAM beside ours."
        ),
    ] = None,
    recording: Annotated[
        Path | None, typer.Option("--recording", help="Recording for that comparison; default: a synthetic room.")
    ] = None,
    quick: QuickOption = False,
) -> None:
    """Measure time and memory on this machine; leave it alone meanwhile."""
    import json

    from dudmap.benchmark import speed as timing
    from dudmap.benchmark.interleaved import find_open3d
    from dudmap.pipeline.environment import machine, versions

    frames, long_frames = (20, 60) if quick else (300, 2000)
    figures = timing.speed_figures(
        frames,
        long_frames if long else 0,
        lambda what: typer.echo(f"measuring {what}", err=True),
        find_open3d(open3d),
        recording,
    )
    text = timing.markdown(figures)
    out.mkdir(parents=True, exist_ok=True)
    (out / "speed.md").write_text(text, encoding="utf-8")
    content = {"machine": machine(), "versions": versions(), "figures": [figure._asdict() for figure in figures]}
    (out / "speed.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    typer.echo(text)
    typer.echo(f"written to {out}")
