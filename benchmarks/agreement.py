"""How far a device's results are from the CPU's, beside what the smallest possible change of the input does on the CPU.

    python benchmarks/agreement.py [--device warp-cpu] [--frames N] [--first N] [--voxel M] [--set K=V] [RECORDING ...]

Each recording (by default the synthetic room without noise, four seeds, 320x240, 12 frames) is processed three times:
on the CPU, on the device, and on the CPU with every reading of the depth greater by one unit in the last place. Printed
is how far the second and the third are from the first: where both are alike, the device adds nothing to what any
rounding does.
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from dudmap.config import Config
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera
from dudmap.core.slam import Slam
from dudmap.io.sequences import open_sequence
from dudmap.lab.benchmark.table import grid
from dudmap.lab.synthetic import sequence as synthetic_sequence
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA

SEEDS = 4
FRAMES = 12
Result = tuple[NDArray, NDArray, NDArray]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--device", default="warp-cpu")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--voxel", type=float, default=0.02)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    wanted = parser.parse_args()
    rows = []
    for name, camera, frames in inputs(wanted):
        settings = [f"volume.voxel_size={wanted.voxel}", "sensor.self_calibration=false", *wanted.set]
        reference = processed(camera, frames, "cpu", settings)
        for what, device, given in (
            (wanted.device, wanted.device, frames),
            ("CPU, depth nudged", "cpu", [nudged(frame) for frame in frames]),
        ):
            other = processed(camera, given, device, settings)
            rows.append([name, what, *differences(reference, other, wanted.voxel)])
            sys.stderr.write(f"{name}, {what}\n")
    head = ["recording", "against the CPU", "median, mm", "largest, mm", "largest, deg", "IoU", "vertices near, %"]
    sys.stdout.write(grid(head, rows))


def inputs(wanted: argparse.Namespace) -> Iterator[tuple[str, Camera, list[Frame]]]:
    """Names, cameras and frames of the recordings."""
    for path in wanted.recordings:
        recording = open_sequence(path)
        numbers = range(wanted.first, wanted.first + wanted.frames)
        yield f"{recording.name}, frame {wanted.first}", recording.camera, [recording[n] for n in numbers]
    camera = replace(DEFAULT_CAMERA.resized(320, 240), fx=258.62, fy=258.26)  # no multiple of a voxel size
    for seed in () if wanted.recordings else range(SEEDS):
        room = synthetic_sequence(frames=wanted.frames, camera=camera, noise="none", seed=seed)
        yield f"exact room, seed {seed}", camera, [room[n] for n in range(wanted.frames)]


def nudged(frame: Frame) -> Frame:
    """The frame with the next greater float32 in place of every reading."""
    depth = frame.depth.astype(np.float32)
    return replace(frame, depth=np.where(depth > 0, np.nextafter(depth, np.float32(np.inf)), depth))


def processed(camera: Camera, frames: list[Frame], device: str, settings: list[str]) -> Result:
    """Poses (n, 4, 4), masks (n, H, W) and vertices (v, 3)."""
    slam = Slam(camera, Config().override([*settings, f"device={device}"]))
    results = [slam.process(frame) for frame in frames]
    poses = [np.full((4, 4), np.nan) if each.T_world_camera is None else each.T_world_camera for each in results]
    return np.array(poses), np.array([each.dynamic_mask for each in results]), slam.volume.extract_mesh().vertices


def differences(one: Result, other: Result, voxel: float) -> list[str]:
    """Distances, largest angle, intersection over union of all masks, share of vertices within a quarter voxel."""
    apart = 1000 * np.linalg.norm((one[0] - other[0])[:, :3, 3], axis=1)
    turn = np.einsum("nji,njk->nik", one[0][:, :3, :3], other[0][:, :3, :3])
    angle = np.degrees(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    both, either = np.count_nonzero(one[1] & other[1]), np.count_nonzero(one[1] | other[1])
    near = KDTree(one[2]).query(other[2])[0] < voxel / 4
    return [f"{np.nanmedian(apart):.3f}", f"{np.nanmax(apart):.2f}", f"{np.nanmax(angle):.3f}",
            f"{both / max(either, 1):.3f}", f"{100 * near.mean():.1f}"]  # fmt: skip


if __name__ == "__main__":
    main()
