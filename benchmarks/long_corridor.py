"""Memory and time of a walk through a long corridor with rooms and back to its beginning, with a memory limit.

    python benchmarks/long_corridor.py --length 300 --max-memory 1GB

prints, for each tenth of the walk, the time per frame, the memory of the process and the blocks in memory and on disk;
then the error of the trajectory, when the beginning was recognised, and the share of the surfaces seen from poses along
the walk that the map has.
"""

import argparse
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from dudmap.app.pipeline.environment import machine, peak_rss_mb
from dudmap.cli.options import memory_size
from dudmap.config import Config
from dudmap.core.map.memory_limit import MemoryLimit, resident_bytes
from dudmap.core.slam import Slam
from dudmap.evaluation.trajectory import accuracy
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA
from dudmap.lab.synthetic.ring_corridor import ring_corridor

NEAR = 0.02
"""A surface of the scene is in the map if the map has one within this distance along the ray, metres."""
WARM_UP = 20


def main() -> None:
    """Process the walk and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--length", type=float, default=300.0, help="of the walk until it is where it began, metres")
    parser.add_argument("--max-memory", default="1GB")
    parser.add_argument("--speed", type=float, default=1.0, help="m/s")
    parser.add_argument("--beyond", type=float, default=12.0, help="length of the walk after that, metres")
    parser.add_argument("--fps", type=float, default=20.0)
    parser.add_argument("--size", default="320x240")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    options = parser.parse_args()
    width, height = (int(number) for number in options.size.split("x"))
    camera = DEFAULT_CAMERA.resized(width, height)
    corridor = ring_corridor(options.length, options.speed, options.fps, options.beyond, camera)
    limit = None if options.max_memory == "none" else MemoryLimit(memory_size(options.max_memory))
    slam = Slam(camera, Config().override(options.set), max_blocks=limit)
    print(f"{len(corridor)} frames of {options.size}, {options.length:g} m; {machine()['cpu']}")
    print("| walk m | ms per frame, median | memory MB | blocks in memory | on disk | lost | corrections |")
    print("|---|---|---|---|---|---|---|")
    times, lost, corrected, tenth = [], 0, [], max(len(corridor) // 10, 1)
    medians, reasons, slowest = [], {}, []
    with ThreadPoolExecutor(1) as reader:
        following = reader.submit(corridor.__getitem__, 0)
        for number in range(len(corridor)):
            frame = following.result()  # rendering is not timed
            start = time.perf_counter()
            result = slam.process(frame)
            times.append(1000 * (time.perf_counter() - start))
            stage = max(result.timings, key=result.timings.__getitem__, default="")
            slowest = sorted([*slowest, (times[-1], number, stage, result.timings.get(stage, 0.0))])[-5:]
            following = reader.submit(corridor.__getitem__, min(number + 1, len(corridor) - 1))
            following.result()
            if result.T_world_camera is None:
                lost += 1
                reasons[result.lost_reason] = [*reasons.get(result.lost_reason, []), number]
            if result.corrected:
                corrected.append(number)
            if (number + 1) % tenth == 0:
                volume = slam.atlas.volume
                away = 0 if volume.pager is None else volume.pager.num_blocks
                medians.append(float(np.median(times[WARM_UP if len(medians) == 0 else -tenth :][-tenth:])))
                print(
                    f"| {number * options.speed / options.fps:.0f} | {medians[-1]:.1f} | "
                    f"{resident_bytes() / 1e6:.0f} | "
                    f"{volume.blocks.num_voxel_blocks} | {away} | {lost} | {len(corrected)} |", flush=True,
                )  # fmt: skip
    found = accuracy(slam.trajectory, corridor.ground_truth)
    print(f"\ntime per frame, last tenth over first: {medians[-1] / medians[0]:.2f}; slowest frame {max(times):.0f} ms")
    print(f"peak memory {peak_rss_mb()} MB; ATE {100 * found['ate_rmse_m']:.1f} cm; "
          f"corrected at frames {corrected}")  # fmt: skip
    start, missing = time.perf_counter(), sum(len(one.missing) for one in slam.atlas.rebuildings.values())
    _ = slam.volume
    print(f"kept frames missing in the map at the end: {missing}, fused in {time.perf_counter() - start:.1f} s")
    for total, number, stage, most in reversed(slowest):
        print(f"slow: frame {number}, {total:.0f} ms, of which {stage} {most:.0f} ms")
    for reason, numbers in reasons.items():
        print(f"lost, {reason}: frames {numbers}")
    shares = [_covered(corridor, slam, number) for number in range(0, len(corridor), max(len(corridor) // 60, 1))]
    print(f"surfaces in the map, 60 views: mean {np.mean(shares):.3f}, least {min(shares):.3f}")
    pieces = [len(piece.faces) for piece in slam.volume.extract_pieces()]
    print(f"mesh: {sum(pieces)} triangles in {len(pieces)} pieces; peak memory {peak_rss_mb()} MB")


def _covered(corridor, slam: Slam, number: int) -> float:
    """Share of the pixels nearer than 3 m whose surface the map has, seen from the estimated pose of a frame."""
    stamps = slam.trajectory.timestamps
    nearest = int(np.argmin(np.abs(stamps - corridor.timestamps[number])))
    T = slam.trajectory.Ts_world_camera[nearest]
    index = int(np.argmin(np.abs(corridor.timestamps - stamps[nearest])))
    exact = corridor.exact_depth(index)
    seen = slam.volume.raycast(T).depth
    near = (exact > 0.3) & (exact < 3.0)
    return float(np.mean(np.abs(seen - exact)[near] < NEAR))


if __name__ == "__main__":
    main()
