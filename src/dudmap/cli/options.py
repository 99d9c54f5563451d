"""Options that several commands share, and the parsing of their values.

A value that cannot be parsed raises a ``ConfigError``.
"""

import inspect
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from dudmap.errors import ConfigError

if TYPE_CHECKING:
    from dudmap.config import Config
    from dudmap.core.frames.frame import Frame
    from dudmap.io.sequences import Recording

GROUPS = {
    "Input": "--camera --fps --depth-unit --color --depth --topics --sequence --data --masks --ignore --run "
    "--trajectory --reference --max-frames --every",
    "Output": "--out --sheet --save-masks --report --rerun --log --record --size --plots --plot-format "
    "--table-format --quiet --verbose --json",
    "Map": "--map --localize --passes --max-memory --crop --drop-pieces-below --fill-holes --max-triangles --up "
    "--z-up --resolution --heights --world",
    "Calibration": "--calibration",
    "Live and viewing": "--live --view --host --port --token --orbit --sweep",
    "Experiment": "--seed --count --changes --min-size --only --quick --systems --score --keep --max-runs",
    "Advanced": "--system --config --range --set --device --jobs --resume --checkpoint-every --help",
}

METAVARS = {
    "--out": "PATH", "--max-frames": "N", "--jobs": "N", "--seeds": "N", "--count": "N", "--only": "NAMES",
    "--systems": "NAMES", "--width": "PIXELS", "--max-runs": "N",
}  # fmt: skip


def arranged(command: Any) -> Any:  # noqa: ANN401 - Typer's own types moved between versions
    """Sort the options of a command into ``GROUPS``, and join the lines of its help, so that the terminal wraps it."""
    group_of = {name: group for group, names in GROUPS.items() for name in names.split()}
    order = list(group_of)
    command.help = "\n\n".join(" ".join(part.split()) for part in (command.help or "").split("\n\n"))
    for option in (*command.params, command.get_help_option(command.context_class(command))):
        if option.param_type_name == "option":
            option.rich_help_panel = option.rich_help_panel or group_of.get(option.opts[0])
            option.metavar = option.metavar or METAVARS.get(option.opts[0])
    command.params.sort(key=lambda option: order.index(option.opts[0]) if option.opts[0] in group_of else -1)
    for part in getattr(command, "commands", {}).values():
        arranged(part)
    return command


def system_names(incomplete: str) -> list[str]:
    """Shell completion of system names."""
    return [name for name in ("dudmap", "thesis") if name.startswith(incomplete)]


def parameter_names(incomplete: str) -> list[str]:
    """Shell completion of parameters, with the equals sign."""
    from dudmap.config import keys

    return [f"{key}=" for key in keys() if key.startswith(incomplete)]


def camera_names(incomplete: str) -> list[str]:
    """Shell completion of camera kinds."""
    from dudmap.io.cameras import CAMERAS

    return [name for name in CAMERAS if name.startswith(incomplete)]


JsonOption = Annotated[bool, Option("--json", help="Print the result as one JSON object, and nothing else.")]
QuietOption = Annotated[bool, Option("--quiet", help="Print warnings and errors alone.")]
RunArgument = Annotated[Path, Argument(help="Run folder of dudmap run.", metavar="RUN")]
SequenceArgument = Annotated[Path, Argument(help="Recording: folder, file or archive.", metavar="SEQUENCE")]
CameraOption = Annotated[
    str | None, Option(help="Intrinsics: fx,fy,cx,cy, then w,h and the depth_scale if need be.", metavar="NUMBERS")
]
RateOption = Annotated[float, Option("--fps", min=0.1, help="Frames per second.", metavar="HZ")]
MaxFramesOption = Annotated[int | None, Option(min=1, help="Stop after this many frames.", metavar="N")]
FramesOption = Annotated[int, Option("--max-frames", min=1, help="Number of frames.", metavar="N")]
PassesOption = Annotated[
    int, Option(min=1, max=2, help="2: second pass with the map of the first; removes ghosts.", metavar="N")
]
SeedOption = Annotated[int, Option(min=0, help="Seed of the random numbers.", metavar="N")]
SizeOption = Annotated[str, Option(help="Image size in pixels.", metavar="WxH")]

