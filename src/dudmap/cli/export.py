"""``dudmap export``: results of a run in the format of another program."""

from pathlib import Path
from typing import Annotated

import typer

from dudmap.cli.output import JsonOption, answer
from dudmap.cli.run import CameraOption, QuietOption
from dudmap.errors import ConfigError
from dudmap.io.exporting.exporters import EXPORTERS

app = typer.Typer(add_completion=False)
_NAMES = "; ".join(f"{name}: {exporter.summary}" for name, exporter in EXPORTERS.items())
UpOption = Annotated[
    str | None,
    typer.Option("--up", help="Direction against gravity in the world of the run, by default that of its floor.",
                 metavar="X,Y,Z"),
]  # fmt: skip


@app.command()
def export(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    to: Annotated[Path, typer.Option("--to", help=f"File to write; its ending or name tells the format. {_NAMES}.")],
    max_triangles: Annotated[
        int | None, typer.Option("--max-triangles", min=4, help="Decimate the mesh to so many triangles.")
    ] = None,
    crop: Annotated[
        str | None,
        typer.Option("--crop", help="Keep a box of the map, metres.", metavar="X0,Y0,Z0,X1,Y1,Z1"),
    ] = None,
    drop_pieces_below: Annotated[
        float | None,
        typer.Option("--drop-pieces-below", min=0, help="Leave out smaller connected pieces.", metavar="M2"),
    ] = None,
    fill_holes: Annotated[
        float | None, typer.Option("--fill-holes", min=0, help="Close holes with a shorter border.", metavar="METRES")
    ] = None,
    up: UpOption = None,
    resolution: Annotated[
        float, typer.Option("--resolution", min=0.001, help="Cells of grids.", metavar="METRES")
    ] = 0.05,
    heights: Annotated[
        str, typer.Option("--heights", help="Lower and upper end of the robot above the floor.", metavar="LOW,HIGH")
    ] = "0.1,1.8",
    sequence: Annotated[
        Path | None,
        typer.Option("--sequence", help="The recording of the run, for images and masks; default: the one it names."),
    ] = None,
    camera: CameraOption = None,
    every: Annotated[int, typer.Option("--every", min=1, help="Every so many frames of the recording.")] = 1,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write trajectory, surface, space or images of a run for another program."""
    from dudmap.io.exporting.exporters import export_run
    from dudmap.io.exporting.options import ExportOptions

    low, high = numbers(heights, 2, "--heights")
    options = ExportOptions(
        max_triangles=max_triangles,
        crop=None if crop is None else tuple(numbers(crop, 6, "--crop")),  # pyright: ignore[reportArgumentType]
        drop_pieces_below=drop_pieces_below,
        fill_holes=fill_holes,
        up=direction(up),
        resolution=resolution,
        heights=(low, high),
        sequence=sequence,
        camera=camera,
        every=every,
    )
    path = export_run(run, to, options)
    answer({"export": path, "bytes": path.stat().st_size}, f"written to {path}", as_json=as_json, quiet=quiet)


def direction(text: str | None) -> tuple[float, float, float] | None:
    """Direction of ``--up``."""
    if text is None:
        return None
    x, y, z = numbers(text, 3, "--up")
    return x, y, z


def numbers(text: str, count: int, option: str) -> list[float]:
    """Numbers of an option, separated by commas.

    Raises:
        ConfigError: They are not so many finite numbers.
    """
    from math import isfinite

    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if len(found) != count or not all(isfinite(number) for number in found):
        raise ConfigError(f"found {option} {text!r}; expected {count} numbers separated by commas")
    return found
