"""``dudmap study``: designed experiments over configurations, the thesis' chapter 6, and a search that is judged."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dudmap.app.terminal import say
from dudmap.cli import options as o
from dudmap.cli.output import DefaultGroup, answer
from dudmap.extras import STUDY, need

if TYPE_CHECKING:
    from collections.abc import Callable

    from dudmap.lab.study.conduct import Progress
    from dudmap.lab.study.worker import Executor


app = typer.Typer(
    cls=DefaultGroup,
    add_completion=False,
    no_args_is_help=True,
    help="Run a designed experiment over configurations and analyse it: dudmap study DESIGN.toml, or a command below.",
)

OutOption = Annotated[Path | None, typer.Option("--out", help="Study folder; an interrupted study in it goes on.")]
JobsOption = Annotated[int, typer.Option("--jobs", min=0, help="Runs at a time; 0: one per core.", metavar="N")]
MaxRunsOption = Annotated[int, typer.Option("--max-runs", min=1, help="Refuse a design with more runs.")]
KeepOption = Annotated[bool, typer.Option("--keep", help="Keep trajectory, mesh and map of every run.")]
ClusterOption = Annotated[
    str,
    typer.Option("--cluster", metavar="ADDRESS", help="Ray cluster: auto or ray://HOST:PORT; default: this machine."),
]

PriceOption = Annotated[
    float,
    typer.Option("--cost-per-core-hour", min=0, help="Price of a core for one hour; the progress shows the cost."),
]


@app.command()
def run(
    design: Annotated[Path, typer.Argument(help="Design file (docs/study.md).")],
    out: OutOption = None,
    jobs: JobsOption = 0,
    max_runs: MaxRunsOption = 1000,
    keep: KeepOption = False,
    cluster: ClusterOption = "",
    cost_per_core_hour: PriceOption = 0.0,
    as_json: o.JsonOption = False,
) -> None:
    """Run the study of a design file; the word run may be left out."""
    from dudmap.lab.study.plan import load_plan
    from dudmap.lab.study.study import run_study

    need("study", "dudmap study", STUDY)
    plan = load_plan(design)
    out = out or Path("runs/study") / design.stem
    report = _shown_with(cost_per_core_hour)
    outcome = run_study(plan, out, _executor(jobs, cluster), max_runs=max_runs, keep=keep, report=report)
    answer({"outcome": outcome}, outcome, as_json=as_json, out=out)


@app.command()
def thesis(
    recordings: Annotated[
        list[Path] | None, typer.Argument(help="Recordings; default: a synthetic room with a walking person.")
    ] = None,
    table: Annotated[str, typer.Option(help="Table of chapter 6: 6.1, 6.2 or 6.3.")] = "6.1",
    max_frames: o.MaxFramesOption = None,
    published: Annotated[
        bool, typer.Option("--published", help="Analyse the printed values of table 6.1; nothing is run.")
    ] = False,
    out: OutOption = None,
    jobs: JobsOption = 0,
    max_runs: MaxRunsOption = 1000,
    keep: KeepOption = False,
    cluster: ClusterOption = "",
    cost_per_core_hour: PriceOption = 0.0,
    as_json: o.JsonOption = False,
) -> None:
    """Repeat the sensitivity study of the thesis (chapter 6)."""
    from dudmap.lab.study.study import published_report, run_study, thesis_plan

    need("study", "dudmap study", STUDY)
    if published:
        out = out or Path("runs/study/thesis-published")
        outcome = published_report(out)
    else:
        plan = thesis_plan(table, recordings or (), max_frames)
        out = out or Path("runs/study") / f"thesis-{table}"
        report = _shown_with(cost_per_core_hour)
        outcome = run_study(plan, out, _executor(jobs, cluster), max_runs=max_runs, keep=keep, report=report)
    answer({"outcome": outcome}, outcome, as_json=as_json, out=out)


@app.command()
def tune(
    design: Annotated[Path, typer.Argument(help="Design file with a second set of recordings (judge).")],
    out: OutOption = None,
    jobs: JobsOption = 0,
    max_runs: MaxRunsOption = 1000,
    cluster: ClusterOption = "",
    cost_per_core_hour: PriceOption = 0.0,
    as_json: o.JsonOption = False,
) -> None:
    """Search for a configuration on the recordings of a design file, and judge it on others it never saw."""
    from dudmap.lab.study.plan import load_plan
    from dudmap.lab.study.tune import run_tune

    need("study", "dudmap study", STUDY)
    plan = load_plan(design)
    out = out or Path("runs/study") / f"{design.stem}-tune"
    report = _shown_with(cost_per_core_hour)
    outcome = run_tune(plan, out, _executor(jobs, cluster), max_runs=max_runs, report=report)
    answer({"outcome": outcome}, outcome, as_json=as_json, out=out)


def _executor(jobs: int, cluster: str) -> "Executor":
    if cluster:
        from dudmap.lab.study.cluster import RayExecutor

        return RayExecutor(cluster, jobs or None)
    from dudmap.lab.study.worker import LocalExecutor, usable_cores

    return LocalExecutor(jobs or usable_cores())


def _shown_with(price: float) -> "Callable[[Progress], None]":
    """Function that shows the progress with its cost at a price per core-hour."""
    return lambda progress: say(progress.describe(price), err=True)
