"""Timed runs of the system; each function is called in a new process and returns figures by name."""

import statistics
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from dudmap.config import Config
from dudmap.lab.benchmark.entries import Entry
from dudmap.lab.benchmark.measure import Row

if TYPE_CHECKING:
    from dudmap.core.frames.frame import Frame
    from dudmap.core.slam import Slam
    from dudmap.io.sequences import Sequence

WARM_UP = 10
"""Number of frames at the start of a run that are not timed."""
ALTERNATION = 20
"""Number of frames after which two systems alternate."""


def _room(frames: int) -> "Sequence":
    return Entry("room-person", parameters={"frames": frames, "start_dynamic": False}).open()


def _processed(config: Config, sequence: "Sequence", frames: int) -> "Iterator[tuple[Slam, float]]":
    """Process a recording; yields the system and the time of every frame in milliseconds.

    As in a run, the next frame is prepared meanwhile, and the time ends when both are complete. Rendering is not timed.
    """
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
    """Times of the frames of a recording, and of extracting and rendering the resulting map.

    Args:
        job: Voxel size in metres, and number of frames.
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
    seconds, mesh = _median_seconds(slam.volume.extract_mesh, 3)
    row |= {"triangles": len(mesh.faces), "mesh_whole_s": seconds, "mesh_s": seconds * 1e6 / max(len(mesh.faces), 1)}
    row["view_ms"] = 1000 * _median_seconds(lambda: slam.volume.raycast(pose, view), 10)[0]
    return row | _time_again(slam, sequence[frames])


def _time_again(slam: "Slam", frame: "Frame") -> Row:
    """Time of the incremental mesh extraction after one more frame, and number of updated chunks."""
    from dudmap.core.map.incremental_mesh import IncrementalMesh

    live = IncrementalMesh(slam.volume)
    live.update()
    slam.process(frame)
    start = time.perf_counter()
    stale = live.update()
    return {"again_ms": 1000 * (time.perf_counter() - start), "stale": len(stale)}


def _median_seconds(action: Callable[[], Any], times: int) -> tuple[float, Any]:
    """Median duration after one call for warm-up, and the last result."""
    result, seconds = action(), []
    for _ in range(times):
        start = time.perf_counter()
        result = action()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds), result


def time_iteration(frames: int) -> Row:
    """Time of one linearisation of the 320 pixels wide level against the map of the given number of frames."""
    from dudmap.core.frames.observation import Level
    from dudmap.core.frames.pyramid import halved

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


def time_walk(frames: int) -> Row:
    """Median time per frame in the first and the last tenth of a walk through unseen space.

    The speed of a machine varies within minutes. Therefore a second system processes the first tenth while the first
    one processes the last, alternating every few frames.
    """
    from dudmap.lab.benchmark.passage import passage

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
            times += [next(walk)[1] for _ in range(min(ALTERNATION, tenth - len(times)))]
    assert slam is not None
    row: Row = {"first_ms": statistics.median(first), "last_ms": statistics.median(last)}
    row["growth"] = row["last_ms"] / row["first_ms"]
    row["mesh_ms"] = 1000 * _median_seconds(slam.volume.extract_mesh, 1)[0]
    return row | _time_again(slam, sequence[frames])
