"""``dudmap benchmark speed | gpu | roofline | soak``: time and memory of the machine at hand."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from dudmap.app.terminal import say
from dudmap.atomic_file import write_text
from dudmap.cli import options as o
from dudmap.cli.output import answer

RUNS = Path("runs/benchmark")
"""Folder of the output folders, unless another one is named."""

QuickOption = Annotated[bool, typer.Option("--quick", help="Reduced version for a quick check.")]


def gpu(
    device: Annotated[
        str, typer.Option(help="Device beside the CPU: auto, cuda or cuda:N.", metavar="DEVICE")
    ] = "auto",
    max_frames: Annotated[int, typer.Option(min=2, help="Number of frames of each run.")] = 120,
    voxels: Annotated[str, typer.Option(help="Comma-separated voxel sizes, cm.", metavar="NUMBERS")] = "2,1,0.5,0.25",
    sizes: Annotated[
        str, typer.Option(help="Comma-separated image sizes of the synthetic room; empty leaves it out.")
    ] = "640x480,1280x720",
    sequence: Annotated[
        list[Path] | None, typer.Option(help="Also measure this recording; repeatable.", metavar="SEQUENCE")
    ] = None,
    open3d: Annotated[
        Path | None,
        typer.Option(metavar="PYTHON", help="Python interpreter with open3d, whose dense SLAM is measured."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Output folder for gpu.md and gpu.json.")] = RUNS / "gpu",
    quick: QuickOption = False,
    as_json: o.JsonOption = False,
) -> None:
    """Measure a GPU and the CPU beside it: time by stage and kernel, and memory.

    Without a GPU, only the CPU is measured, and the table says why.
    """
    from dudmap.app.pipeline.environment import machine, versions
    from dudmap.lab.benchmark import gpu as measurements
    from dudmap.lab.benchmark.gpu import find_open3d

    rows, python = [], find_open3d(open3d)
    steps, shapes = measurements.numbers(voxels, sizes)
    if quick:
        steps, shapes, max_frames = steps[:1], [(320, 240)], min(max_frames, 12)
    for name, each in measurements.recordings(shapes, max_frames, sequence or []):
        for step in steps:
            for one in measurements.devices(device):
                say(f"measuring {name}, {100 * step:g} cm, {one}", err=True)
                rows.append(measurements.measure(name, each, max_frames, step, one))
        if python is not None:
            other = measurements.devices(device)[0].upper()
            say(f"measuring {name}, Open3D's dense SLAM", err=True)
            rows += measurements.measure_open3d(
                python, name, each, max_frames, steps, "CPU:0" if other == "CPU" else other
            )
    text = measurements.table(rows)
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / "gpu.md", text)
    content = {"machine": machine(), "versions": versions(), "rows": [asdict(row) for row in rows]}
    write_text(out / "gpu.json", json.dumps(content, indent=2) + "\n")
    answer(content | {"out": out}, f"{text}\nwritten to {out}", as_json=as_json)


def speed(
    out: Annotated[Path, typer.Option(help="Output folder for speed.md and speed.json.")] = RUNS / "speed",
    long: Annotated[
        bool, typer.Option("--long", help="Also measure the growth of the time per frame over 2000 frames.")
    ] = False,
    open3d: Annotated[
        Path | None,
        typer.Option(metavar="PYTHON", help="Python interpreter with open3d, to compare with its dense SLAM."),
    ] = None,
    sequence: Annotated[
        Path | None,
        typer.Option(help="Recording of that comparison; default: a synthetic room.", metavar="SEQUENCE"),
    ] = None,
    quick: QuickOption = False,
    as_json: o.JsonOption = False,
) -> None:
    """Measure time and memory on this machine, which should be idle otherwise."""
    from dudmap.app.pipeline.environment import machine, versions
    from dudmap.lab.benchmark.gpu import find_open3d
    from dudmap.lab.benchmark.speed import markdown, speed_figures

    frames, long_frames = (20, 60) if quick else (300, 2000)
    figures = speed_figures(
        frames,
        long_frames if long else 0,
        lambda what: say(f"measuring {what}", err=True),
        find_open3d(open3d),
        sequence,
    )
    text = markdown(figures)
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / "speed.md", text)
    content = {"machine": machine(), "versions": versions(), "figures": [figure._asdict() for figure in figures]}
    write_text(out / "speed.json", json.dumps(content, indent=2) + "\n")
    answer(content | {"out": out}, f"{text}\nwritten to {out}", as_json=as_json)


def roofline(
    max_frames: Annotated[int, typer.Option(min=2, help="Number of frames.")] = 60,
    voxel: Annotated[float, typer.Option(help="Voxel size, metres.")] = 0.01,
    out: Annotated[Path, typer.Option(help="Output folder for roofline.md and roofline.json.")] = RUNS / "roofline",
    as_json: o.JsonOption = False,
) -> None:
    """Compare the time of each stage with what its bytes and operations need at least on this machine."""
    from dudmap.app.pipeline.environment import machine, versions
    from dudmap.lab.benchmark import roofline as measurements

    figures, text = measurements.roofline(max_frames, voxel)
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / "roofline.md", text)
    content = {"machine": machine(), "versions": versions(), **figures}
    write_text(out / "roofline.json", json.dumps(content, indent=2) + "\n")
    answer(content | {"out": out}, f"{text}\nwritten to {out}", as_json=as_json)


def soak(
    max_frames: Annotated[int, typer.Option(min=20, help="Number of frames, at 15 Hz.")] = 20_000,
    size: o.SizeOption = "320x240",
    seed: o.SeedOption = 0,
    as_json: o.JsonOption = False,
) -> None:
    """Process many frames of one room; fail if time, memory or error grows from the second tenth to the last."""
    from dudmap.lab.benchmark.soak import grown, measure_soak

    def shown(row: dict[str, float]) -> None:
        say(", ".join(f"{key} {value:.5g}" for key, value in row.items()), err=as_json)

    rows = measure_soak(max_frames, o.image_size(size), seed, shown)
    found = grown(rows)
    answer({"rows": rows, "grown": found}, f"{len(found)} of 3 figures grew", as_json=as_json)
    if found:
        say(f"dudmap: from the second tenth to the last, {'; '.join(found)}", err=True)
        raise typer.Exit(1)
