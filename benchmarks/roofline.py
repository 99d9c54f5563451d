"""What a frame must cost: bytes and operations of the default pipeline, and what this machine can move and compute.

    python benchmarks/roofline.py [--frames 60] [--voxel 0.01] [--out DIR]

Measures the memory bandwidth (triad over arrays that fit no cache) and the peak of fused multiply-add in single
precision with all threads and with one, then runs the system on the synthetic room with a person, counts what it
touches, and prints per stage the least time that its bytes and its operations allow beside the time it took.
"""

import argparse
import json
import time
from collections import Counter
from pathlib import Path

import numpy as np
from numba import njit

from dudmap.app.pipeline.environment import machine, versions
from dudmap.config import Config
from dudmap.core.backends.threads import num_threads
from dudmap.core.slam import Slam
from dudmap.lab.benchmark.table import grid
from dudmap.lab.synthetic import sequence

FLOPS_PER_PIXEL = 300
"""One linearisation: counted in the unvectorised code that the compiler makes of it; comparisons are free."""
FLOPS_PER_VOXEL = 150
"""Fusion of one voxel, counted likewise."""
FLOPS_PER_TAP = 22
"""One pair of taps of the bilateral filter, counted likewise."""
BYTES_PER_PIXEL = 12 + 8 * 4 + 8
"""One linearisation: depth, intensity, weight; eight voxels; two residuals."""
BYTES_PER_VOXEL = 2 * 8
"""Fusion: distance, weight, intensity and colour, read and written."""
WARM_UP = 10
MEGABYTE, MEGAFLOP = 1e6, 1e6


@njit(nogil=True, fastmath={"contract"})
def triad(a, b, c, scale):
    """a = b + scale c."""
    for n in range(a.size):
        a[n] = b[n] + scale * c[n]


@njit(nogil=True, fastmath={"contract"})
def _eight(y, x, c):
    y = y * x + c
    y = y * x + c
    y = y * x + c
    y = y * x + c
    y = y * x + c
    y = y * x + c
    y = y * x + c
    return y * x + c


@njit(nogil=True, fastmath={"contract"})
def multiply_add(data, rounds):
    """32 multiply-adds per element in registers, in two chains; the loop over elements keeps all units busy."""
    half, quarter = np.float32(0.5), np.float32(0.25)
    for _ in range(rounds):
        for n in range(data.size):
            x = data[n]
            a = _eight(_eight(x, half, x), half, x)
            b = _eight(_eight(x, quarter, x), quarter, x)
            data[n] = (a + b) * quarter * half


def in_threads(threads, work):
    """Best of five times (s) in which all threads are done; ``work(k)`` is what thread k does."""
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(threads) as pool:
        seconds = []
        for _ in range(5):
            start = time.perf_counter()
            list(pool.map(work, range(threads)))
            seconds.append(time.perf_counter() - start)
    return min(seconds)


def bandwidth(threads):
    """Bytes per second of the triad: two arrays read, one written (the line it fetches first is not counted)."""
    size = (1 << 26) // threads
    arrays = [[np.zeros(size, np.float32) for _ in range(3)] for _ in range(threads)]
    triad(*(array[:8] for array in arrays[0]), np.float32(2))
    return 3 * 4 * size * threads / in_threads(threads, lambda k: triad(*arrays[k], np.float32(2)))


def peak(threads):
    """Single-precision operations per second; a fused multiply-add is two."""
    arrays = [np.ones(2048, np.float32) for _ in range(threads)]
    multiply_add(arrays[0], 1)
    rounds = 3000
    return threads * rounds * 2048 * 32 * 2 / in_threads(threads, lambda k: multiply_add(arrays[k], rounds))


