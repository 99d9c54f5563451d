"""Speed and memory against targets, in new processes. Failures raise a ``DudmapError``."""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dudmap.config import Config
from dudmap.errors import DudmapError
from dudmap.evaluation.tables import grid
from dudmap.lab.benchmark.calls import COUNTED_FROM, count_calls, memory_rate, stage_table
from dudmap.lab.benchmark.measure import Row, in_own_process
from dudmap.lab.benchmark.suites import Entry

if TYPE_CHECKING:
    from dudmap.core.frames.frame import Frame
    from dudmap.core.slam import Slam
    from dudmap.io.sequences import Sequence

WARM_UP = 10
FRAME_TARGETS = {0.01: 20.0, 0.02: 14.0, 0.005: 40.0}
"""Largest acceptable median ms per frame, by voxel size, metres."""


class SpeedFigure(NamedTuple):
    """Quantity, unit, largest acceptable value (None = no target), measured value."""

    what: str
    unit: str
    target: float | None
    measured: float | None
    remark: str = ""


def speed_figures(
    frames: int,
    announce: Callable[[str], None] = lambda text: None,
    open3d: Path | None = None,
    recording: Path | None = None,
) -> list[SpeedFigure]:
    """Measure all quantities; ``announce`` receives the next measurement.

    Args:
        open3d: Interpreter with Open3D, for the comparison; None skips it.
    """
    figures, compared = list[SpeedFigure](), list[SpeedFigure]()
    if open3d is not None:  # first, because the other program may not start
        announce("Open3D's dense SLAM and dudmap alternately")
        compared = _open3d_figures(open3d, recording, frames)
    announce("frames at 1, 2 and 0.5 cm voxels")
    for voxel, target in FRAME_TARGETS.items():
        row = _measured(time_frames, (voxel, frames))
        figures.append(SpeedFigure(f"frame, {100 * voxel:g} cm voxels, median", "ms", target, row["median"]))
        if voxel == Config().volume.voxel_size:
            again = f"{row['stale']} chunks; all of the map takes {1000 * row['mesh_whole_s']:.0f} ms"
            block, free = row["bytes_per_block"] / 1024, 100 * row["free_share"]
            figures += [
                SpeedFigure(f"frame, {100 * voxel:g} cm voxels, 95th percentile", "ms", 50.0, row["p95"]),
                SpeedFigure("map memory per occupied block, KB of 1024 bytes", "KB", 4.2, block),
                SpeedFigure("free space, share of the cost of its voxels", "%", 1.0, free),
                SpeedFigure("mesh, per million triangles", "s", 0.5, row["mesh_s"], f"{row['triangles']} triangles"),
                SpeedFigure("mesh again after one frame", "ms", None, row["again_ms"], again),
                SpeedFigure("artificial view, 320x240", "ms", 40.0, row["view_ms"]),
            ]
    announce("one registration iteration on one thread")
    row = _measured(time_iteration, 40)
    figures.append(SpeedFigure("registration iteration, 320x240, one thread", "ms", 1.5, row["iteration_ms"]))
    announce("starting")
    figures += _start_times()
    return figures + compared


def _open3d_figures(python: Path, recording: Path | None, frames: int) -> list[SpeedFigure]:
    from dudmap.lab.benchmark.open3d_comparison import compare_with_open3d

    static_room = Entry("room-static", parameters={"movers": (), "frames": frames})
    entry = static_room if recording is None else Entry(recording.resolve().name, recording)
    found = compare_with_open3d(python, entry.open(), frames)
    remark = f"{entry.name}, {found.frames} frames, {found.ours_ms:.1f} to {found.theirs_ms:.1f} ms"
    figures = [SpeedFigure("frame, over Open3D's dense SLAM", "x", 1 / 8, found.ours_ms / found.theirs_ms, remark)]
    if found.ours_ate is not None and found.theirs_ate is not None:
        remark = f"{100 * found.ours_ate:.2f} to {100 * found.theirs_ate:.2f} cm; Open3D {found.version}"
        ratio = found.ours_ate / found.theirs_ate
        figures.append(SpeedFigure("ATE, over Open3D's dense SLAM", "x", 1.0, ratio, remark))
    return figures


def markdown(figures: list[SpeedFigure]) -> str:
    """Markdown table of the results."""
    body = []
    for what, unit, target, measured, remark in figures:
        reached = measured is not None and target is not None and measured <= target
        goal = ("", "") if target is None else (f"<= {target:.3g} {unit}", "yes" if reached else "NO")
        body.append([what, goal[0], "none" if measured is None else f"{measured:.3g} {unit}", goal[1], remark])
    return grid(["what", "target", "measured", "reached", "remark"], body, words=1)


def stages() -> str:
    """Cost of an ordinary frame's stages, see ``calls.stage_table``."""
    return _measured(_stages, COUNTED_FROM + 20)["table"]


def _stages(frames: int) -> Row:
    return {"table": stage_table(count_calls(_room(frames), Config(), frames), memory_rate())}


def _measured(function: Callable[[Any], Row], argument: Any) -> Row:  # noqa: ANN401
    row = in_own_process(function, argument)
    if "error" in row:
        raise DudmapError(f"the speed could not be measured: {row['error']}")
    return row


