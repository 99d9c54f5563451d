"""Speed and memory on this machine, compared with their targets."""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from dudmap.errors import DudmapError
from dudmap.lab.benchmark.entries import Entry
from dudmap.lab.benchmark.measure import Row, in_own_process
from dudmap.lab.benchmark.table import grid
from dudmap.lab.benchmark.timing import time_frames, time_iteration, time_walk


class SpeedFigure(NamedTuple):
    """One row of the table: quantity, unit, largest acceptable value (None = no target), and measured value."""

    what: str
    unit: str
    target: float | None
    measured: float | None
    remark: str = ""


def speed_figures(
    frames: int,
    long_frames: int = 0,
    announce: Callable[[str], None] = lambda text: None,
    open3d: str | None = None,
    recording: Path | None = None,
) -> list[SpeedFigure]:
    """Measure all figures, each in a new process.

    Args:
        frames: Number of frames of the timed recordings.
        long_frames: Number of frames of the walk through unseen space, which shows whether the time per frame grows; 0
            skips it.
        announce: Called with a description of the next measurement.
        open3d: Python interpreter with Open3D, for the comparison with its dense SLAM; None skips it.
        recording: Recording of that comparison; None takes a static synthetic room.

    Raises:
        DudmapError: A measurement failed.
    """
    figures: list[SpeedFigure] = []
    announce("frames at 1, 2 and 0.5 cm voxels")
    for voxel, median, p95 in ((0.01, 20.0, 50.0), (0.02, 14.0, None), (0.005, 40.0, None)):
        row = _measured(time_frames, (voxel, frames))
        name = f"frame, {100 * voxel:g} cm voxels"
        figures.append(SpeedFigure(f"{name}, median", "ms", median, row["median"]))
        if p95 is not None:
            figures.append(SpeedFigure(f"{name}, 95th percentile", "ms", p95, row["p95"]))
            figures += _map_figures(row)
            figures.append(SpeedFigure("artificial view, 320x240", "ms", 40.0, row["view_ms"]))
    announce("one registration iteration on one thread")
    with _environment(DUDMAP_THREADS="1"):
        row = _measured(time_iteration, 40)
    figures.append(SpeedFigure("registration iteration, 320x240, one thread", "ms", 1.5, row["iteration_ms"]))
    announce("starting")
    figures += _start_times()
    if long_frames:
        announce(f"{long_frames} frames through new space")
        row = _measured(time_walk, long_frames)
        remark = f"{long_frames} frames, {row['first_ms']:.1f} to {row['last_ms']:.1f} ms"
        figures.append(SpeedFigure("growth: last 10 % of the frames over the first", "x", 1.1, row["growth"], remark))
        remark = f"{row['stale']} chunks; all of the map takes {row['mesh_ms']:.0f} ms"
        figures.append(SpeedFigure("mesh again after one frame, end of the walk", "ms", None, row["again_ms"], remark))
    if open3d is not None:
        announce("Open3D's dense SLAM and ours in turn")
        figures += _open3d_figures(open3d, recording, frames)
    return figures


def _map_figures(row: Row) -> list[SpeedFigure]:
    again = f"{row['stale']} chunks; all of the map takes {1000 * row['mesh_whole_s']:.0f} ms"
    return [
        SpeedFigure("map memory per occupied block, KB of 1024 bytes", "KB", 4.2, row["bytes_per_block"] / 1024),
        SpeedFigure("free space, share of what its voxels would cost", "%", 1.0, 100 * row["free_share"]),
        SpeedFigure("mesh, per million triangles", "s", 0.5, row["mesh_s"], f"{row['triangles']} triangles"),
        SpeedFigure("mesh again after one frame", "ms", None, row["again_ms"], again),
    ]


