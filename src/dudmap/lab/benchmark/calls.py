"""Cost of a frame: launches, barriers, Python calls, files, time around kernels, bytes."""

import gc
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from types import FrameType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba.core.dispatcher import Dispatcher

from dudmap.config import Config
from dudmap.core import slam as slam_module
from dudmap.core.backends import threads
from dudmap.core.backends.parameters import BLOCK
from dudmap.core.slam import Slam
from dudmap.core.tracking.frame_view import FrameView
from dudmap.evaluation.tables import grid

if TYPE_CHECKING:
    from dudmap.io.sequences import Sequence

CORE = str(Path(slam_module.__file__).parent)
COUNTED_FROM = 40
"""Frames before the counted ones."""
BYTES_PER_PIXEL = 12 + 8 * 4 + 8
"""Bytes per pixel of a linearisation: depth, intensity, weight; eight voxels; two residuals."""
BYTES_PER_VOXEL, BYTES_PER_READING = 2 * 8, 13
"""Bytes of a fusion, per voxel read and written, and per pixel."""
COPIED = 1 << 24
"""Four-byte numbers copied to measure bandwidth, beyond caches."""


class FrameCost(NamedTuple):
    """Costs of two consecutive frames.

    Attributes:
        counts: Of the first frame, in its thread: kernel ``launches``; ``barriers`` that wait for threads; ``calls`` of
            Python and C outside kernels; ``files`` of ``core``.
        inside: By stage, first frame: ``kernel_us``, ``launches``, ``barriers``, ``bytes`` of registration and fusion.
        stages: Milliseconds by stage, second frame, not slowed down by counting.
    """

    counts: dict[str, int]
    inside: dict[str, Counter[str]]
    stages: dict[str, float]


def count_calls(sequence: "Sequence", config: Config, frames: int) -> list[FrameCost]:
    """Costs of the frames after ``COUNTED_FROM``, without self-calibration."""
    config = config.override(["sensor.self_calibration=false"])
    slam = Slam(sequence.camera, config, calibration=sequence.calibration)
    costs, counted = [], None
    for index in range(min(frames, len(sequence))):
        view = slam.prepare(sequence[index])
        if index >= COUNTED_FROM - 1 and counted is None:
            counted = _counted(slam, view)
            continue
        stages = slam.process(view).timings
        if counted is not None:
            costs.append(FrameCost(*counted, {name: ms for name, ms in stages.items() if name != "preprocess"}))
            counted = None
    return costs[1:]  # the first profile of a process misses the calls of kernels


def summary(costs: list[FrameCost]) -> dict[str, float]:
    """Median of each count."""
    return {name: float(median(one.counts[name] for one in costs)) for name in (costs[0].counts if costs else ())}


def stage_table(costs: list[FrameCost], rate: float) -> str:
    """Markdown table of each stage's medians; last column: memory time at ``rate`` bytes per second."""
    rows = []
    for name in dict.fromkeys(name for one in costs for name in one.stages):
        whole = median(one.stages.get(name, 0.0) for one in costs)
        kernel_us, launches, barriers, moved = (
            median(one.inside.get(name, Counter[str]())[key] for one in costs)
            for key in ("kernel_us", "launches", "barriers", "bytes")
        )
        times = (f"{ms:.2f}" for ms in (whole, kernel_us / 1000, whole - kernel_us / 1000))
        bound = (f"{moved / 1e6:.1f}", f"{1000 * moved / rate:.2f}") if moved else ("", "")
        rows.append([name, *times, f"{launches:.0f}", f"{barriers:.0f}", *bound])
    head = ["stage", "ms", "in kernels", "around", "launches", "barriers", "MB", "least ms"]
    return grid(head, rows, words=1)


def memory_rate() -> float:
    """Bytes per second of a copy by all threads, best of five."""
    source, target, seconds = np.ones(COPIED, np.float32), np.empty(COPIED, np.float32), []
    parts = threads.bands(COPIED, -(-COPIED // threads.num_threads()))
    for _ in range(5):
        start = time.perf_counter()
        threads.run_bands(lambda first, last: np.copyto(target[first:last], source[first:last]), parts)
        seconds.append(time.perf_counter() - start)
    return 2 * 4 * COPIED / min(seconds)


@contextmanager
def _weighed(slam: Slam, view: FrameView, inside: dict[str, Counter[str]]) -> Iterator[None]:
    backend: Any = slam.reference.backend
    register, fuse = backend.register, backend.fuse

    def registered(grid: Any, image: Any, *rest: Any) -> Any:  # noqa: ANN401
        found = register(grid, image, *rest)
        inside[view.timer.stage]["bytes"] += found.iterations * image.depth.size * BYTES_PER_PIXEL
        return found

    def fused(grid: Any, image: Any, *rest: Any) -> Any:  # noqa: ANN401
        found = fuse(grid, image, *rest)
        moved = BYTES_PER_VOXEL * BLOCK**3 * len(found.slots) + BYTES_PER_READING * image.depth.size
        inside[view.timer.stage]["bytes"] += moved
        return found

    backend.register, backend.fuse = registered, fused
    try:
        yield
    finally:
        del backend.register, backend.fuse


def _counted(slam: Slam, view: FrameView) -> tuple[dict[str, int], dict[str, Counter[str]]]:
    # isinstance would access dead proxies
    compiled = [found for found in gc.get_objects() if issubclass(type(found), Dispatcher)]
    # kernels inline formulas, and Python calls them uncompiled
    kernels = {found.py_func.__code__ for found in compiled if not found.targetoptions.get("forceinline")}
    sharing = threads.also_in_other_threads.__code__
    calls = 0
    files: set[str] = set()
    inside: defaultdict[str, Counter[str]] = defaultdict(Counter)
    began = 0.0

    def count(frame: FrameType, event: str, argument: object) -> None:
        nonlocal calls, began
        code, stage = frame.f_code, inside[view.timer.stage]
        if code in kernels:
            if event == "call":
                began = time.perf_counter()
                stage["launches"] += 1
            elif event == "return":
                stage["kernel_us"] += round(1e6 * (time.perf_counter() - began))
        elif event in ("call", "c_call"):
            calls += 1
            stage["barriers"] += event == "call" and code is sharing
            if code.co_filename.startswith(CORE):
                files.add(code.co_filename)

    with _weighed(slam, view, inside):
        sys.setprofile(count)
        try:
            slam.process(view)
        finally:
            sys.setprofile(None)
    launches, barriers = (sum(stage[key] for stage in inside.values()) for key in ("launches", "barriers"))
    return {"launches": launches, "barriers": barriers, "calls": calls, "files": len(files)}, inside
