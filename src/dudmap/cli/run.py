"""``dudmap run``: process a recording into a run folder."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dudmap.app.terminal import say
from dudmap.cli.output import JsonOption, answer, parameter_names, preset_names
from dudmap.cli.view import TokenOption, observers
from dudmap.errors import ConfigError

if TYPE_CHECKING:
    from dudmap.config import Config
    from dudmap.core.places.saved_map import SavedMap

app = typer.Typer(add_completion=False)

CameraOption = Annotated[
    str | None, typer.Option("--camera", help="Intrinsics: fx,fy,cx,cy[,w,h[,depth_scale]].", metavar="NUMBERS")
]
TopicsOption = Annotated[
    str | None,
    typer.Option(
        "--topics", help="Of a bag: color=/a,depth=/b,color_info=/c,depth_info=/d,world=frame.", metavar="KEY=TOPIC,..."
    ),
]
FpsOption = Annotated[
    float | None,
    typer.Option("--fps", help="Frames per second, where they are only numbered; 30 are assumed.", metavar="HZ"),
]
DepthUnitOption = Annotated[
    float | None,
    typer.Option("--depth-unit", help="Metres per unit of 16-bit depth; 0.001 = millimetres.", metavar="METRES"),
]
ColorOption = Annotated[
    str | None,
    typer.Option("--color", help="Colour images of a folder in no known layout, e.g. 'left/*.png'.", metavar="PATTERN"),
]
DepthOption = Annotated[
    str | None,
    typer.Option("--depth", help="Depth images of a folder in no known layout, e.g. 'range/*.png'.", metavar="PATTERN"),
]
ConfigOption = Annotated[Path | None, typer.Option("--config", help="TOML file of parameters.")]
PresetOption = Annotated[
    str | None,
    typer.Option("--preset", help="Preset of the parameters: default or thesis.", autocompletion=preset_names),
]
CalibrationOption = Annotated[
    str,
    typer.Option(
        "--calibration",
        help="Calibration of the colour camera: auto estimates it from the first ten seconds (a live replay while it "
        "runs); given takes what the recording says; or calibration.toml of another run or of calibrate.",
        metavar="auto|given|FILE",
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="Set a parameter, e.g. tracker.huber=0.02; repeatable.",
        metavar="KEY=VALUE",
        autocompletion=parameter_names,
    ),
]
DeviceOption = Annotated[
    str | None,
    typer.Option(
        "--device", help="cpu, cuda or cuda:N (extra gpu); default auto: a GPU where one works, else the CPU."
    ),
]
QuietOption = Annotated[bool, typer.Option("--quiet", help="No progress bar and no table.")]
ReportOption = Annotated[
    bool, typer.Option("--report/--no-report", help="Keep small images and write report.html into the run folder.")
]
ViewOption = Annotated[bool, typer.Option("--view", help="Show the run in the browser while it goes on (extra view).")]
HostOption = Annotated[
    str, typer.Option("--host", help="Address the page of --view is served at; 0.0.0.0 lets other machines see it.")
]
PortOption = Annotated[int, typer.Option("--port", help="Port of the page of --view.", min=1, max=65535)]
RerunOption = Annotated[
    Path | None,
    typer.Option("--rerun", help="Also log the run for the viewer Rerun (extra rerun).", metavar="FILE.rrd"),
]
LogOption = Annotated[
    Path | None, typer.Option("--log", help="File for one JSON object per line and event of the run.", metavar="FILE")
]


@app.command()
def run(
    sequence: Annotated[
        Path | None, typer.Argument(help="Recording: folder, file or archive; `dudmap info` says what is found.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Run folder; default: runs/<recording>.")] = None,
    config: ConfigOption = None,
    assignments: SetOption = None,
    preset: PresetOption = None,
    camera: CameraOption = None,
    fps: FpsOption = None,
    depth_unit: DepthUnitOption = None,
    color: ColorOption = None,
    depth: DepthOption = None,
    topics: TopicsOption = None,
    calibration: CalibrationOption = "auto",
    max_frames: Annotated[int | None, typer.Option("--max-frames", min=1, help="Stop after this many frames.")] = None,
    save_masks: Annotated[bool, typer.Option("--save-masks", help="Write the dynamic mask of every frame.")] = False,
    masks: Annotated[
        Path | None,
        typer.Option("--masks", help="Folder of external dynamic masks, <timestamp>.png with 255 = dynamic."),
    ] = None,
    live: Annotated[
        bool,
        typer.Option("--live", help="Replay in real time; frames are dropped where processing is too slow."),
    ] = False,
    passes: Annotated[
        int,
        typer.Option("--passes", min=1, max=2, help="2: second pass with the map of the first; removes ghosts."),
    ] = 1,
    depth_model: Annotated[
        Path | None,
        typer.Option("--depth-model", help="depth_model.npz of an earlier run: distortion of the depth to remove."),
    ] = None,
    saved: Annotated[
        Path | None,
        typer.Option(
            "--map", help="Run folder of an earlier run: go on in its map and its world frame.", metavar="RUN"
        ),
    ] = None,
    localize: Annotated[
        bool, typer.Option("--localize", help="Only find the camera in the map of --map; nothing is fused or changed.")
    ] = False,
    max_memory: Annotated[
        str | None,
        typer.Option(
            "--max-memory", help="Largest memory of the process, such as 1GB; the rest of the map waits on disk."
        ),
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            "--resume", help="Go on with the interrupted run in this folder; alone or with --device.", metavar="RUN"
        ),
    ] = None,
    checkpoint_every: Annotated[
        float | None,
        typer.Option(
            "--checkpoint-every",
            help="Seconds from one checkpoint to the next; 0 for none. Default: as often as takes 2 % of the time.",
            min=0,
        ),
    ] = None,
    report: ReportOption = True,
    view: ViewOption = False,
    host: HostOption = "127.0.0.1",
    port: PortOption = 8080,
    token: TokenOption = None,
    rerun: RerunOption = None,
    log: LogOption = None,
    device: DeviceOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate the trajectory and a mesh of the static scene from a recording.

    Writes trajectory.txt, mesh.ply, map.npz, keyframes.npz, config.toml, metrics.json, timings.csv and report.html
    into the run folder; with --set movers.meshes=true also movers/<id>.ply and <id>.txt, mesh and poses of every rigid
    moving object.
    """
    from dudmap.app.pipeline.inspection import inspect
    from dudmap.app.pipeline.run import run as run_sequence
    from dudmap.app.pipeline.storing import Storing
    from dudmap.core.backends.device import resolve
    from dudmap.core.geometry.calibration import Calibration
    from dudmap.io.sequences import open_sequence

    if resume is not None:
        if sequence is not None or out is not None:
            raise typer.BadParameter("--resume goes on with a run as it was ordered; leave out the recording and --out")
        page = (host, port, token) if view else None
        _resume(resume, device, page=page, rerun=rerun, log=log, quiet=quiet, as_json=as_json)
        return
    if sequence is None:
        raise typer.BadParameter("name a recording, or a run folder to go on with (--resume RUN)")
    if saved is not None and config is None and preset is None and (saved / "config.toml").is_file():
        config = saved / "config.toml"
    parameters = read_config(config, preset, [*(assignments or []), *([f"device={device}"] if device else [])])
    resolve(parameters.device, adaptive=parameters.volume.adaptive)  # refused before anything takes time
    saved_map = None if saved is None else read_saved_map(saved, parameters, out)
    recording = open_sequence(sequence, camera, fps, depth_unit, color=color, depth=depth, topics=topics)
    warnings = inspect(recording).warnings
    for warning in warnings:
        _print_notice(f"warning: {warning}")
    out = out or free_folder(Path("runs") / recording.name)
    given = None if calibration in ("auto", "given") else Calibration.load(Path(calibration))
    if calibration != "auto" or not live:  # what has been estimated beforehand is not estimated again
        parameters = parameters.override(["sensor.self_calibration=false"])
    storing = None if live or checkpoint_every == 0 else Storing(recording.opened, checkpoint_every, report)
    with observers(report=report, page=(host, port, token) if view else None, rerun=rerun, log=log) as watching:
        done = run_sequence(
            recording, parameters, out,
            max_frames=max_frames, save_masks=save_masks, masks=masks, progress=not quiet, live=live, passes=passes,
            depth_model=depth_model, calibration=given, calibrate=calibration == "auto" and not live,
            saved_map=saved_map, localize=localize,
            max_memory=None if max_memory is None else memory_size(max_memory), observers=watching, storing=storing,
            warnings=warnings,
        )  # fmt: skip
        print_report(done.metrics, done.out, quiet=quiet, as_json=as_json)