def _open3d_figures(python: str, recording: Path | None, frames: int) -> list[SpeedFigure]:
    from dudmap.lab.benchmark.interleaved import compare_with_open3d

    static_room = Entry("room-static", parameters={"movers": (), "frames": frames})
    entry = static_room if recording is None else Entry(recording.resolve().name, recording)
    result = compare_with_open3d(python, entry, frames)
    name, times = f"{entry.name}, {result.frames} frames", f"{result.ours_ms:.1f} to {result.theirs_ms:.1f} ms"
    figures = [
        SpeedFigure(
            "frame, over Open3D's dense SLAM", "x", 1 / 3, result.ours_ms / result.theirs_ms, f"{name}, {times}"
        )
    ]
    if result.ours_ate is not None and result.theirs_ate is not None:
        errors = f"{100 * result.ours_ate:.2f} to {100 * result.theirs_ate:.2f} cm; Open3D {result.version}"
        figures.append(
            SpeedFigure("ATE, over Open3D's dense SLAM", "x", 1.0, result.ours_ate / result.theirs_ate, errors)
        )
    return figures


def markdown(figures: list[SpeedFigure]) -> str:
    """The figures as a Markdown table."""
    body = [
        [
            figure.what,
            "" if figure.target is None else f"<= {figure.target:.3g} {figure.unit}",
            "none" if figure.measured is None else f"{figure.measured:.3g} {figure.unit}",
            "" if figure.target is None else "yes" if _reached(figure.measured, figure.target) else "NO",
            figure.remark,
        ]
        for figure in figures
    ]
    return grid(["what", "target", "measured", "reached", "remark"], body, words=1)


def _reached(measured: float | None, target: float) -> bool:
    return measured is not None and measured <= target


def _measured(function: Callable[[Any], Row], argument: Any) -> Row:  # noqa: ANN401
    row = in_own_process(function, argument)
    if "error" in row:
        raise DudmapError(f"the speed could not be measured: {row['error']}")
    return row


@contextmanager
def _environment(**variables: str) -> Iterator[None]:
    """Set environment variables for the processes that are started in this context."""
    old = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in old.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


FIRST_POSE = """
import os, sys
from pathlib import Path
from dudmap.config import Config
from dudmap.app.pipeline.observer import RunObserver
from dudmap.app.pipeline.run import run
from dudmap.io.sequences import open_sequence

class First(RunObserver):
    def frame(self, index, read, result, ms):
        if index == 1:
            print("pose", flush=True)
            os._exit(0)

run(open_sequence(sys.argv[1]), Config(), Path(sys.argv[1]) / "run", max_frames=3, progress=False, observers=(First(),))
"""
"""Program that ends at the first computed pose, that of the second frame; the first one is the identity."""


def _start_times() -> list[SpeedFigure]:
    """Times of the import, of the help page, and from the start of the program to the first computed pose."""
    from dudmap.lab.synthetic.folder import write_folder

    figures = [
        SpeedFigure("import dudmap", "s", 0.15, program_seconds(["-c", "import dudmap"]) - program_seconds(["-c", ""])),
        SpeedFigure("dudmap --help", "s", 0.4, program_seconds(["-m", "dudmap", "--help"])),
    ]
    with tempfile.TemporaryDirectory(prefix="dudmap-") as temporary:
        recording = Path(temporary) / "recording"
        write_folder(Entry("room-person", parameters={"frames": 3}).open(), recording, surface=False)  # type: ignore[arg-type]
        first_pose = ["-c", FIRST_POSE, str(recording)]
        program_seconds(first_pose, 1)
        figures.append(SpeedFigure("to the first pose, kernels cached", "s", 1.5, program_seconds(first_pose, 3)))
        with _environment(NUMBA_CACHE_DIR=str(Path(temporary) / "cache")):
            figures.append(SpeedFigure("to the first pose, nothing cached", "s", 20.0, program_seconds(first_pose, 1)))
    return figures


def program_seconds(arguments: list[str], times: int = 5) -> float:
    """Median duration of a Python program, seconds.

    Raises:
        DudmapError: The program fails.
    """
    seconds = []
    for _ in range(times):
        start = time.perf_counter()
        done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=False)
        seconds.append(time.perf_counter() - start)
        if done.returncode:
            raise DudmapError(f"a program that should be timed failed: {done.stderr.strip().splitlines()[-1]}")
    return statistics.median(seconds)
