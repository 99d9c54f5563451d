"""Speed and memory on this machine, beside what they should be."""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dudmap.benchmark.entries import Entry
from dudmap.benchmark.measure import Row, in_own_process
from dudmap.benchmark.table import grid
from dudmap.config import Config
from dudmap.errors import DudmapError

if TYPE_CHECKING:
    from dudmap.frames.frame import Frame
    from dudmap.sequences import Sequence
    from dudmap.slam import Slam

WARM_UP = 10
"""First frames of a run that are not timed."""
IN_TURN = 20
"""Frames of one system before it is the other's turn."""


class Figure(NamedTuple):
    """One line of the table: what was measured, its unit, the largest value wanted (None = any), what came out."""

    what: str
    unit: str
    target: float | None
    measured: float | None
    remark: str = ""


def speed_figures(
    frames: int,
    long_frames: int = 0,
    say: Callable[[str], None] = lambda text: None,
    open3d: str | None = None,
    recording: Path | None = None,
) -> list[Figure]:
    """All figures, each measured in a fresh process.

    Args:
        frames: Length of the recordings that are timed.
        long_frames: Length of the walk through new space that shows whether time per frame grows; 0 leaves it out.
        say: Called with what is measured next.
        open3d: A Python that has open3d, whose dense SLAM is then timed beside ours; None leaves it out.
        recording: Recording for that; None takes a synthetic room in which nothing moves.

    Raises:
        DudmapError: A measurement failed.
    """
    figures: list[Figure] = []
    say("frames at 1, 2 and 0.5 cm voxels")
    for voxel, median, p95 in ((0.01, 33.0, 50.0), (0.02, 20.0, None), (0.005, 70.0, None)):
        row = _ask(_time_frames, (voxel, frames))
        name = f"frame, {100 * voxel:g} cm voxels"
        figures.append(Figure(f"{name}, median", "ms", median, row["median"]))
        if p95 is not None:
            figures.append(Figure(f"{name}, 95th percentile", "ms", p95, row["p95"]))
            figures += _map_figures(row)
            figures.append(Figure("artificial view, 320x240", "ms", 40.0, row["view_ms"]))
    say("one registration iteration on one thread")
    with _environment(DUDMAP_THREADS="1"):
        row = _ask(_time_iteration, 40)
    figures.append(Figure("registration iteration, 320x240, one thread", "ms", 1.5, row["iteration_ms"]))
    say("starting")
    figures += _start_times()
    if long_frames:
        say(f"{long_frames} frames through new space")
        row = _ask(_time_walk, long_frames)
        remark = f"{long_frames} frames, {row['first_ms']:.1f} to {row['last_ms']:.1f} ms"
        figures.append(Figure("growth: last 10 % of the frames over the first", "x", 1.1, row["growth"], remark))
        remark = f"{row['stale']} chunks; all of the map takes {row['mesh_ms']:.0f} ms"
        figures.append(Figure("mesh again after one frame, end of the walk", "ms", None, row["again_ms"], remark))
    if open3d is not None:
        say("Open3D's dense SLAM and ours in turn")
        figures += _open3d_figures(open3d, recording, frames)
    return figures


def _map_figures(row: Row) -> list[Figure]:
    again = f"{row['stale']} chunks; all of the map takes {1000 * row['mesh_whole_s']:.0f} ms"
    return [
        Figure("map memory per occupied block, KB of 1024 bytes", "KB", 4.2, row["bytes_per_block"] / 1024),
        Figure("free space, share of what its voxels would cost", "%", 1.0, 100 * row["free_share"]),
        Figure("mesh, per million triangles", "s", 0.5, row["mesh_s"], f"{row['triangles']} triangles"),
        Figure("mesh again after one frame", "ms", None, row["again_ms"], again),
    ]


