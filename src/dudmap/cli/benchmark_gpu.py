"""``dudmap benchmark gpu``: time and memory of a GPU and of the CPU beside it."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from dudmap.app.terminal import say
from dudmap.atomic_file import write_text
from dudmap.cli import options as o
from dudmap.cli.output import answer


def gpu(
    device: Annotated[str, typer.Option(help="Device beside the CPU: auto, cuda or cuda:N.")] = "auto",
    max_frames: Annotated[int, typer.Option(min=2, help="Number of frames of each run.")] = 120,
    voxels: Annotated[str, typer.Option(help="Comma-separated voxel sizes, cm.", metavar="NUMBERS")] = "2,1,0.5,0.25",
    sizes: Annotated[
        str, typer.Option(help="Comma-separated image sizes of the synthetic room; empty leaves it out.")
    ] = "640x480,1280x720",
    recording: Annotated[list[Path] | None, typer.Option(help="Also measure this recording; repeatable.")] = None,
    open3d: Annotated[
        Path | None,
        typer.Option(metavar="PYTHON", help="Python interpreter with open3d, whose dense SLAM is measured."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Output folder for gpu.md and gpu.json.")] = Path("runs/benchmark/gpu"),
    quick: Annotated[bool, typer.Option("--quick", help="Reduced version for a quick check.")] = False,
    as_json: o.JsonOption = False,
) -> None:
    """Measure a GPU and the CPU beside it: time by stage and kernel, and memory.

    Without a GPU, only the CPU is measured, and the table says why.
    """
    from dudmap.app.pipeline.environment import machine, versions
    from dudmap.lab.benchmark import gpu as measurements
    from dudmap.lab.benchmark.interleaved import find_open3d

    rows, python = [], find_open3d(open3d)
    steps, shapes = measurements.numbers(voxels, sizes)
    if quick:
        steps, shapes, max_frames = steps[:1], [(320, 240)], min(max_frames, 12)
    for name, each in measurements.recordings(shapes, max_frames, recording or []):
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