SystemOption = Annotated[
    str | None,
    Option(
        help="System that processes the frames: dudmap, or thesis (chapter 4 of the thesis).",
        metavar="NAME",
        autocompletion=system_names,
    ),
]
SetOption = Annotated[
    list[str] | None,
    Option(
        "--set",
        help="Set a parameter, e.g. tracker.huber=0.02; repeatable.",
        metavar="KEY=VALUE",
        autocompletion=parameter_names,
    ),
]
JobsOption = Annotated[
    int, Option(min=1, help="Number of runs at a time; times per frame are reliable with 1 only.", metavar="N")
]

IgnoreOption = Annotated[
    Path | None,
    Option(help="Image, white at pixels to ignore, such as a robot's arm in view.", metavar="MASK.png"),
]
SaveMasksOption = Annotated[bool, Option("--save-masks/--no-save-masks", help="Write the dynamic mask of every frame.")]
SaveImagesOption = Annotated[
    bool,
    Option("--save-images", help="Keep colour and depth wherever the camera has moved, for textures (images/)."),
]
HostOption = Annotated[
    str, Option(help="Address the page is served at; 0.0.0.0 lets other machines see it.", metavar="HOST")
]
PortOption = Annotated[int, Option(help="Port of the page.", min=1, max=65535, metavar="PORT")]
TokenOption = Annotated[
    str | None,
    Option(
        help="Secret part of the page's address; default: none on this machine, a random one with another --host.",
        metavar="TEXT",
    ),
]
UpOption = Annotated[
    str | None,
    Option(
        help="Direction against gravity in the world of the run; default: measured, else normal to the floor.",
        metavar="X,Y,Z",
    ),
]


@dataclass(frozen=True)
class ReadingOptions:
    """Options for reading a recording whose files are ambiguous."""

    camera: CameraOption = None
    fps: Annotated[
        float | None, Option(help="Frames per second of frames without times; default: 30.", metavar="HZ")
    ] = None
    depth_unit: Annotated[
        float | None, Option(help="Metres per unit of 16-bit depth; 0.001 = millimetres.", metavar="METRES")
    ] = None
    color: Annotated[
        str | None, Option(help="Colour images of a folder in no known layout, e.g. 'left/*.png'.", metavar="PATTERN")
    ] = None
    depth: Annotated[
        str | None, Option(help="Depth images of a folder in no known layout, e.g. 'range/*.png'.", metavar="PATTERN")
    ] = None
    topics: Annotated[
        str | None,
        Option(
            help="Topics of a bag: color=, depth=, color_info=, depth_info= and world= (frame), comma-separated.",
            metavar="KEY=TOPIC",
        ),
    ] = None

    def open(self, path: Path) -> "Recording":
        """Open the recording."""
        from dudmap.io.sequences import open_sequence

        return open_sequence(
            path, self.camera, self.fps, self.depth_unit, color=self.color, depth=self.depth, topics=self.topics
        )


@dataclass(frozen=True)
class ParameterOptions:
    """Options for the parameters."""

    config: Annotated[Path | None, Option(help="TOML file of parameters.", metavar="FILE")] = None
    system: SystemOption = None
    range: Annotated[
        str | None,
        Option(
            help="Voxels, depth range and all other lengths: near (0.1 to 0.5 m), room or far (6 to 15 m); default: "
            "chosen from the depth images.",
            metavar="NAME",
        ),
    ] = None
    assignments: SetOption = None

    def read(self, *more: str, seen: "Iterable[Frame]" = ()) -> "Config":
        """Parameters with assignments ``more``, for ``--range`` or the range of the frames ``seen``, which does not
        scale given lengths."""
        from dudmap.ranges import RANGES, size_of

        if self.range is not None and self.range not in RANGES:
            raise ConfigError(f"found --range {self.range}; expected one of {', '.join(RANGES)}")
        size = size_of(frame.depth for frame in seen) if self.range is None else RANGES[self.range]
        assignments = [*(self.assignments or []), *more]
        found = read_config(self.config, self.system, assignments, size)
        if self.range not in (None, "room") and found == read_config(self.config, self.system, assignments):
            raise ConfigError(
                f"--range {self.range} changes nothing: --config gives all lengths, or the system has none"
            )
        return found