def _open3d_figures(python: str, recording: Path | None, frames: int) -> list[Figure]:
    from dudmap.benchmark.interleaved import compare_with_open3d

    static_room = Entry("room-static", parameters={"movers": (), "frames": frames})
    entry = static_room if recording is None else Entry(recording.resolve().name, recording)
    result = compare_with_open3d(python, entry, frames)
    name, times = f"{entry.name}, {result.frames} frames", f"{result.ours_ms:.1f} to {result.theirs_ms:.1f} ms"
    figures = [
        Figure("frame, over Open3D's dense SLAM", "x", 1 / 3, result.ours_ms / result.theirs_ms, f"{name}, {times}")
    ]
    if result.ours_ate is not None and result.theirs_ate is not None:
        errors = f"{100 * result.ours_ate:.2f} to {100 * result.theirs_ate:.2f} cm; Open3D {result.version}"
        figures.append(Figure("ATE, over Open3D's dense SLAM", "x", 1.0, result.ours_ate / result.theirs_ate, errors))
    return figures


def markdown(figures: list[Figure]) -> str:
    """The figures as a Markdown table."""
    body = [
        [
            figure.what,
            "" if figure.target is None else f"<= {figure.target:.3g} {figure.unit}",
            "nothing" if figure.measured is None else f"{figure.measured:.3g} {figure.unit}",
            "" if figure.target is None else "yes" if _reached(figure.measured, figure.target) else "NO",
            figure.remark,
        ]
        for figure in figures
    ]
    return grid(["what", "target", "measured", "reached", "remark"], body, words=1)


def _reached(measured: float | None, target: float) -> bool:
    return measured is not None and measured <= target


def _ask(function: Callable[[Any], Row], argument: Any) -> Row:  # noqa: ANN401
    row = in_own_process(function, argument)
    if "error" in row:
        raise DudmapError(f"the speed could not be measured: {row['error']}")
    return row


@contextmanager
def _environment(**variables: str) -> Iterator[None]:
    """Environment variables for the processes started within."""
    old = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in old.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


def _room(frames: int) -> "Sequence":
    return Entry("room-person", parameters={"frames": frames, "start_dynamic": False}).open()


def _processed(config: Config, sequence: "Sequence", frames: int) -> "Iterator[tuple[Slam, float]]":
    """The system and the milliseconds of every frame of a recording, until it and the next one, which is made ready
    meanwhile as in a run, are both done; rendering is not timed."""
    from dudmap.slam import Slam

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


def _time_frames(job: tuple[float, int]) -> Row:
    """Frames, then mesh and view of the map they left; every time is the best of what a warm program gives."""
    voxel, frames = job
    slam, times, sequence = None, [], _room(frames + 1)
    for slam, ms in _processed(Config().override([f"volume.voxel_size={voxel}"]), sequence, frames):  # noqa: B007
        times.append(ms)
    assert slam is not None
    timed = np.array(times[WARM_UP:] or times)
    row: Row = {"median": float(np.median(timed)), "p95": float(np.percentile(timed, 95))}
    row["bytes_per_block"] = slam.volume.num_bytes / max(slam.volume.num_blocks, 1)
    row["free_share"] = slam.volume.entry_bytes / (2 * 512 * 4)
    pose, view = slam.trajectory.Ts_world_camera[-1], slam.camera.resized(320, 240)
    seconds, mesh = _median_seconds(slam.volume.extract_mesh, 3)
    row |= {"triangles": len(mesh.faces), "mesh_whole_s": seconds, "mesh_s": seconds * 1e6 / max(len(mesh.faces), 1)}
    row["view_ms"] = 1000 * _median_seconds(lambda: slam.volume.raycast(pose, view), 10)[0]
    return row | _time_again(slam, sequence[frames])


def _time_again(slam: "Slam", frame: "Frame") -> Row:
    """Extraction of what one more frame changed in the mesh, and how many chunks that are."""
    from dudmap.mapping.incremental_mesh import IncrementalMesh

    live = IncrementalMesh(slam.volume)
    live.update()
    slam.process(frame)
    start = time.perf_counter()
    stale = live.update()
    return {"again_ms": 1000 * (time.perf_counter() - start), "stale": len(stale)}


def _median_seconds(action: Callable[[], Any], times: int) -> tuple[float, Any]:
    """Median duration after one call that warms up, and the last result."""
    result, seconds = action(), []
    for _ in range(times):
        start = time.perf_counter()
        result = action()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds), result


