"""``dudmap live``: process the frames of a camera while they arrive."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from dudmap.app.terminal import show_log
from dudmap.cli import options as o
from dudmap.cli.output import free_folder, print_report
from dudmap.cli.run import for_range, run_parameters
from dudmap.cli.view import observers


def live(
    parameters: o.ParameterOptions,
    mapped: o.MapOptions,
    watching: o.WatchingOptions,
    camera: Annotated[
        str | None,
        Argument(
            help="realsense, oak, orbbec, iphone, replay:PATH (a recording at its own rate), or realsense:FILE "
            "(a recording of the driver); default: the first camera that is connected.",
            metavar="CAMERA",
            autocompletion=o.camera_names,
        ),
    ] = None,
    ignore: o.IgnoreOption = None,
    max_frames: o.MaxFramesOption = None,
    record: Annotated[Path | None, Option(help="MCAP file for all frames that arrive.", metavar="FILE.mcap")] = None,
    out: Annotated[Path | None, Option(help="Run folder; default: runs/<camera>.")] = None,
    save_masks: o.SaveMasksOption = False,
    save_images: o.SaveImagesOption = False,
    quiet: o.QuietOption = False,
    as_json: o.JsonOption = False,
    calibration: Annotated[
        Path | None,
        Option(help="calibration.toml of an earlier run with this camera; default: its own.", metavar="FILE"),
    ] = None,
) -> None:
    """Estimate the trajectory and a mesh of the static scene while a camera moves; Ctrl-C ends and writes the results.

    Frames wait for at most 0.1 s; later ones are dropped and counted, but recorded with --record.
    """
    from dudmap.app.pipeline.image_keeper import ImageKeeper
    from dudmap.app.pipeline.run import PREVIEW, run
    from dudmap.core.geometry.calibration import Calibration
    from dudmap.io.cameras import open_camera
    from dudmap.lab.warmup import compiled_during_run

    show_log(quiet=quiet, verbose=watching.verbose)
    config, saved_map = run_parameters(parameters, mapped, out)
    given = None if calibration is None else Calibration.load(calibration)
    source = open_camera(camera)
    config = for_range(config, parameters, mapped, source.preview(PREVIEW))
    with observers(watching) as watchers, compiled_during_run(live=True):
        watchers += (ImageKeeper(source),) if save_images else ()
        done = run(
            source, config, out or free_folder(Path("runs") / source.name),
            max_frames=max_frames, save_masks=save_masks or save_images, ignore=ignore, record=record,
            calibration=given, progress=not quiet, saved_map=saved_map, localize=mapped.localize,
            max_memory=o.memory_size(mapped.max_memory), observers=watchers,
        )  # fmt: skip
        print_report(done.metrics, done.out, quiet=quiet, as_json=as_json)
