"""``dudmap live``: process the frames of a camera while they arrive."""

from pathlib import Path
from typing import Annotated

import typer

from dudmap.cli import options as o
from dudmap.cli.output import free_folder, print_report
from dudmap.cli.run import run_parameters
from dudmap.cli.view import observers

app = typer.Typer(add_completion=False)


@app.command()
def live(
    camera: Annotated[
        str | None,
        typer.Option(
            help="realsense, oak, orbbec, iphone, openni, replay:PATH (a recording at its own rate), or realsense:FILE "
            "(a recording of the driver); default: the first camera that is connected.",
            metavar="NAME",
            autocompletion=o.camera_names,
        ),
    ] = None,
    max_frames: o.MaxFramesOption = None,
    record: Annotated[
        Path | None, o.output_option(help="MCAP file for all frames that arrive.", metavar="FILE.mcap")
    ] = None,
    out: Annotated[Path | None, o.output_option(help="Run folder; default: runs/<camera>.", metavar="FOLDER")] = None,
    save_masks: o.SaveMasksOption = False,
    report: o.ReportOption = True,
    rerun: o.RerunOption = None,
    log: o.LogOption = None,
    quiet: o.QuietOption = False,
    as_json: o.JsonOption = False,
    saved: o.MapOption = None,
    localize: o.LocalizeOption = False,
    max_memory: o.MaxMemoryOption = None,
    calibration: Annotated[
        Path | None,
        o.calibration_option(
            help="calibration.toml of an earlier run with this camera; default: its own.", metavar="FILE"
        ),
    ] = None,
    view: o.ViewOption = False,
    host: o.HostOption = "127.0.0.1",
    port: o.PortOption = 8080,
    token: o.TokenOption = None,
    config: o.ConfigOption = None,
    preset: o.PresetOption = None,
    assignments: o.SetOption = None,
    device: o.DeviceOption = None,
) -> None:
    """Estimate the trajectory and a mesh of the static scene while a camera moves; Ctrl-C ends and writes the results.

    Frames wait for at most 0.1 s; those for which there is no time are counted as dropped, but recorded with --record.
    """
    from dudmap.app.pipeline.run import run
    from dudmap.core.geometry.calibration import Calibration
    from dudmap.io.cameras import open_camera

    parameters, saved_map = run_parameters(config, preset, assignments, device, saved, out)
    given = None if calibration is None else Calibration.load(calibration)
    source = open_camera(camera)
    with observers(report=report, page=(host, port, token) if view else None, rerun=rerun, log=log) as watching:
        done = run(
            source, parameters, out or free_folder(Path("runs") / source.name),
            max_frames=max_frames, save_masks=save_masks, record=record, calibration=given, progress=not quiet,
            saved_map=saved_map, localize=localize, max_memory=o.memory_size(max_memory), observers=watching,
        )  # fmt: skip
        print_report(done.metrics, done.out, quiet=quiet, as_json=as_json)
