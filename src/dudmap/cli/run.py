"""``dudmap run``: process a recording into a run folder."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dudmap.app.terminal import say
from dudmap.cli import options as o
from dudmap.cli.output import free_folder, print_report
from dudmap.cli.view import observers
from dudmap.errors import ConfigError

if TYPE_CHECKING:
    from dudmap.config import Config
    from dudmap.core.places.saved_map import SavedMap

app = typer.Typer(add_completion=False)


@app.command()
def run(
    sequence: Annotated[
        Path | None, typer.Argument(help="Recording: folder, file or archive; `dudmap info` says what is found.")
    ] = None,
    camera: o.CameraOption = None,
    fps: o.FpsOption = None,
    depth_unit: o.DepthUnitOption = None,
    color: o.ColorOption = None,
    depth: o.DepthOption = None,
    topics: o.TopicsOption = None,
    masks: Annotated[
        Path | None,
        o.input_option(help="Folder of external dynamic masks, <timestamp>.png with 255 = dynamic.", metavar="FOLDER"),
    ] = None,
    max_frames: o.MaxFramesOption = None,
    out: Annotated[
        Path | None, o.output_option(help="Run folder; default: runs/<recording>.", metavar="FOLDER")
    ] = None,
    save_masks: o.SaveMasksOption = False,
    report: o.ReportOption = True,
    rerun: o.RerunOption = None,
    log: o.LogOption = None,
    quiet: o.QuietOption = False,
    as_json: o.JsonOption = False,
    saved: o.MapOption = None,
    localize: o.LocalizeOption = False,
    watch: Annotated[
        bool,
        o.map_option("--watch", help="Report what changed against --map as soon as it is certain (changes.jsonl)."),
    ] = False,
    passes: Annotated[
        int, o.map_option(min=1, max=2, help="2: second pass with the map of the first; removes ghosts.", metavar="1|2")
    ] = 1,
    max_memory: o.MaxMemoryOption = None,
    calibration: Annotated[
        str,
        o.calibration_option(
            help="Calibration of the colour camera: auto estimates it from the first ten seconds (a live replay while "
            "it runs); given takes what the recording says; or calibration.toml of another run or of calibrate.",
            metavar="auto|given|FILE",
        ),
    ] = "auto",
    live: Annotated[
        bool, o.live_option("--live", help="Replay in real time; frames are dropped where processing is too slow.")
    ] = False,
    view: o.ViewOption = False,
    host: o.HostOption = "127.0.0.1",
    port: o.PortOption = 8080,
    token: o.TokenOption = None,
    config: o.ConfigOption = None,
    preset: o.PresetOption = None,
    assignments: o.SetOption = None,
    device: o.DeviceOption = None,
    resume: Annotated[
        Path | None,
        o.advanced_option(help="Go on with the interrupted run in this folder; alone or with --device.", metavar="RUN"),
    ] = None,
    checkpoint_every: Annotated[
        float | None,
        o.advanced_option(
            help="Seconds from one checkpoint to the next; 0 for none. Default: as often as takes 2 % of the time.",
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
    from dudmap.app.pipeline.inspection import inspect
    from dudmap.app.pipeline.resume import resume as resume_run
    from dudmap.app.pipeline.run import run as run_sequence
    from dudmap.app.pipeline.storing import Storing
    from dudmap.core.geometry.calibration import Calibration
    from dudmap.io.sequences import open_sequence

    page = (host, port, token) if view else None
    if resume is not None:
        if sequence is not None or out is not None:
            raise typer.BadParameter("--resume goes on with a run as it was ordered; leave out the recording and --out")
        with observers(report=False, page=page, rerun=rerun, log=log) as watching:
            done = resume_run(resume, device=device, progress=not quiet, observers=watching)
            print_report(done.metrics, done.out, quiet=quiet, as_json=as_json)
        return
    if sequence is None:
        raise typer.BadParameter("name a recording, or a run folder to go on with (--resume RUN)")
    parameters, saved_map = run_parameters(config, preset, assignments, device, saved, out)
    recording = open_sequence(sequence, camera, fps, depth_unit, color=color, depth=depth, topics=topics)
    warnings = inspect(recording).warnings
    for warning in warnings:
        say(f"warning: {warning}", err=True)
    out = out or free_folder(Path("runs") / recording.name)
    given = None if calibration in ("auto", "given") else Calibration.load(Path(calibration))
    if calibration != "auto" or not live:  # what has been estimated beforehand is not estimated again
        parameters = parameters.override(["sensor.self_calibration=false"])
    storing = None if live or checkpoint_every == 0 else Storing(recording.opened, checkpoint_every, report)
    if watch and saved is None:
        raise typer.BadParameter("--watch compares with the map of an earlier visit; name it with --map RUN")
    with observers(report=report, page=page, rerun=rerun, log=log) as watching:
        if watch:
            from dudmap.core.places.saved_map import SavedMap
            from dudmap.fleet.change_watch import ChangeWatch

            assert saved is not None
            watching += (ChangeWatch(SavedMap.load(saved), watching),)
        done = run_sequence(
            recording, parameters, out,
            max_frames=max_frames, save_masks=save_masks, masks=masks, progress=not quiet, live=live, passes=passes,
            calibration=given, calibrate=calibration == "auto" and not live,
            saved_map=saved_map, localize=localize, max_memory=o.memory_size(max_memory), observers=watching,
            storing=storing, warnings=warnings,
        )  # fmt: skip
        print_report(done.metrics, done.out, quiet=quiet, as_json=as_json)


def run_parameters(
    file: Path | None,
    preset: str | None,
    assignments: list[str] | None,
    device: str | None,
    saved: Path | None,
    out: Path | None,
) -> "tuple[Config, SavedMap | None]":
    """Configuration of a run, by default that of the run whose map it goes on in, and this map."""
    from dudmap.core.backends.device import resolve
    from dudmap.core.places.saved_map import SavedMap

    if saved is not None and file is None and preset is None and (saved / "config.toml").is_file():
        file = saved / "config.toml"
    config = o.read_config(file, preset, [*(assignments or []), *([f"device={device}"] if device else [])])
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
