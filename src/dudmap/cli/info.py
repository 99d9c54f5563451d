"""``dudmap info``: describe a recording and its suspected faults."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option

from dudmap.cli import options as o
from dudmap.cli.output import answer
from dudmap.own_folder import check_outside

if TYPE_CHECKING:
    from dudmap.app.pipeline.inspection import Inspection


SHOWN_GAPS = 5


def info(
    reading: o.ReadingOptions,
    sequence: o.SequenceArgument,
    sheet: Annotated[Path | None, Option(help="Write a contact sheet (PNG) of twelve frames.", metavar="FILE")] = None,
    as_json: o.JsonOption = False,
) -> None:
    """Describe a recording: format, frames, rates, both cameras, depth, ground truth, gaps.

    Warn of suspected faults: depth scale, intrinsics, times, sparse depth, unreadable frames. Twelve frames are read.
    """
    from dataclasses import asdict

    from rich.table import Table

    from dudmap.app.pipeline.image_checks import color_magnification, unregistered
    from dudmap.app.pipeline.inspection import inspect, repeats, sample
    from dudmap.app.terminal import plain_console
    from dudmap.app.viewing.snapshot import save_overview

    recording = reading.open(sequence)
    if sheet is not None:
        check_outside(sheet, recording, "--sheet")
    frames, unreadable = sample(recording)
    found = inspect(recording, frames, unreadable)
    found.repeats = repeats(recording)
    if (magnification := color_magnification(recording)) is not None:
        said = f"the colour camera is not the given one, or colours are not registered: {unregistered(magnification)}"
        found.warnings.append(f"{said}; dudmap run calibrates it, if --camera is the camera of the depth")
    if sheet is not None:
        save_overview(sheet, frames)
    if as_json:
        answer(asdict(found), "", as_json=True)
        return
    console = plain_console()
    table = Table.grid(padding=(0, 2))
    for row in rows(found):
        table.add_row(*row)
    console.print(table)
    for warning in found.warnings:
        console.print(f"warning: {warning}", soft_wrap=True)
    if sheet is not None:
        console.print(f"written to {sheet}", soft_wrap=True)


def rows(found: "Inspection") -> list[tuple[str, str]]:
    """Names and values of a description, as text."""
    color = found.color_rate
    rates = [] if found.rate is None else [f"{found.rate:.4g} Hz depth"] + ([f"{color:.4g} Hz colour"] if color else [])
    registered = found.T_color_depth is None
    untested = "; not tested (dudmap calibrate does)" if found.has_color else ""
    color_camera = (
        "none"
        if not found.has_color
        else "assumed to be registered to depth"
        if registered
        else _camera(found.color_camera)
    )
    shift = None if registered else [1000 * row[3] for row in found.T_color_depth or []]
    return [
        ("recording", found.name),
        ("format", found.format),
        ("frames", f"{found.frames} in {found.duration:.2f} s" + (f", {', '.join(rates)}" if rates else "")),
        ("distinct images", _distinct(found)),
        ("depth camera", _camera(found.camera)),
        ("colour camera", color_camera + untested),
        *([] if shift is None else [("colour from depth", "{:.1f} {:.1f} {:.1f} mm".format(*shift[:3]))]),
        *((f"{what} from", source) for what, source in found.sources.items()),
        ("depth", _depth(found)),
        ("range", _range(found)),
        (
            "ground truth",
            f"{found.ground_truth} poses; run --poses recording fuses with them" if found.ground_truth else "none",
        ),
        ("gaps", _gaps(found)),
    ]


def _distinct(found: "Inspection") -> str:
    depth, color = found.distinct_rate("depth"), found.distinct_rate("color")
    if depth is None or color is None:
        return "not known"
    if not found.has_color:
        return f"about {depth:.4g} Hz depth"
    what = {"frame": "both images", "depth": "depth alone", "color": "colour alone"}
    said = [f"{share:.0%} of the frames repeat {what[kind]}" for kind, share in found.repeats.items() if share]
    return f"about {depth:.4g} Hz depth, {color:.4g} Hz colour" + (f"; {', '.join(said)}" if said else "")


def _camera(camera: dict[str, Any]) -> str:
    numbers = "fx {fx:.6g}, fy {fy:.6g}, cx {cx:.6g}, cy {cy:.6g}".format(**camera)
    lens = ", distortion " + " ".join(f"{value:g}" for value in camera["distortion"]) if camera["distortion"] else ""
    return f"{camera['width']}x{camera['height']}, {numbers}{lens}"


def _depth(found: "Inspection") -> str:
    median = "no reading" if found.median_depth is None else f"median {found.median_depth:.3g} m"
    return f"{found.depth_scale:g} units per metre, {median}, {found.valid_depth:.0%} of the pixels valid"


def _range(found: "Inspection") -> str:
    least, largest = found.depth_range
    used = f"{least:g} to {largest:g} m is used, with voxels of {1000 * found.voxel_size:g} mm"
    return f"{used}; {found.too_near:.0%} of the readings are nearer, {found.too_far:.0%} farther"


def _gaps(found: "Inspection") -> str:
    if not found.gaps:
        return "none"
    shown = ", ".join(f"{length:.2f} s after {stamp:.2f}" for stamp, length in found.gaps[:SHOWN_GAPS])
    return f"{len(found.gaps)}: {shown}" + (" ..." if len(found.gaps) > SHOWN_GAPS else "")