def counted(frames, voxel):
    """Per frame (medians over frames): time of each stage, pixels linearised per stage, blocks written; and sizes."""
    recording = sequence(movers=("person",), frames=frames)
    slam = Slam(recording.camera, Config().override([f"volume.voxel_size={voxel}"]))
    pixels = Counter()
    linearize, descend = slam.tracker.linearize, slam.tracker._descend

    def count(level, iterations):
        pixels["linearised"] += iterations * level.depth.size
        pixels["iterations"] += iterations

    def linearizing(volume, level, *rest, **named):
        count(level, 1)
        return linearize(volume, level, *rest, **named)

    def descending(volume, level, *rest):
        found = descend(volume, level, *rest)
        count(level, found.iterations)
        return found

    slam.tracker.linearize, slam.tracker._descend = linearizing, descending
    rows = []
    for index in range(frames):
        frame = recording[index]
        pixels.clear()
        fused = slam.volume.num_integrated
        start = time.perf_counter()
        result = slam.process(frame)
        row = {"total": 1000 * (time.perf_counter() - start), **result.timings, **pixels}
        row["blocks"] = len(slam.volume.written_since(fused)[0])
        rows.append(row)
    rows = rows[WARM_UP:] or rows
    keys = {key for row in rows for key in row}
    return {key: float(np.median([row.get(key, 0.0) for row in rows])) for key in keys}, slam


def stages(measured, slam):
    """Name, bytes, operations and milliseconds taken of every stage that has a bound worth naming."""
    pixels = slam.camera.width * slam.camera.height
    radius = slam.config.preprocess.filter_radius
    voxels = 512 * measured["blocks"]
    return [
        ("filter and pyramid", pixels * (3 + 2 + 4 * 4), pixels * (2 * radius * FLOPS_PER_TAP), measured["preprocess"]),
        (
            f"registration, {measured['iterations']:.0f} linearisations",
            measured["linearised"] * BYTES_PER_PIXEL,
            measured["linearised"] * FLOPS_PER_PIXEL,
            measured.get("track", 0) + measured.get("track_again", 0),
        ),
        (
            f"fusion, {measured['blocks']:.0f} blocks",
            voxels * BYTES_PER_VOXEL + pixels * 13,
            voxels * FLOPS_PER_VOXEL,
            measured["integrate"],
        ),
    ]


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--voxel", type=float, default=0.01)
    parser.add_argument("--out", type=Path, default=Path("runs/benchmark/roofline"))
    options = parser.parse_args()
    threads = num_threads()
    rates = {n: (bandwidth(n), peak(n)) for n in sorted({1, threads})}
    text = grid(
        ["threads", "triad, GB/s", "multiply-add, Gflop/s"],
        [[str(n), f"{moved / 1e9:.1f}", f"{computed / 1e9:.0f}"] for n, (moved, computed) in rates.items()],
        words=1,
    )
    measured, slam = counted(options.frames, options.voxel)
    moved, computed = rates[threads]
    body, least, taken = [], 0.0, 0.0
    for name, size, operations, ms in stages(measured, slam):
        by_bytes, by_operations = 1000 * size / moved, 1000 * operations / computed
        bound = max(by_bytes, by_operations)
        costs = f"{size / MEGABYTE:.1f}", f"{operations / MEGAFLOP:.0f}", f"{by_bytes:.2f}", f"{by_operations:.2f}"
        body.append([name, *costs, f"{ms:.1f}", f"{ms / bound:.0f}"])
        least, taken = least + bound, taken + ms
    rest = measured["total"] - taken
    body.append(["labels, similarity, movers, everything else", "", "", "", "", f"{rest:.1f}", ""])
    body.append(["frame", "", "", f"{least:.1f}", "", f"{measured['total']:.1f}", f"{measured['total'] / least:.0f}"])
    text += "\n" + grid(
        ["stage", "MB", "Mflop", "least ms, bytes", "least ms, operations", "took, ms", "times the bound"],
        body,
        words=1,
    )
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "roofline.md").write_text(text, encoding="utf-8")
    content = {"machine": machine(), "versions": versions(), "measured": measured}
    content["rates"] = {str(n): {"bytes_per_s": a, "flops": b} for n, (a, b) in rates.items()}
    (options.out / "roofline.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
