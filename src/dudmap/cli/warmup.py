"""``dudmap warmup``: compile all kernels into the cache."""

import time
from collections.abc import Callable
from typing import Annotated

import typer

from dudmap.cli.output import JsonOption, answer

app = typer.Typer(add_completion=False)


@app.command()
def warmup(
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Compile all kernels in advance.

    Processes a small synthetic recording with every part of the system; the compiled kernels are cached on disk.
    """
    from contextlib import nullcontext

    from dudmap.terminal import plain_console

    console = plain_console(stderr=True, quiet=quiet or as_json)
    taken: dict[str, float] = {}
    for name, step in steps():
        with console.status(name) if console.is_terminal else nullcontext():
            begin = time.perf_counter()
            step()
        taken[name] = round(time.perf_counter() - begin, 3)
        console.print(f"{name}: {taken[name]:.1f} s")
    total = sum(taken.values())
    answer({"seconds": total, "steps": taken}, f"ready after {total:.1f} s", as_json=as_json, quiet=quiet)


def steps() -> list[tuple[str, Callable[[], object]]]:
    """Name and action of every part with kernels, in the order in which they must run."""
    import tempfile
    from pathlib import Path

    from dudmap.config import Config
    from dudmap.mapping.volume import TsdfVolume
    from dudmap.slam import Slam
    from dudmap.synthetic import sequence
    from dudmap.synthetic.recording import DEFAULT_CAMERA

    camera = DEFAULT_CAMERA.resized(160, 120)
    recording = sequence(frames=4, camera=camera, start_dynamic=True)
    frames = []
    small = ["volume.voxel_size=0.04", "preprocess.depth_max=4", "similarity.max_translation=0"]
    slam = Slam(camera, Config().override(small))

    def render() -> None:
        frames.extend(recording[index] for index in range(len(recording)))

    def process(system: Slam) -> None:
        for frame in frames:
            system.process(frame)

    def process_variants() -> None:
        for variant in ("preset=thesis", "dynamics.method=threshold", "tracker.robust=tukey"):
            process(Slam(camera, Config().override([variant, *small])))

    def several_voxel_sizes() -> None:
        adaptive = Slam(camera, Config().override(["volume.adaptive=true", "volume.adaptive_bend=0.05", *small]))
        process(adaptive)
        adaptive.volume.extract_mesh()
        adaptive.volume.raycast(adaptive.trajectory.Ts_world_camera[-1], camera)

    def save_and_load() -> None:
        with tempfile.TemporaryDirectory() as folder:
            slam.volume.save(Path(folder) / "map.npz")
            TsdfVolume.load(Path(folder) / "map.npz")

    return [
        ("synthetic frames", render),
        ("tracking, labels and map", lambda: process(slam)),
        ("variants of the method", process_variants),
        ("mesh", lambda: slam.volume.extract_mesh()),
        ("view", lambda: slam.volume.raycast(slam.trajectory.Ts_world_camera[-1], camera)),
        ("several voxel sizes", several_voxel_sizes),
        ("map file", save_and_load),
    ]
