"""``dudmap run``: process a recording into a run folder."""

import logging
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from dudmap.app.terminal import show_log
from dudmap.cli import options as o
from dudmap.cli.output import free_folder, print_report
from dudmap.cli.view import observers
from dudmap.errors import ConfigError

if TYPE_CHECKING:
    from dudmap.config import Config
    from dudmap.core.frames.frame import Frame
    from dudmap.core.places.saved_map import SavedMap

log = logging.getLogger(__name__)


def run(
    reading: o.ReadingOptions,
    parameters: o.ParameterOptions,
    mapped: o.MapOptions,
    watching: o.WatchingOptions,
    sequence: Annotated[
        Path | None,
        Argument(help="Recording: folder, file or archive; `dudmap info` describes it.", metavar="SEQUENCE"),
    ] = None,
    masks: Annotated[
        Path | None,
        Option(help="Folder of dynamic masks, named like the images or by time, 255 = dynamic.", metavar="FOLDER"),
    ] = None,
    poses: Annotated[
        str | None,
        Option(
            help="Fuse the frames at known poses, without registration: a file (TUM, EuRoC, KITTI or 4x4), a folder "
            "with one 4x4 file per frame, or 'recording' for the recording's own poses.",
            metavar="FILE|recording",
        ),
    ] = None,
    refine: Annotated[bool, Option("--refine", help="Start the registration from --poses, which may drift.")] = False,
    poses_as: Annotated[
        str | None,
        Option(
            help="Convention of --poses, if not camera-to-world, x right, y down, z forward: tum, euroc, kitti, "
            "world-to-camera, opengl, ros, wxyz, millimetres.",
            metavar="NAMES",
        ),
    ] = None,
    ignore: o.IgnoreOption = None,
    max_frames: o.MaxFramesOption = None,
    out: Annotated[Path | None, Option(help="Run folder; default: runs/<recording>.")] = None,
    save_masks: o.SaveMasksOption = True,
    save_images: o.SaveImagesOption = False,
    quiet: o.QuietOption = False,
    as_json: o.JsonOption = False,
    watch: Annotated[
        bool, Option("--watch", help="Report changes against --map during the run (changes.jsonl).")
    ] = False,
    passes: o.PassesOption = 1,
    calibration: Annotated[
        str,
        Option(
            help="Calibration of the colour camera: auto estimates it from the first ten seconds (during a live "
            "replay); given takes the recording's; or a calibration.toml of another run or of calibrate.",
            metavar="auto|given|FILE",
        ),
    ] = "auto",
    live: Annotated[
        bool, Option("--live", help="Replay in real time; frames are dropped if processing is too slow.")
    ] = False,
    resume: Annotated[
        Path | None,
        Option(help="Continue the interrupted run in this folder; alone or with --device.", metavar="RUN"),
    ] = None,
    checkpoint_every: Annotated[
        float | None,
        Option(
            help="Seconds between checkpoints; 0 for none. Default: as often as 2 % of the time allows.",
            min=0,
            metavar="SECONDS",
        ),
    ] = None,
) -> None:
    """Estimate the trajectory and a mesh of the static scene from a recording.

    Writes trajectory.txt, mesh.ply, map.npz, keyframes.npz, config.toml, metrics.json, timings.csv and report.html
    into the run folder; with --set movers.meshes=true also movers/<id>.ply and <id>.txt, mesh and poses of every rigid
    moving object.
    """
    from dudmap.app.pipeline.given_poses import checked_options, given_poses
    from dudmap.app.pipeline.image_keeper import FOLDER, ImageKeeper
    from dudmap.app.pipeline.inspection import inspect, sample
    from dudmap.app.pipeline.resume import resume as resume_run
    from dudmap.app.pipeline.run import run as run_sequence
    from dudmap.app.pipeline.storing import Storing
    from dudmap.core.geometry.calibration import Calibration
    from dudmap.lab.warmup import compiled_during_run

    show_log(quiet=quiet, verbose=watching.verbose)
    if resume is not None:
        if sequence is not None or out is not None:
            raise typer.BadParameter("--resume continues a run with its own options; leave out the recording and --out")
        with observers(replace(watching, report=False)) as watchers:
            watchers += (ImageKeeper(None),) if (resume / FOLDER).is_dir() else ()
            done = resume_run(resume, device=mapped.device, progress=not quiet, observers=watchers)
            print_report(done.metrics, done.out, quiet=quiet, as_json=as_json)
        return
    if sequence is None:
        raise typer.BadParameter("name a recording, or a run folder to continue (--resume RUN)")
    checked_options(has_poses=poses is not None, refine=refine, saved_map=mapped.saved is not None)
    config, saved_map = run_parameters(parameters, mapped, out)
    recording = reading.open(sequence)
    frames, unreadable = sample(recording)
    config = for_range(config, parameters, mapped, [frame for _, frame in frames])
    warnings = inspect(recording, frames, unreadable, config).warnings
    for warning in warnings:
        log.warning(warning)
    out = out or free_folder(Path("runs") / recording.name)
    given = None if calibration in ("auto", "given") else Calibration.load(Path(calibration))
    ours = config.system == "dudmap"
    if ours and (calibration != "auto" or not live):  # no second estimation of a calibration
        config = config.override(["sensor.self_calibration=false"])
    given_by = None if poses is None else given_poses(poses, recording, poses_as, refine=refine)
    storing = (
        None
        if live or checkpoint_every == 0 or not ours
        else Storing(recording.opened, checkpoint_every, watching.report)
    )
    if watch and mapped.saved is None:
        raise typer.BadParameter("--watch compares with the map of an earlier visit; name it with --map RUN")
    with observers(watching) as watchers, compiled_during_run(live=live):
        watchers += (ImageKeeper(recording),) if save_images else ()
        if watch and mapped.saved is not None:
            from dudmap.core.places.saved_map import SavedMap
            from dudmap.fleet.change_watch import ChangeWatch

            watchers += (ChangeWatch(SavedMap.load(mapped.saved), watchers),)
        done = run_sequence(
            recording, config, out,
            max_frames=max_frames, save_masks=save_masks, masks=masks, ignore=ignore, poses=given_by,
            progress=not quiet, live=live, passes=passes, calibration=given,
            calibrate=calibration == "auto" and not live and ours, saved_map=saved_map, localize=mapped.localize,
            max_memory=o.memory_size(mapped.max_memory), observers=watchers, storing=storing, warnings=warnings,
        )  # fmt: skip
        print_report(done.metrics, done.out, quiet=quiet, as_json=as_json)


