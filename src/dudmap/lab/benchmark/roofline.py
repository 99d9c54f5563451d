"""What a frame costs: calls and files, and bytes and operations beside what this machine can move and compute."""

import gc
import sys
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import median
from types import FrameType
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit
from numba.core.dispatcher import Dispatcher

from dudmap.config import Config
from dudmap.core import slam as slam_module
from dudmap.core.backends import threads
from dudmap.core.backends.threads import num_threads
from dudmap.core.slam import Slam
from dudmap.lab.benchmark.measure import grid
from dudmap.lab.benchmark.speed import WARM_UP
from dudmap.lab.synthetic import sequence

if TYPE_CHECKING:
    from dudmap.io.sequences import Sequence

FLOPS_PER_PIXEL, FLOPS_PER_VOXEL, FLOPS_PER_TAP = 300, 150, 22
"""One linearisation, fusion of one voxel, and one pair of taps of the bilateral filter: counted in the unvectorised
code that the compiler makes of each; comparisons are free."""
BYTES_PER_PIXEL = 12 + 8 * 4 + 8
"""One linearisation: depth, intensity, weight; eight voxels; two residuals."""
BYTES_PER_VOXEL = 2 * 8
"""Fusion: distance, weight, intensity and colour, read and written."""


@njit(nogil=True, fastmath={"contract"})
def _triad(a, b, c, scale):  # noqa: ANN001, ANN202
    for n in range(a.size):
        a[n] = b[n] + scale * c[n]


@njit(nogil=True, fastmath={"contract"})
def _multiply_add(data, rounds):  # noqa: ANN001, ANN202
    """32 multiply-adds per element in registers, in two chains; the loop over elements keeps all units busy."""
    half, quarter = np.float32(0.5), np.float32(0.25)
    for _ in range(rounds):
        for n in range(data.size):
            a = b = x = data[n]
            for _ in range(16):
                a, b = a * half + x, b * quarter + x
            data[n] = (a + b) * quarter * half


def _best_seconds(threads: int, work: Callable[[int], object]) -> float:
    """Best of five times in which all threads are done; ``work(k)`` is what thread k does."""
    seconds = []
    with ThreadPoolExecutor(threads) as pool:
        for _ in range(5):
            start = time.perf_counter()
            list(pool.map(work, range(threads)))
            seconds.append(time.perf_counter() - start)
    return min(seconds)


def rates(threads: int) -> tuple[float, float]:
    """Bytes per second of a triad over arrays that fit no cache, and single-precision operations per second."""
    size, rounds = (1 << 26) // threads, 3000
    arrays = [[np.zeros(size, np.float32) for _ in range(3)] for _ in range(threads)]
    data = [np.ones(2048, np.float32) for _ in range(threads)]
    first, second, third = (array[:8] for array in arrays[0])
    _triad(first, second, third, np.float32(2))
    _multiply_add(data[0], 1)
    seconds = _best_seconds(threads, lambda k: _triad(arrays[k][0], arrays[k][1], arrays[k][2], np.float32(2)))
    computed = threads * rounds * 2048 * 64 / _best_seconds(threads, lambda k: _multiply_add(data[k], rounds))
    return 3 * 4 * size * threads / seconds, computed


def counted(frames: int, voxel: float) -> tuple[dict[str, float], Slam]:
    """Medians per frame of the time of each stage, pixels linearised, iterations and blocks written; and the system."""
    recording = sequence(movers=("person",), frames=frames)
    slam = Slam(recording.camera, Config().override([f"volume.voxel_size={voxel}"]))
    pixels: Counter[str] = Counter()
    tracker: Any = slam.tracker
    descend = tracker._descend

    def descending(volume: Any, level: Any, *rest: Any) -> Any:  # noqa: ANN401
        found = descend(volume, level, *rest)
        pixels.update(linearised=found.iterations * level.depth.size, iterations=found.iterations)
        return found

    tracker._descend = descending
    rows = []
    for index in range(frames):
        frame, fused = recording[index], slam.volume.num_integrated
        pixels.clear()
        start = time.perf_counter()
        result = slam.process(frame)
        row = {"total": 1000 * (time.perf_counter() - start), **result.timings, **pixels}
        rows.append(row | {"blocks": len(slam.volume.written_since(fused)[0])})
    rows = rows[WARM_UP:] or rows
    return {key: float(np.median([row.get(key, 0.0) for row in rows])) for row in rows for key in row}, slam


def stages(measured: dict[str, float], slam: Slam) -> list[tuple[str, float, float, float]]:
    """Name, bytes, operations and milliseconds taken of every stage that has a bound worth naming."""
    pixels, voxels = slam.camera.width * slam.camera.height, 512 * measured["blocks"]
    taps = 2 * slam.config.preprocess.filter_radius
    linearised, took = measured["linearised"], measured.get("track", 0) + measured.get("track_again", 0)
    registration = f"registration, {measured['iterations']:.0f} linearisations"
    fusion = f"fusion, {measured['blocks']:.0f} blocks"
    return [
        ("filter and pyramid", pixels * (3 + 2 + 4 * 4), pixels * taps * FLOPS_PER_TAP, measured["preprocess"]),
        (registration, linearised * BYTES_PER_PIXEL, linearised * FLOPS_PER_PIXEL, took),
        (fusion, voxels * BYTES_PER_VOXEL + pixels * 13, voxels * FLOPS_PER_VOXEL, measured["integrate"]),
    ]


def roofline(frames: int, voxel: float) -> tuple[dict[str, Any], str]:
    """What this machine can do and what each stage took, beside the least time that its bytes and operations allow.

    The recording is a synthetic room with a person; voxels in metres. Returns the figures, and two Markdown tables.
    """
    found = {threads: rates(threads) for threads in sorted({1, num_threads()})}
    moved, computed = found[num_threads()]
    measured, slam = counted(frames, voxel)
    body, least, taken = [], 0.0, 0.0
    for name, size, operations, ms in stages(measured, slam):
        bounds = 1000 * size / moved, 1000 * operations / computed
        costs = f"{size / 1e6:.1f}", f"{operations / 1e6:.0f}", *(f"{bound:.2f}" for bound in bounds)
        body.append([name, *costs, f"{ms:.1f}", f"{ms / max(bounds):.0f}"])
        least, taken = least + max(bounds), taken + ms
    total = measured["total"]
    body.append(["everything else", "", "", "", "", f"{total - taken:.1f}", ""])
    body.append(["frame", "", "", f"{least:.1f}", "", f"{total:.1f}", f"{total / least:.0f}"])
    head = ["stage", "MB", "Mflop", "least ms, bytes", "least ms, operations", "took, ms", "times the bound"]
    lines = [[str(threads), f"{a / 1e9:.1f}", f"{b / 1e9:.0f}"] for threads, (a, b) in found.items()]
    text = grid(["threads", "triad, GB/s", "multiply-add, Gflop/s"], lines, words=1) + "\n" + grid(head, body, words=1)
    content = {str(threads): {"bytes_per_s": a, "flops": b} for threads, (a, b) in found.items()}
    return {"measured": measured, "rates": content}, text


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
