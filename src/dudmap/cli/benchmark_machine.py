"""``dudmap benchmark speed | compile | gpu | soak``: time and memory of the machine at hand."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from dudmap.app.terminal import say
from dudmap.cli import options as o
from dudmap.cli.output import answer
from dudmap.errors import InternalError

RUNS = Path("runs/benchmark")

QuickOption = Annotated[bool, Option("--quick", help="Reduced version for a quick check.")]


def _announced(what: str) -> None:
    say(f"measuring {what}", err=True)


def gpu(
    device: Annotated[str, Option(help="GPU to compare: auto, cuda or cuda:N.", metavar="DEVICE")] = "auto",
    max_frames: Annotated[int, Option(min=2, help="Number of frames of each run.")] = 120,
    voxels: Annotated[str, Option(help="Comma-separated voxel sizes, cm.", metavar="NUMBERS")] = "2,1,0.5,0.25",
    sequence: Annotated[
        list[Path] | None,
        Option(help="Recording; repeatable; default: a synthetic room in two sizes.", metavar="SEQUENCE"),
    ] = None,
    out: Annotated[Path, Option(help="Output folder for gpu.md and gpu.json.")] = RUNS / "gpu",
    quick: QuickOption = False,
    as_json: o.JsonOption = False,
) -> None:
    """Measure a GPU and the CPU: time by stage and kernel, and memory.

    Without a GPU, only the CPU is measured, and the table says why.
    """
    from dudmap.io.sequences import open_sequence
    from dudmap.lab import synthetic
    from dudmap.lab.benchmark import gpu as measurements
    from dudmap.lab.benchmark.measure import save

    steps, sizes = [size / 100 for size in o.numbers(voxels, None, "--voxels")], [(640, 480), (1280, 960)]
    if quick:
        steps, sizes, max_frames = steps[:1], [(320, 240)], min(max_frames, 12)
    rooms = {f"room {w}x{h}": {"frames": max_frames, "camera": (w, h)} for w, h in sizes}
    found = {name: synthetic.sequence(**world) for name, world in rooms.items()} if not sequence else {}
    found |= {f"{path.name}": open_sequence(path) for path in sequence or []}
    rows = measurements.measure_devices(found, steps, max_frames, device, _announced)
    text = measurements.table(rows)
    answer(save(None, text, out, "gpu", {"rows": rows}), text, as_json=as_json, out=out)


def speed(
    out: Annotated[Path, Option(help="Output folder for speed.md and speed.json.")] = RUNS / "speed",
    open3d: Annotated[
        Path | None, Option(metavar="PYTHON", help="Python interpreter with open3d, to compare with its dense SLAM.")
    ] = None,
    sequence: Annotated[
        Path | None, Option(help="Recording of that comparison; default: a synthetic room.", metavar="SEQUENCE")
    ] = None,
    quick: QuickOption = False,
    as_json: o.JsonOption = False,
) -> None:
    """Measure time and memory on this otherwise idle machine, and the time of a frame's stages."""
    from dudmap.lab.benchmark.measure import save
    from dudmap.lab.benchmark.speed import markdown, speed_figures, stages

    figures = speed_figures(20 if quick else 300, _announced, open3d, sequence)
    text, tree = f"{markdown(figures)}\n{stages()}", {"figures": [figure._asdict() for figure in figures]}
    answer(save(None, text, out, "speed", tree), text, as_json=as_json, out=out)


def compile_(as_json: o.JsonOption = False) -> None:
    """Compile all kernels again, in a separate process, and print the seconds and callers of each."""
    from dudmap.lab.benchmark.compiling import compile_warmup, table
    from dudmap.lab.benchmark.measure import in_own_process

    _announced("the compilation of all kernels, one to two minutes")
    tree = in_own_process(compile_warmup, None)
    if "error" in tree:
        raise InternalError(f"the kernels could not be compiled: {tree['error']}")
    answer(tree, table(tree), as_json=as_json)


def soak(
    max_frames: Annotated[int, Option(min=20, help="Number of frames, at 15 Hz.")] = 20_000,
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
