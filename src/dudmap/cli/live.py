"""``dudmap live``: process the frames of a camera while they arrive."""

from pathlib import Path
from typing import Annotated

import typer

from dudmap.cli.output import JsonOption, camera_names
from dudmap.cli.run import (
    ConfigOption,
    HostOption,
    LogOption,
    PortOption,
    PresetOption,
    QuietOption,
    ReportOption,
    RerunOption,
    SetOption,
    ViewOption,
    free_folder,
    print_report,
    read_config,
)
from dudmap.cli.view import TokenOption, observers

app = typer.Typer(add_completion=False)


@app.command()
def live(
    camera: Annotated[
        str | None,
        typer.Option(
            "--camera",
            help="realsense, oak, orbbec, iphone, openni, replay:PATH (a recording at its own rate), or realsense:FILE "
            "(a recording of the driver); default: the first camera that is connected.",
            metavar="NAME",
            autocompletion=camera_names,
        ),
    ] = None,
    record: Annotated[
        Path | None, typer.Option("--record", help="MCAP file for all frames that arrive.", metavar="FILE.mcap")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Run folder; default: runs/<camera>.")] = None,
    config: ConfigOption = None,
    assignments: SetOption = None,
    preset: PresetOption = None,
    calibration: Annotated[
        Path | None,
        typer.Option("--calibration", help="calibration.toml of an earlier run with this camera; default: its own."),
    ] = None,
    max_frames: Annotated[int | None, typer.Option("--max-frames", min=1, help="Stop after this many frames.")] = None,
    save_masks: Annotated[bool, typer.Option("--save-masks", help="Write the dynamic mask of every frame.")] = False,
    report: ReportOption = True,
    view: ViewOption = False,
    host: HostOption = "127.0.0.1",
    port: PortOption = 8080,
    token: TokenOption = None,
    rerun: RerunOption = None,
    log: LogOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate the trajectory and a mesh of the static scene while a camera moves; Ctrl-C ends and writes the results.

    Frames wait for at most 0.1 s; those for which there is no time are counted as dropped, but recorded with --record.
    """
    from dudmap.app.pipeline.live import run_live
    from dudmap.core.geometry.calibration import Calibration
    from dudmap.io.cameras import open_camera

    parameters = read_config(config, preset, assignments or [])
    given = None if calibration is None else Calibration.load(calibration)
    source = open_camera(camera)
    with observers(report=report, page=(host, port, token) if view else None, rerun=rerun, log=log) as watching:
        done = run_live(
            source, parameters, out or free_folder(Path("runs") / source.name),
            max_frames=max_frames, save_masks=save_masks, record=record, calibration=given, progress=not quiet,
            observers=watching,
        )  # fmt: skip
        print_report(done.metrics, done.out, quiet=quiet, as_json=as_json)
