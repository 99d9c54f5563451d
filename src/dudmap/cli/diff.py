"""``dudmap diff``: list the changes between two visits to a place."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from dudmap.cli import options as o
from dudmap.cli.output import answer, free_folder


def diff(
    before: Annotated[Path, Argument(help="Run folder of the first visit.", metavar="BEFORE")],
    after: Annotated[Path, Argument(help="Run folder of the second visit.", metavar="AFTER")],
    out: Annotated[Path | None, Option(help="Folder; default: runs/<BEFORE>-<AFTER>-changes.")] = None,
    min_size: Annotated[float, Option(help="Edge of the smallest thing that is reported.", metavar="M")] = 0.1,
    quiet: o.QuietOption = False,
    as_json: o.JsonOption = False,
) -> None:
    """List things that appeared, disappeared, moved or got other colours between two runs of one place.

    Writes changes.json, changes/<id>.ply and report.html. A surface of one visit is a change if the other visit saw
    free space there, beyond noise and alignment. A surface that only one visit saw is unknown.
    """
    from dudmap.fleet.diff import diff_runs, summary

    folder = out or free_folder(Path("runs") / f"{before.name}-{after.name}-changes")
    found = diff_runs(before, after, folder, min_size)
    answer(found, f"{summary(found)}\nwritten to {folder}", as_json=as_json, quiet=quiet)
