"""``dudmap merge``: join the maps of two runs of one place."""

from pathlib import Path
from typing import Annotated

import typer

from dudmap.cli.output import JsonOption, answer
from dudmap.cli.run import QuietOption, free_folder

app = typer.Typer(add_completion=False)


@app.command()
def merge(
    first: Annotated[Path, typer.Argument(help="Run folder; its world frame is kept.", metavar="A")],
    second: Annotated[Path, typer.Argument(help="Run folder of the same place.", metavar="B")],
    out: Annotated[Path | None, typer.Option("--out", help="New run folder; default: runs/<A>-<B>.")] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Join two maps whose views overlap, and refuse where geometry or colour disagree.

    Writes map.npz, keyframes.npz, mesh.ply, config.toml, merge.json and the trajectories of both runs in the world
    frame of the first.
    """
    from dudmap.pipeline.merge import merge_runs

    report = merge_runs(first, second, out or free_folder(Path("runs") / f"{first.name}-{second.name}"))
    found = report.tree
    text = (
        f"merged by {found['features']} features of {found['keyframes']} keyframes: {found['area']:.1f} m2 of "
        f"common surface, {found['denied']:.1%} denied by free space, colour correlation "
        f"{found['color_correlation']:.2f}\nwritten to {report.out}"
    )
    answer(found, text, as_json=as_json, quiet=quiet)