def _time_iteration(frames: int) -> Row:
    """One linearisation of the level that is 320 pixels wide, against the map of a few frames."""
    from dudmap.frames.observation import Level
    from dudmap.frames.pyramid import halved

    sequence = _room(frames)
    slam = None
    for slam, _ in _processed(Config(), sequence, frames):  # noqa: B007
        pass
    assert slam is not None
    halvings = round(np.log2(slam.camera.width / 320))
    depth, intensity = halved(slam.preprocess(sequence[frames - 1]), halvings)
    level = Level(slam.camera.scaled(halvings), depth, intensity)
    pose, weights = slam.trajectory.Ts_world_camera[-1], np.ones_like(depth)
    slam.volume.look_at(pose)
    seconds, _ = _median_seconds(lambda: slam.tracker.linearize(slam.volume, level, pose, weights), 100)
    return {"iteration_ms": 1000 * seconds}


def _time_walk(frames: int) -> Row:
    """Median time of the first and the last tenth of a walk through space that is always new.

    The machine's speed changes within minutes, so a second system walks the first tenth while the first one walks the
    last, a few frames each in turn.
    """
    from dudmap.benchmark.passage import passage

    sequence, slam = passage(frames + 1), None
    start = min(60, frames // 4)
    tenth = max((frames - start) // 10, 1)
    old, new = _processed(Config(), sequence, frames), _processed(Config(), sequence, frames)
    for _ in range(frames - tenth):
        slam, _ = next(old)
    for _ in range(start):
        next(new)
    first: list[float] = []
    last: list[float] = []
    while len(last) < tenth:
        for walk, times in ((new, first), (old, last)):
            times += [next(walk)[1] for _ in range(min(IN_TURN, tenth - len(times)))]
    assert slam is not None
    row: Row = {"first_ms": statistics.median(first), "last_ms": statistics.median(last)}
    row["growth"] = row["last_ms"] / row["first_ms"]
    row["mesh_ms"] = 1000 * _median_seconds(slam.volume.extract_mesh, 1)[0]
    return row | _time_again(slam, sequence[frames])


FIRST_POSE = """
import os, sys
from pathlib import Path
from dudmap.config import Config
from dudmap.pipeline.run import run
from dudmap.sequences import open_sequence

def first(index, reading, result):
    if index == 1:
        print("pose", flush=True)
        os._exit(0)

run(open_sequence(sys.argv[1]), Config(), Path(sys.argv[1]) / "run", max_frames=3, progress=False, observe=first)
"""
"""The first pose that had to be computed is the second frame's: the first one's is the identity."""


def _start_times() -> list[Figure]:
    """Time of import, help, and from the start of the program to the first computed pose."""
    from dudmap.synthetic.folder import write_folder

    figures = [
        Figure("import dudmap", "s", 0.15, _of_program(["-c", "import dudmap"]) - _of_program(["-c", ""])),
        Figure("dudmap --help", "s", 0.4, _of_program(["-m", "dudmap", "--help"])),
    ]
    with tempfile.TemporaryDirectory(prefix="dudmap-") as temporary:
        recording = Path(temporary) / "recording"
        write_folder(Entry("room-person", parameters={"frames": 3}).open(), recording, surface=False)  # type: ignore[arg-type]
        first_pose = ["-c", FIRST_POSE, str(recording)]
        _of_program(first_pose, 1)
        figures.append(Figure("to the first pose, kernels cached", "s", 1.5, _of_program(first_pose, 3)))
        with _environment(NUMBA_CACHE_DIR=str(Path(temporary) / "cache")):
            figures.append(Figure("to the first pose, nothing cached", "s", 20.0, _of_program(first_pose, 1)))
    return figures


def _of_program(arguments: list[str], times: int = 5) -> float:
    """Median duration of a Python program, seconds.

    Raises:
        DudmapError: It fails.
    """
    seconds = []
    for _ in range(times):
        start = time.perf_counter()
        done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=False)
        seconds.append(time.perf_counter() - start)
        if done.returncode:
            raise DudmapError(f"a program that should be timed failed: {done.stderr.strip().splitlines()[-1]}")
    return statistics.median(seconds)
