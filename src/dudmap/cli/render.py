"""``dudmap render``: render the map of a run along a trajectory."""

from pathlib import Path
from typing import Annotated

from typer import Option

from dudmap.app.terminal import counted
from dudmap.cli import options as o
from dudmap.cli.output import answer
from dudmap.errors import ConfigError


def render(
    run: o.RunArgument,
    out: Annotated[Path, Option(help="Picture (.png), video (.mp4, .avi), or folder for a recording in TUM layout.")],
    trajectory: Annotated[
        Path | None, Option(help="Camera poses (TUM or EuRoC), in the world of the run.", metavar="FILE")
    ] = None,
    orbit: Annotated[bool, Option("--orbit", help="Circle the camera around the whole map.")] = False,
    sweep: Annotated[
        float, Option(min=0, max=360, help="Width of the orbit; 360 for a circle.", metavar="DEGREES")
    ] = 60.0,
    max_frames: o.FramesOption = 120,
    fps: o.RateOption = 30.0,
    size: Annotated[
        str | None,
        Option(help="Image size in pixels; default: 1280x720, along a trajectory the recording's.", metavar="WxH"),
    ] = None,
    up: o.UpOption = None,
    quiet: o.QuietOption = False,
    as_json: o.JsonOption = False,
) -> None:
    """Render the map as a picture, a video, or a recording of the static scene.

    A picture shows the first pose of the trajectory, or without one the whole map.
    """
    from dudmap.app.views import rendering
    from dudmap.core.geometry.trajectory import Trajectory
    from dudmap.io.exporting.run_content import ExportOptions, RunContent
    from dudmap.io.exporting.up import up_of

    picture = out.suffix.lower() == rendering.PICTURE
    orbit = orbit or (trajectory is None and picture)
    if (trajectory is None) == (not orbit):
        raise ConfigError("name either a --trajectory or --orbit")
    content = RunContent.load(run)
    pixels = None if size is None else o.image_size(size)
    own = content.volume.camera
    camera = rendering.wide_camera(own, pixels or rendering.SIZE) if orbit else own.resized(*pixels) if pixels else own
    with counted("rendering", quiet=quiet or as_json) as progress:
        if trajectory is not None:
            path = Trajectory.load(trajectory)
        else:
            upright = up_of(content, ExportOptions(up=o.direction(up)))
            path = rendering.orbit(content, upright, sweep, 1 if picture else max_frames, fps, camera)
        count = rendering.render_run(content, path, out, camera=camera, fps=fps, progress=progress, whole=orbit)
    answer(
        {"frames": count, "out": out},
        f"written to {out}" if picture else f"{count} frames written to {out}",
        as_json=as_json,
        quiet=quiet,
    )