@dataclass(frozen=True)
class WatchingOptions:
    """Options for viewers and logs of a run."""

    report: Annotated[
        bool, Option("--report/--no-report", help="Keep small images and write report.html into the run folder.")
    ] = True
    rerun: Annotated[
        Path | None, Option(help="Also log the run for the viewer Rerun (extra rerun).", metavar="FILE.rrd")
    ] = None
    log: Annotated[
        Path | None, Option(help="File for one JSON object per line and event of the run.", metavar="FILE")
    ] = None
    view: Annotated[bool, Option("--view", help="Show the run in the browser while it goes on (extra view).")] = False
    host: HostOption = "127.0.0.1"
    port: PortOption = 8080
    token: TokenOption = None
    verbose: Annotated[bool, Option("--verbose", help="Also print how the calibration and the core decide.")] = False


@dataclass(frozen=True)
class MapOptions:
    """Options for the map that a run continues, and for its memory and device."""

    saved: Annotated[
        Path | None,
        Option("--map", help="Run folder of an earlier run: continue its map in its world frame.", metavar="RUN"),
    ] = None
    localize: Annotated[
        bool, Option("--localize", help="Only find the camera in the map of --map; nothing is fused or changed.")
    ] = False
    max_memory: Annotated[
        str | None,
        Option(help="Largest memory of the process, such as 1GB; the rest of the map waits on disk.", metavar="BYTES"),
    ] = None
    device: Annotated[
        str | None,
        Option(help="cpu, cuda or cuda:N (extra gpu); default auto: a working GPU, else the CPU.", metavar="DEVICE"),
    ] = None


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Replace dataclasses of options among a command's arguments by single options."""
    signature = inspect.signature(command)
    annotations: dict[str, Any] = {name: found.annotation for name, found in signature.parameters.items()}
    groups: dict[str, Any] = {name: kind for name, kind in annotations.items() if is_dataclass(kind)}

    @wraps(command)
    def flat(**given: Any) -> None:  # noqa: ANN401
        for name, kind in groups.items():
            given[name] = kind(**{field.name: given.pop(field.name) for field in fields(kind)})
        command(**given)

    single = [
        option.replace(kind=option.KEYWORD_ONLY)
        for name, found in signature.parameters.items()
        for option in (inspect.signature(groups[name]).parameters.values() if name in groups else [found])
    ]
    vars(flat)["__signature__"] = signature.replace(parameters=single)
    return flat


def numbers(text: str, count: int | None, option: str) -> list[float]:
    """Parse comma-separated numbers of an option; ``count`` None allows any number."""
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if not found or len(found) != (count or len(found)) or not all(map(isfinite, found)):
        what = f"{count} numbers" if count else "numbers"
        raise ConfigError(f"found {option} {text!r}; expected {what} separated by commas")
    return found


def direction(text: str | None) -> tuple[float, float, float] | None:
    """Parse ``--up``."""
    if text is None:
        return None
    x, y, z = numbers(text, 3, "--up")
    return x, y, z


def image_size(text: str) -> tuple[int, int]:
    """Parse width and height of ``--size``."""
    match = re.fullmatch(r"(\d+)[xX](\d+)", text.strip())
    if match is None or not all(16 <= int(number) <= 4096 for number in match.groups()):
        raise ConfigError(f"image size is {text!r}; expected WIDTHxHEIGHT from 16x16 to 4096x4096, such as 640x480")
    return int(match[1]), int(match[2])


def memory_size(text: str | None) -> int | None:
    """Parse a number of bytes such as 1GB or 800MB."""
    from pydantic import ByteSize, TypeAdapter, ValidationError

    if text is None:
        return None
    try:
        return int(TypeAdapter(ByteSize).validate_python(text))
    except ValidationError:
        raise ConfigError(f"found --max-memory {text}; expected an amount of memory such as 1GB or 800MB") from None


def read_config(file: Path | None, system: str | None, assignments: list[str] | None, size: float = 1.0) -> "Config":
    """Configuration from a file or the defaults, with system and parameters set; ``size``: scene relative to a room, 1
    for the thesis."""
    from dudmap.config import Config

    config = Config.from_tree({}, size) if file is None else Config.load(file, size)
    config = config.override([*([f"system={system}"] if system else []), *(assignments or [])])
    if config.system == "thesis" and size != 1:
        return read_config(file, system, assignments)
    config.check_used()
    return config
