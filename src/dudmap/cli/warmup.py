"""``dudmap warmup``: compile all kernels into the cache."""

import time

from dudmap.cli import options as o
from dudmap.cli.output import answer


def warmup(quiet: o.QuietOption = False, as_json: o.JsonOption = False) -> None:
    """Compile all kernels in advance.

    Processes a few small images with every part of the system, in two processes on two or more cores. The compiled
    kernels are cached on disk.
    """
    from contextlib import nullcontext

    from dudmap.app.terminal import plain_console
    from dudmap.lab.warmup import SECOND_PROCESS, compiled_in_background, steps

    console = plain_console(stderr=True, quiet=quiet or as_json)
    taken: dict[str, float] = {}
    with compiled_in_background(SECOND_PROCESS) as wait:
        for name, step in steps():
            with console.status(name) if console.is_terminal else nullcontext():
                begin = time.perf_counter()
                if name in SECOND_PROCESS:
                    wait()
                step()
            taken[name] = round(time.perf_counter() - begin, 3)
            console.print(f"{name}: {taken[name]:.1f} s")
    total = sum(taken.values())
    answer({"seconds": total, "steps": taken}, f"ready after {total:.1f} s", as_json=as_json, quiet=quiet)
