"""What storing the state of a run costs: time of a snapshot and of writing it, size on the disk, time to go on.

The state is that of a long run: a short synthetic one is tracked, and its map, keyframes, stored frames, poses and
metrics are then repeated until they are those of 10,000 frames. Run it on a machine that does nothing else:

    python benchmarks/checkpoints.py [--frames 10000] [--blocks 40000]
"""

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from dudmap.app.pipeline.metrics import RunRecord
from dudmap.app.pipeline.storing import RunState
from dudmap.app.state.database import StateDatabase, StateReader
from dudmap.app.state.system import restore, take_snapshot
from dudmap.config import Config
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera
from dudmap.core.places.atlas import TimedPose
from dudmap.core.slam import Slam
from dudmap.lab import synthetic

CAMERA = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)
TRACKED = 40


def long_run(frames: int, blocks: int) -> tuple[RunState, list[Frame]]:
    """The state of a run over so many frames, with at least so many blocks, and the frames that follow."""
    sequence = synthetic.sequence("room", movers=("person",), frames=TRACKED + 8, camera=CAMERA, noise="kinect")
    slam, record = Slam(CAMERA, Config().override(["sensor.self_calibration=false"])), RunRecord()
    for index in range(TRACKED):
        record.add(slam.process(sequence[index]), 100.0, 5.0, None)
    atlas, store = slam.atlas, slam.atlas.history
    assert store is not None
    known = [pose.T_world_camera for pose in atlas.poses]
    early = range(frames - len(known))
    atlas.poses[:0] = [TimedPose(n - 1e5, known[n % len(known)].copy(), 0) for n in early]
    record.rows = [dict(record.rows[n % TRACKED]) for n in range(frames)]
    while len(atlas.keyframes.keyframes) < Config().relocalization.max_keyframes:
        one = atlas.keyframes.keyframes[0]
        features = replace(one.features, descriptors=one.features.descriptors.copy(), points=one.features.points.copy())
        atlas.keyframes.keyframes.insert(0, replace(one, features=features))
    for n in range(frames // 15 - len(store)):
        T = np.eye(4)
        T[0, 3] = 100.0 + n
        store.add(sequence[n % TRACKED], np.ones(CAMERA.shape, bool), T, 0)
    n = 0
    while slam.volume.num_blocks < blocks:  # rooms beside each other, 20 m apart
        T = atlas.poses[-1 - n % TRACKED].T_world_camera.copy()
        T[0, 3] += 20.0 * (1 + n // TRACKED)
        slam.volume.integrate(sequence[TRACKED - 1 - n % TRACKED], T)
        n += 1
    return RunState(slam, record, next=frames), [sequence[TRACKED + n] for n in range(8)]


def timed(function, *arguments, **options):
    """Value of a function, and the seconds and the processor time it took."""
    start, cpu = time.perf_counter(), time.process_time()
    value = function(*arguments, **options)
    return value, time.perf_counter() - start, time.process_time() - cpu


def main() -> None:
    """Print all figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--blocks", type=int, default=40_000)
    options = parser.parse_args()
    state, frames = long_run(options.frames, options.blocks)
    live = state.slam.volume.num_bytes
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "state.db"
        database = StateDatabase(path)
        snapshot, wall, cpu = timed(take_snapshot, state, database)
        print(f"whole snapshot:   {1000 * wall:7.1f} ms in the way of the frames ({1000 * cpu:.1f} ms processor)")
        _, wall, cpu = timed(database.write, snapshot, {})
        print(f"whole write:      {1000 * wall:7.1f} ms in the background ({1000 * cpu:.1f} ms processor)")
        del snapshot
        for frame in frames:
            state.slam.process(frame)
        snapshot, wall, cpu = timed(take_snapshot, state, database)
        changed = sum(len(one.slots) for one in snapshot.maps)
        print(f"next snapshot:    {1000 * wall:7.1f} ms in the way of the frames ({1000 * cpu:.1f} ms processor), "
              f"{changed} changed blocks")  # fmt: skip
        _, wall, cpu = timed(database.write, snapshot, {})
        print(f"next write:       {1000 * wall:7.1f} ms in the background ({1000 * cpu:.1f} ms processor)")
        of_map = database._execute("SELECT sum(length(voxels)) FROM blocks").fetchone()[0]
        index = sum(array.nbytes for array in snapshot.arrays)
        of_frames = database._execute(
            "SELECT sum(length(depth) + length(color) + length(mask)) FROM frames"
        ).fetchone()[0]
        total = sum(one.stat().st_size for one in Path(folder).iterdir())
        print(f"map in memory:    {live / 1e6:7.1f} MB, {state.slam.volume.num_blocks} blocks")
        parts = f"voxels {of_map / 1e6:.1f}, stored frames {of_frames / 1e6:.1f}, all other arrays {index / 1e6:.1f}"
        print(f"on the disk:      {total / 1e6:7.1f} MB: {parts}")
        print(f"without stored frames {(total - of_frames) / live:.2f} times the map in memory")
        database.close()

        def go_on() -> RunState:
            reader, again = StateReader(path), StateDatabase(path)
            return restore(reader, RunState(Slam(CAMERA, state.slam.config), RunRecord()), again)

        found, wall, cpu = timed(go_on)
        assert len(found.slam.atlas.poses) == len(state.slam.atlas.poses)
        print(f"resume:           {1000 * wall:7.1f} ms ({1000 * cpu:.1f} ms processor) after {options.frames} frames")


if __name__ == "__main__":
    main()
