"""``dudmap report``: one offline page on a run."""

from pathlib import Path
from typing import Annotated

from typer import Option

from dudmap.cli import options as o
from dudmap.cli.output import answer


def report(
    run: o.RunArgument,
    out: Annotated[Path | None, Option(help="HTML file; default: report.html in the run folder.")] = None,
    as_json: o.JsonOption = False,
) -> None:
    """Write report.html: map and trajectory in 3D, images, masks, plots, metrics, configuration, lost frames.

    The page is one file and loads nothing, so that it can be sent by mail and opened offline.
    """
    from dudmap.app.viewing.report import write_report

    path = write_report(run, out)
    size = path.stat().st_size
    answer({"report": path, "bytes": size}, f"written: {path} ({1e-6 * size:.1f} MB)", as_json=as_json)
