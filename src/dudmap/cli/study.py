"""``dudmap study``: designed experiments over configurations, the thesis' chapter 6, and a validated search."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from dudmap.app.terminal import counted
from dudmap.cli import options as o
from dudmap.cli.output import DefaultGroup, answer
from dudmap.extras import STUDY, need

if TYPE_CHECKING:
    from collections.abc import Sequence

    from dudmap.lab.benchmark.measure import Row
    from dudmap.lab.study.plan import Plan, Run

app = typer.Typer(
    cls=DefaultGroup,
    add_completion=False,
    no_args_is_help=True,
    help="Run a designed experiment over configurations and analyse it: dudmap study DESIGN.toml, or a command below.",
)


@dataclass(frozen=True)
class SearchOptions:
    """Options of all studies: results folder and execution of the runs."""

    out: Annotated[Path | None, Option("--out", help="Study folder; an interrupted study in it continues.")] = None
    jobs: Annotated[int, Option("--jobs", min=0, help="Runs at a time; 0: one per core.", metavar="N")] = 0
    max_runs: Annotated[int, Option("--max-runs", min=1, help="Refuse a design with more runs.")] = 1000
    as_json: o.JsonOption = False

    def conduct(self, runs: "Sequence[Run]", out: Path, *, keep: bool = False) -> "list[Row]":
        """Do runs in a study folder."""
        from dudmap.app.pipeline.environment import machine
        from dudmap.lab.study.runs import conduct

        with counted("runs", quiet=self.as_json) as progress:
            return conduct(runs, out, self.jobs or machine()["cores_usable"], keep=keep, progress=progress)

    def answer(self, outcome: str, out: Path) -> None:
        """Print the outcome and the study folder."""
        answer({"outcome": outcome}, outcome, as_json=self.as_json, out=out)


@dataclass(frozen=True)
class StudyOptions(SearchOptions):
    """Options of a study whose runs may be kept."""

    keep: Annotated[bool, Option("--keep", help="Keep trajectory, mesh and map of every run.")] = False

    def run(self, plan: "Plan", out: Path) -> None:
        """Run a study."""
        from dudmap.lab.study.study import run_study

        self.answer(run_study(plan, out, partial(self.conduct, out=out, keep=self.keep), self.max_runs), out)


@app.command()
@o.grouped
def run(options: StudyOptions, design: Annotated[Path, Argument(help="Design file (docs/study.md).")]) -> None:
    """Run the study of a design file; the word run may be left out."""
    from dudmap.lab.study.plan import load_plan

    need("study", "dudmap study", STUDY)
    options.run(load_plan(design), options.out or Path("runs/study") / design.stem)


@app.command()
@o.grouped
def thesis(
    options: StudyOptions,
    recordings: Annotated[
        list[Path] | None, Argument(help="Recordings; default: a synthetic room with a walking person.")
    ] = None,
    table: Annotated[str, Option(help="Table 4.1, 4.2, 6.1, 6.2 or 6.3.")] = "6.1",
    figure: Annotated[str | None, Option(help="Figure 4.5: the similarity threshold.")] = None,
    max_frames: o.MaxFramesOption = None,
    published: Annotated[
        bool, Option("--published", help="Analyse the printed values of table 6.1; nothing is run.")
    ] = False,
) -> None:
    """Repeat a study of the thesis (chapters 4 and 6) with its system."""
    from dudmap.lab.study.study import published_report, thesis_plan

    need("study", "dudmap study", STUDY)
    if published:
        out = options.out or Path("runs/study/thesis-published")
        options.answer(published_report(out), out)
    else:
        name = table if figure is None else f"figure {figure}"
        plan = thesis_plan(name, recordings or (), max_frames)
        options.run(plan, options.out or Path("runs/study") / f"thesis-{name.replace(' ', '-')}")


@app.command()
@o.grouped
def tune(
    options: SearchOptions,
    design: Annotated[Path, Argument(help="Design file with a second set of recordings (judge).")],
) -> None:
    """Search for a configuration on the recordings of a design file, and judge it on other recordings."""
    from dudmap.lab.study.plan import load_plan
    from dudmap.lab.study.tune import run_tune

    need("study", "dudmap study", STUDY)
    plan, out = load_plan(design), options.out or Path("runs/study") / f"{design.stem}-tune"
    options.answer(run_tune(plan, out, partial(options.conduct, out=out), options.max_runs), out)