def memory_size(text: str) -> int:
    """Number of bytes of a text such as 1GB or 800MB.

    Raises:
        ConfigError: It is no amount of memory.
    """
    from pydantic import ByteSize, TypeAdapter, ValidationError

    try:
        return int(TypeAdapter(ByteSize).validate_python(text))
    except ValidationError:
        raise ConfigError(f"found --max-memory {text}; expected an amount of memory such as 1GB or 800MB") from None


def _resume(
    folder: Path,
    device: str | None,
    *,
    page: tuple[str, int, str | None] | None,
    rerun: Path | None,
    log: Path | None,
    quiet: bool,
    as_json: bool,
) -> None:
    """Go on with an interrupted run."""
    from dudmap.app.pipeline.resume import resume, wants_report

    with observers(report=wants_report(folder), page=page, rerun=rerun, log=log) as watching:
        done = resume(folder, device=device, progress=not quiet, observers=watching)
        print_report(done.metrics, done.out, quiet=quiet, as_json=as_json)


def _print_notice(text: str) -> None:
    say(text, err=True)


def read_config(file: Path | None, preset: str | None, assignments: list[str]) -> "Config":
    """Configuration of a file or a preset, with single parameters set."""
    from dudmap.config import Config

    if file is not None and preset is not None:
        raise ConfigError(
            f"--config and --preset are mutually exclusive; write preset = {preset!r} into {file} instead"
        )
    config = Config.load(file) if file is not None else Config.from_tree({"preset": preset} if preset else {})
    return config.override(assignments)


