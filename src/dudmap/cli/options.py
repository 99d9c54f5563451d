"""Options that several commands share, and the values that are written as text in them.

A text that cannot be understood is a ``ConfigError``.
"""

import re
from functools import partial
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dudmap.errors import ConfigError

if TYPE_CHECKING:
    from dudmap.config import Config

input_option = partial(typer.Option, rich_help_panel="Input")
output_option = partial(typer.Option, rich_help_panel="Output")
map_option = partial(typer.Option, rich_help_panel="Map")
calibration_option = partial(typer.Option, rich_help_panel="Calibration")
live_option = partial(typer.Option, rich_help_panel="Live and viewing")
advanced_option = partial(typer.Option, rich_help_panel="Advanced")
"""Options in the groups of the help page of ``run``, which the other commands share."""


def preset_names(incomplete: str) -> list[str]:
    """Presets that begin so, for the shell."""
    from dudmap.presets import PRESETS

    return [name for name in PRESETS if name.startswith(incomplete)]


def parameter_names(incomplete: str) -> list[str]:
    """Parameters that begin so, with the sign that follows, for the shell."""
    from dudmap.config import keys

    return [f"{key}=" for key in keys() if key.startswith(incomplete)]


def camera_names(incomplete: str) -> list[str]:
    """Kinds of cameras that begin so, for the shell."""
    from dudmap.io.cameras import CAMERAS

    return [name for name in CAMERAS if name.startswith(incomplete)]


JsonOption = Annotated[bool, output_option("--json", help="Print the result as one JSON object, and nothing else.")]
QuietOption = Annotated[bool, output_option("--quiet", help="No progress bar and no table.")]
RunArgument = Annotated[Path, typer.Argument(help="Run folder of dudmap run.", metavar="RUN")]
RecordingArgument = Annotated[Path, typer.Argument(help="Recording: folder, file or archive.")]
CameraOption = Annotated[
    str | None,
    input_option(help="Intrinsics: fx,fy,cx,cy, then w,h and the depth_scale if need be.", metavar="NUMBERS"),
]
TopicsOption = Annotated[
    str | None,
    input_option(
        help="Of a bag: color=, depth=, color_info=, depth_info= and world= (the frame), separated by commas.",
        metavar="KEY=TOPIC",
    ),
]
FpsOption = Annotated[
    float | None, input_option(help="Frames per second, where they are only numbered; 30 are assumed.", metavar="HZ")
]
DepthUnitOption = Annotated[
    float | None, input_option(help="Metres per unit of 16-bit depth; 0.001 = millimetres.", metavar="METRES")
]
ColorOption = Annotated[
    str | None, input_option(help="Colour images of a folder in no known layout, e.g. 'left/*.png'.", metavar="PATTERN")
]
DepthOption = Annotated[
    str | None, input_option(help="Depth images of a folder in no known layout, e.g. 'range/*.png'.", metavar="PATTERN")
]
MaxFramesOption = Annotated[int | None, input_option(min=1, help="Stop after this many frames.", metavar="N")]
FramesOption = Annotated[int, typer.Option("--max-frames", min=1, help="Number of frames.", metavar="N")]

ConfigOption = Annotated[Path | None, advanced_option(help="TOML file of parameters.", metavar="FILE")]
PresetOption = Annotated[
    str | None,
    advanced_option(help="Preset of the parameters: default or thesis.", metavar="NAME", autocompletion=preset_names),
]
SetOption = Annotated[
    list[str] | None,
    advanced_option(
        "--set",
        help="Set a parameter, e.g. tracker.huber=0.02; repeatable.",
        metavar="KEY=VALUE",
        autocompletion=parameter_names,
    ),
]
DeviceOption = Annotated[
    str | None,
    advanced_option(
        help="cpu, cuda or cuda:N (extra gpu); default auto: a GPU where one works, else the CPU.", metavar="DEVICE"
    ),
]
JobsOption = Annotated[
    int, typer.Option(min=1, help="Number of runs at a time; times per frame are reliable with 1 only.", metavar="N")
]

MapOption = Annotated[
    Path | None,
    map_option("--map", help="Run folder of an earlier run: go on in its map and its world frame.", metavar="RUN"),
]
LocalizeOption = Annotated[
    bool, map_option("--localize", help="Only find the camera in the map of --map; nothing is fused or changed.")
]
MaxMemoryOption = Annotated[
    str | None,
    map_option(help="Largest memory of the process, such as 1GB; the rest of the map waits on disk.", metavar="BYTES"),
]
SaveMasksOption = Annotated[bool, output_option("--save-masks", help="Write the dynamic mask of every frame.")]
ReportOption = Annotated[
    bool, output_option("--report/--no-report", help="Keep small images and write report.html into the run folder.")
]
RerunOption = Annotated[
    Path | None, output_option(help="Also log the run for the viewer Rerun (extra rerun).", metavar="FILE.rrd")
]
LogOption = Annotated[
    Path | None, output_option(help="File for one JSON object per line and event of the run.", metavar="FILE")
]
ViewOption = Annotated[bool, live_option("--view", help="Show the run in the browser while it goes on (extra view).")]
HostOption = Annotated[
    str, live_option(help="Address the page is served at; 0.0.0.0 lets other machines see it.", metavar="HOST")
]
PortOption = Annotated[int, live_option(help="Port of the page.", min=1, max=65535, metavar="PORT")]
TokenOption = Annotated[
    str | None,
    live_option(
        help="Secret part of the page's address; default: none on this machine, a random one with another --host.",
        metavar="TEXT",
    ),
]
UpOption = Annotated[
    str | None,
    typer.Option(
        help="Direction against gravity in the world of the run, by default that of its floor.", metavar="X,Y,Z"
    ),
]


def numbers(text: str, count: int | None, option: str) -> list[float]:
    """Numbers of an option, separated by commas; any count of them for None."""
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if not found or len(found) != (count or len(found)) or not all(map(isfinite, found)):
        what = f"{count} numbers" if count else "numbers"
        raise ConfigError(f"found {option} {text!r}; expected {what} separated by commas")
    return found


def direction(text: str | None) -> tuple[float, float, float] | None:
    """Direction of ``--up``."""
    if text is None:
        return None
    x, y, z = numbers(text, 3, "--up")
    return x, y, z


def image_size(text: str) -> tuple[int, int]:
    """Width and height of ``--size``."""
    match = re.fullmatch(r"(\d+)[xX](\d+)", text.strip())
    if match is None or not all(16 <= int(number) <= 4096 for number in match.groups()):
        raise ConfigError(f"image size is {text!r}; expected WIDTHxHEIGHT from 16x16 to 4096x4096, such as 640x480")
    return int(match[1]), int(match[2])


def memory_size(text: str | None) -> int | None:
    """Number of bytes of a text such as 1GB or 800MB."""
    from pydantic import ByteSize, TypeAdapter, ValidationError

    if text is None:
        return None
    try:
        return int(TypeAdapter(ByteSize).validate_python(text))
    except ValidationError:
        raise ConfigError(f"found --max-memory {text}; expected an amount of memory such as 1GB or 800MB") from None


def read_config(file: Path | None, preset: str | None, assignments: list[str] | None) -> "Config":
    """Configuration of a file or a preset, with single parameters set."""
    from dudmap.config import Config

    if file is not None and preset is not None:
        raise ConfigError(
            f"--config and --preset are mutually exclusive; write preset = {preset!r} into {file} instead"
        )
    config = Config.load(file) if file is not None else Config.from_tree({"preset": preset} if preset else {})
    return config.override(assignments or [])
