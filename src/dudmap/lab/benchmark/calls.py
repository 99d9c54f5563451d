"""What an ordinary frame costs besides arithmetic: kernel launches, barriers, Python calls and files."""

import gc
import sys
from collections.abc import Callable
from pathlib import Path
from statistics import median
from types import FrameType
from typing import TYPE_CHECKING, Any

from numba.core.dispatcher import Dispatcher

from dudmap.config import Config
from dudmap.core import slam as slam_module
from dudmap.core.backends import threads
from dudmap.core.slam import Slam

if TYPE_CHECKING:
    from dudmap.io.sequences import Sequence

CORE = str(Path(slam_module.__file__).parent)
"""Folder of the algorithm."""
COUNTED_FROM = 40
"""Frames before those that are counted: the first second has a map that knows little."""


def count_calls(sequence: "Sequence", config: Config, frames: int) -> list[dict[str, int]]:
    """Counts for each frame after the first ``COUNTED_FROM``, in the thread that calls ``Slam.process``.

    Self-calibration, which runs beside the frames, is switched off.

    Returns:
        ``launches``: calls of compiled kernels; ``barriers``: calls whose work other threads share, and which wait
            for it; ``calls``: calls of Python and C functions outside of kernels; ``files``: files of ``core`` that
            a frame enters.
    """
    config = config.override(["sensor.self_calibration=false"])
    slam = Slam(sequence.camera, config, calibration=sequence.calibration)
    counts = []
    for index in range(min(frames, len(sequence))):
        view = slam.prepare(sequence[index])
        if index < COUNTED_FROM - 1:
            slam.process(view)
        else:
            counts.append(_counted(slam.process, view))
    return counts[1:]  # the first profile of a process misses the calls of kernels


def summary(counts: list[dict[str, int]]) -> dict[str, float]:
    """Median of each count over the frames."""
    return {name: float(median(one[name] for one in counts)) for name in (counts[0] if counts else ())}


def _counted(function: Callable[[Any], object], argument: object) -> dict[str, int]:
    """The counts of one call."""
    # an isinstance would ask dead proxies
    compiled = [found for found in gc.get_objects() if issubclass(type(found), Dispatcher)]
    # formulas are inlined where kernels call them, and Python calls them uncompiled
    kernels = {found.py_func.__code__ for found in compiled if not found.targetoptions.get("forceinline")}
    sharing = threads.also_in_other_threads.__code__
    launches = barriers = calls = 0
    files: set[str] = set()

    def count(frame: FrameType, event: str, argument: object) -> None:
        nonlocal launches, barriers, calls
        code = frame.f_code
        if event == "call" and code in kernels:
            launches += 1
        elif event in ("call", "c_call"):
            calls += 1
            barriers += event == "call" and code is sharing
            if code.co_filename.startswith(CORE):
                files.add(code.co_filename)

    sys.setprofile(count)
    try:
        function(argument)
    finally:
        sys.setprofile(None)
    return {"launches": launches, "barriers": barriers, "calls": calls, "files": len(files)}