def read_saved_map(folder: Path, config: "Config", out: Path | None) -> "SavedMap":
    """Map of a run folder for a run with this configuration."""
    from dudmap.core.places.saved_map import SavedMap

    if out is not None and out.resolve() == folder.resolve():
        raise ConfigError(
            f"the map to go on in lies in the run folder {out}, which is emptied; name another with --out"
        )
    if not config.relocalization.enabled:
        raise ConfigError("the camera is found in a saved map by relocalisation; drop relocalization.enabled=false")
    return SavedMap.load(folder, config.volume.voxel_size)


def free_folder(wanted: Path) -> Path:
    """The folder itself if it is new or empty, else the first of ``<name>-2``, ``<name>-3``, ... that is."""
    folder, number = wanted, 1
    while folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        number += 1
        folder = wanted.with_name(f"{wanted.name}-{number}")
    return folder


def print_report(metrics: dict[str, object], out: Path, *, quiet: bool, as_json: bool) -> None:
    """Print the metrics to stdout: as one JSON object, as a table, or not at all."""
    if as_json:
        answer(metrics, "", as_json=True)
    elif not quiet:
        from dudmap.app.pipeline.progress import summary
        from dudmap.app.terminal import plain_console

        console = plain_console()
        console.print(summary(metrics))
        console.print(f"written to {out}", soft_wrap=True)
