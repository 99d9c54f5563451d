"""What a frame costs besides arithmetic: kernel launches, barriers, Python calls, files, and time around kernels."""

import gc
import sys
import time
from pathlib import Path
from statistics import median
from types import FrameType
from typing import TYPE_CHECKING, NamedTuple

from numba.core.dispatcher import Dispatcher

from dudmap.config import Config
from dudmap.core import slam as slam_module
from dudmap.core.backends import threads
from dudmap.core.slam import Slam
from dudmap.core.tracking.frame_view import FrameView
from dudmap.lab.benchmark.measure import grid

if TYPE_CHECKING:
    from dudmap.io.sequences import Sequence

CORE = str(Path(slam_module.__file__).parent)
"""Folder of the algorithm."""
COUNTED_FROM = 40
"""Frames before those that are counted: the first second has a map that knows little."""


class FrameCost(NamedTuple):
    """Costs of two frames, one after the other.

    Attributes:
        counts: Of the first, in the thread that calls ``Slam.process``. ``launches``: calls of compiled kernels;
            ``barriers``: calls whose work other threads share, and which wait for it; ``calls``: calls of Python and C
            functions outside of kernels; ``files``: files of ``core`` that the frame enters.
        kernels: Milliseconds in kernels by stage, of the first.
        stages: Milliseconds by stage, of the second, which is not slowed down by the counting.
    """

    counts: dict[str, int]
    kernels: dict[str, float]
    stages: dict[str, float]


def count_calls(sequence: "Sequence", config: Config, frames: int) -> list[FrameCost]:
    """Costs of the frames after the first ``COUNTED_FROM``; self-calibration, which runs beside the frames, is off."""
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
    """Median of each count over the frames."""
    return {name: float(median(one.counts[name] for one in costs)) for name in (costs[0].counts if costs else ())}


def stage_table(costs: list[FrameCost]) -> str:
    """Median time of each stage, in kernels and around them, as a Markdown table."""
    rows = []
    for name in dict.fromkeys(name for one in costs for name in one.stages):
        whole = median(one.stages.get(name, 0.0) for one in costs)
        inside = median(one.kernels.get(name, 0.0) for one in costs)
        rows.append([name, f"{whole:.2f}", f"{inside:.2f}", f"{whole - inside:.2f}"])
    return grid(["stage", "ms", "in kernels", "around"], rows, words=1)


def _counted(slam: Slam, view: FrameView) -> tuple[dict[str, int], dict[str, float]]:
    """Counts of a frame, and its milliseconds in kernels by stage."""
    # an isinstance would ask dead proxies
    compiled = [found for found in gc.get_objects() if issubclass(type(found), Dispatcher)]
    # formulas are inlined where kernels call them, and Python calls them uncompiled
    kernels = {found.py_func.__code__ for found in compiled if not found.targetoptions.get("forceinline")}
    sharing = threads.also_in_other_threads.__code__
    launches = barriers = calls = 0
    files: set[str] = set()
    spent: dict[str, float] = {}
    began = 0.0

    def count(frame: FrameType, event: str, argument: object) -> None:
        nonlocal launches, barriers, calls, began
        code = frame.f_code
        if code in kernels:
            if event == "call":
                launches, began = launches + 1, time.perf_counter()
            elif event == "return":
                stage = view.timer.stage
                spent[stage] = spent.get(stage, 0.0) + 1000 * (time.perf_counter() - began)
        elif event in ("call", "c_call"):
            calls += 1
            barriers += event == "call" and code is sharing
            if code.co_filename.startswith(CORE):
                files.add(code.co_filename)

    sys.setprofile(count)
    try:
        slam.process(view)
    finally:
        sys.setprofile(None)
    return {"launches": launches, "barriers": barriers, "calls": calls, "files": len(files)}, spent
