"""``dudmap export``: results of a run in the format of another program."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from typer import Option

from dudmap.app.terminal import say, show_log
from dudmap.cli import options as o
from dudmap.cli.output import answer
from dudmap.errors import NoImagesError
from dudmap.io.exporting.exporters import EXPORTERS
from dudmap.io.exporting.run_content import SPECK, ExportOptions

_NAMES = "; ".join(f"{name}: {exporter.summary}" for name, exporter in EXPORTERS.items())


def export(
    run: o.RunArgument,
    out: Annotated[Path, Option(help=f"File to write; its suffix or name selects the format. {_NAMES}.")],
    max_triangles: Annotated[
        int | None, Option(min=4, help="Decimate the mesh to so many triangles.", metavar="N")
    ] = None,
    crop: Annotated[str | None, Option(help="Keep a box of the map, metres.", metavar="X0,Y0,Z0,X1,Y1,Z1")] = None,
    drop_pieces_below: Annotated[
        float, Option(min=0, help="Leave out connected pieces with less surface; 0 keeps all.", metavar="M2")
    ] = SPECK,
    fill_holes: Annotated[
        float | None, Option(min=0, help="Close holes with a shorter border.", metavar="METRES")
    ] = None,
    texture: Annotated[
        bool,
        Option("--texture", help="Texture of .glb, .obj (with .mtl and .jpg) and .usdz from the images of the run."),
    ] = False,
    texture_size: Annotated[
        int | None, Option(help="Width of the texture, 64 to 8192; default: 4096. Implies --texture.", metavar="PIXELS")
    ] = None,
    up: o.UpOption = None,
    z_up: Annotated[bool, Option("--z-up", help="Turn surface or trajectory: z up from the floor.")] = False,
    resolution: Annotated[float, Option(min=0.001, help="Cells of grids.", metavar="METRES")] = 0.05,
    heights: Annotated[
        str, Option(help="Lower and upper end of the robot above the floor.", metavar="LOW,HIGH")
    ] = "0.1,1.8",
    sequence: Annotated[
        Path | None,
        Option(help="The recording of the run, for images and masks; default: the one it names.", metavar="SEQUENCE"),
    ] = None,
    camera: o.CameraOption = None,
    every: Annotated[int, Option(min=1, help="Use every N-th frame of the recording.", metavar="N")] = 1,
    quiet: o.QuietOption = False,
    as_json: o.JsonOption = False,
) -> None:
    """Write trajectory, surface, space or images of a run for another program."""
    from dudmap.io.exporting.exporters import export_run

    show_log(quiet=quiet)
    low, high = o.numbers(heights, 2, "--heights")
    options = ExportOptions(
        max_triangles=max_triangles,
        crop=None if crop is None else tuple(o.numbers(crop, 6, "--crop")),  # pyright: ignore[reportArgumentType]
        drop_pieces_below=drop_pieces_below,
        fill_holes=fill_holes,
        up=o.direction(up),
        z_up=z_up,
        resolution=resolution,
        heights=(low, high),
        sequence=sequence,
        camera=camera,
        every=every,
        texture=texture_size if texture_size is not None else 4096 if texture else None,
    )
    try:
        path = export_run(run, out, options)
    except NoImagesError as error:
        if options.texture is None:
            raise
        say(f"warning: {error}; the mesh is written with vertex colours", err=True)
        options = replace(options, texture=None, sequence=None, camera=None, every=1)
        path = export_run(run, out, options)
    tree = {"export": path, "bytes": path.stat().st_size, "texture": options.texture}
    answer(tree, f"written to {path} ({1e-6 * tree['bytes']:.1f} MB)", as_json=as_json, quiet=quiet)