def run_parameters(
    parameters: o.ParameterOptions, mapped: o.MapOptions, out: Path | None
) -> "tuple[Config, SavedMap | None]":
    """Configuration (default: the saved map's) and saved map of a run."""
    from dudmap.core.backends.device import resolve
    from dudmap.core.places.saved_map import SavedMap

    saved, config = mapped.saved, _config(parameters, mapped)
    resolve(config.device, adaptive=config.volume.adaptive)  # refused before anything takes time
    if saved is None:
        return config, None
    if out is not None and out.resolve() == saved.resolve():
        raise ConfigError(
            f"the map to go on in lies in the run folder {out}, which is emptied; name another with --out"
        )
    if not config.relocalization.enabled:
        raise ConfigError("the camera is found in a saved map by relocalisation; drop relocalization.enabled=false")
    return config, SavedMap.load(saved, config.volume.voxel_size)


def for_range(
    config: "Config", parameters: o.ParameterOptions, mapped: o.MapOptions, frames: "list[Frame]"
) -> "Config":
    """Configuration for the given range, or the frames'; prints a chosen range."""
    chosen = _config(parameters, mapped, frames)
    if chosen != config:
        log.info("%s, chosen from the depth images; --range room keeps the defaults of a room", chosen.range_text)
    return chosen


def _config(parameters: o.ParameterOptions, mapped: o.MapOptions, frames: "Iterable[Frame]" = ()) -> "Config":
    saved = mapped.saved
    if saved is not None and parameters.config is parameters.system is None and (saved / "config.toml").is_file():
        parameters = replace(parameters, config=saved / "config.toml")
    return parameters.read(*([f"device={mapped.device}"] if mapped.device else []), seen=frames)