FIRST_POSE = """
import os, sys
from pathlib import Path
from dudmap.config import Config
from dudmap.app.pipeline.observer import RunObserver
from dudmap.app.pipeline.run import run
from dudmap.io.sequences import open_sequence
from dudmap.lab.warmup import compiled_during_run

class First(RunObserver):
    def frame(self, index, read, result, ms):
        if index == 1:
            compiling.__exit__(None, None, None)
            os._exit(0)

compiling = compiled_during_run()
with compiling:
    run(
        open_sequence(sys.argv[1]), Config(), Path(sys.argv[1]) / "run", max_frames=3, progress=False,
        observers=(First(),),
    )
"""
"""Program that ends at the first computed pose, of the second frame."""


def _start_times() -> list[SpeedFigure]:
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
        anew = program_seconds(first_pose, 1, NUMBA_CACHE_DIR=str(Path(temporary) / "cache"))
        figures.append(SpeedFigure("to the first pose, nothing cached", "s", 20.0, anew))
    return figures


def program_seconds(arguments: list[str], times: int = 5, **variables: str) -> float:
    """Median duration of a Python program, seconds."""
    seconds = []
    for _ in range(times):
        start = time.perf_counter()
        command, environment = [sys.executable, *arguments], os.environ | variables
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
        seconds.append(time.perf_counter() - start)
        if done.returncode:
            raise DudmapError(f"a program that should be timed failed: {done.stderr.strip().splitlines()[-1]}")
    return statistics.median(seconds)


def _room(frames: int) -> "Sequence":
    return Entry("room-person", parameters={"frames": frames, "start_dynamic": False}).open()


def _processed(config: Config, sequence: "Sequence", frames: int) -> "Iterator[tuple[Slam, float]]":
    from dudmap.core.slam import Slam

    slam = Slam(sequence.camera, config)
    with ThreadPoolExecutor(1) as reader:
        prepared = slam.prepare(sequence[0])
        for index in range(frames):
            following = sequence[min(index + 1, frames - 1)]
            start = time.perf_counter()
            coming = reader.submit(slam.prepare, following)
            slam.process(prepared)
            prepared = coming.result()
            yield slam, 1000 * (time.perf_counter() - start)


def time_frames(job: tuple[float, int]) -> Row:
    """Times of the frames of a recording, and of mesh and view.

    Args:
        job: Voxel size in metres, number of frames.
    """
    voxel, frames = job
    slam, times, sequence = None, [], _room(frames + 1)
    for slam, ms in _processed(Config().override([f"volume.voxel_size={voxel}"]), sequence, frames):  # noqa: B007
        times.append(ms)
    assert slam is not None
    timed = np.array(times[WARM_UP:] or times)
    row: Row = {"median": float(np.median(timed)), "p95": float(np.percentile(timed, 95))}
    row["bytes_per_block"] = slam.volume.num_bytes / max(slam.volume.num_blocks, 1)
    row["free_share"] = slam.volume.blocks.entry_bytes / (2 * 512 * 4)
    pose, view = slam.trajectory.Ts_world_camera[-1], slam.camera.resized(320, 240)
    seconds, mesh = median_seconds(slam.volume.extract_mesh, 3)
    row |= {"triangles": len(mesh.faces), "mesh_whole_s": seconds, "mesh_s": seconds * 1e6 / max(len(mesh.faces), 1)}
    row["view_ms"] = 1000 * median_seconds(lambda: slam.volume.raycast(pose, view), 10)[0]
    return row | _time_again(slam, sequence[frames])


def _time_again(slam: "Slam", frame: "Frame") -> Row:
    from dudmap.core.map.incremental_mesh import IncrementalMesh

    live = IncrementalMesh(slam.volume)
    live.update()
    slam.process(frame)
    start = time.perf_counter()
    stale = live.update()
    return {"again_ms": 1000 * (time.perf_counter() - start), "stale": len(stale)}


def median_seconds(action: Callable[[], Any], times: int) -> tuple[float, Any]:
    """Median duration after a warm-up call, and the last result."""
    result, seconds = action(), []
    for _ in range(times):
        start = time.perf_counter()
        result = action()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds), result


def time_iteration(frames: int) -> Row:
    """Time of a linearisation at 320 pixels width, one thread."""
    os.environ["DUDMAP_THREADS"] = "1"
    from dudmap.core.frames.observation import Level

    sequence = _room(frames)
    slam = None
    for slam, _ in _processed(Config(), sequence, frames):  # noqa: B007
        pass
    assert slam is not None
    halvings = round(np.log2(slam.camera.width / 320))
    depth, intensity = slam.preprocess(sequence[frames - 1]).halved(halvings)
    level = Level(slam.camera.scaled(halvings), depth, intensity)
    pose, weights = slam.trajectory.Ts_world_camera[-1], np.ones_like(depth)
    slam.volume.look_at(pose)
    seconds, _ = median_seconds(lambda: slam.tracker.linearize(slam.volume, level, pose, weights), 100)
    return {"iteration_ms": 1000 * seconds}
