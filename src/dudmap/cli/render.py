"""``dudmap render``: the map of a run seen along a trajectory."""

import re
from pathlib import Path
from typing import Annotated

import typer

from dudmap.cli.export import UpOption, direction
from dudmap.cli.output import JsonOption, answer
from dudmap.cli.run import QuietOption
from dudmap.errors import ConfigError

app = typer.Typer(add_completion=False)


@app.command()
def render(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    out: Annotated[Path, typer.Option("--out", help="Video (.mp4, .avi), or folder for a recording in TUM layout.")],
    trajectory: Annotated[
        Path | None, typer.Option("--trajectory", help="Camera poses in TUM format, in the world of the run.")
    ] = None,
    orbit: Annotated[bool, typer.Option("--orbit", help="A camera that circles about the middle of the map.")] = False,
    sweep: Annotated[
        float, typer.Option("--sweep", min=0, max=360, help="Width of the orbit; 360 for a circle.", metavar="DEGREES")
    ] = 60.0,
    frames: Annotated[int, typer.Option("--frames", min=1, help="Number of frames of the orbit.")] = 120,
    fps: Annotated[float, typer.Option("--fps", min=0.1, help="Frames per second.")] = 30.0,
    size: Annotated[str | None, typer.Option("--size", help="Image size in pixels.", metavar="WxH")] = None,
    up: UpOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Render the map as a camera would see it: a video, or a recording without anything that moves."""
    from dudmap.app.views import rendering
    from dudmap.cli.progress import counted
    from dudmap.core.geometry.trajectory import Trajectory
    from dudmap.io.exporting.gravity import up_of
    from dudmap.io.exporting.options import ExportOptions
    from dudmap.io.exporting.run_content import RunContent

    if (trajectory is None) == (not orbit):
        raise ConfigError("name either a --trajectory or --orbit")
    content = RunContent.load(run)
    if trajectory is not None:
        path = Trajectory.load(trajectory)
    else:
        path = rendering.orbit(content, up_of(content, ExportOptions(up=direction(up))), sweep, frames, fps)
    with counted("rendering", quiet=quiet or as_json) as progress:
        count = rendering.render_run(content, path, out, size=_size(size), fps=fps, progress=progress)
    answer({"frames": count, "out": out}, f"{count} frames written to {out}", as_json=as_json, quiet=quiet)


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    match = re.fullmatch(r"(\d+)[xX](\d+)", text.strip())
    if match is None or not all(16 <= int(number) <= 4096 for number in match.groups()):
        raise ConfigError(f"image size is {text!r}; expected WIDTHxHEIGHT from 16x16 to 4096x4096, such as 640x480")
    return int(match[1]), int(match[2])
