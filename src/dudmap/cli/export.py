"""``dudmap export``: results of a run in the format of another program."""

from pathlib import Path
from typing import Annotated

import typer

from dudmap.cli.run import QuietOption
from dudmap.exporting.exporters import EXPORTERS

app = typer.Typer(add_completion=False)
_ENDINGS = "; ".join(f"{ending}: {exporter.summary}" for ending, exporter in EXPORTERS.items())


@app.command()
def export(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    to: Annotated[Path, typer.Option("--to", help=f"File to write; its ending names the format. {_ENDINGS}.")],
    quiet: QuietOption = False,
) -> None:
    """Write trajectory, surface and moving objects of a run for another program."""
    from dudmap.exporting.exporters import export_run

    path = export_run(run, to)
    if not quiet:
        typer.echo(f"written to {path}")
