"""Open3D's dense SLAM beside ours: same frames, alternating runs on the same machine."""

import importlib.util
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError, DudmapError
from dudmap.evaluation.trajectory import accuracy
from dudmap.lab.benchmark.entries import Entry
from dudmap.lab.benchmark.measure import Row, in_own_process
from dudmap.lab.benchmark.speed import WARM_UP

if TYPE_CHECKING:
    from dudmap.io.sequences import Sequence

ROUNDS = 3
"""Number of alternating runs of each system, so that a varying load affects both."""


class Comparison(NamedTuple):
    """Result of the comparison.

    Attributes:
        ours_ms, theirs_ms: Median time per frame over all rounds, milliseconds.
        ours_ate, theirs_ate: ATE RMSE of the last round, metres; None without a ground truth.
        frames: Number of frames.
        version: Version of Open3D.
    """

    ours_ms: float
    theirs_ms: float
    ours_ate: float | None
    theirs_ate: float | None
    frames: int
    version: str


def find_open3d(python: Path | None) -> str | None:
    """Python interpreter with open3d: the given one, else this one if it has open3d, else None.

    Raises:
        DudmapError: The given interpreter cannot import open3d.
    """
    if python is None:
        return sys.executable if importlib.util.find_spec("open3d") else None
    try:
        done = subprocess.run([python, "-c", "import open3d"], capture_output=True, text=True, check=False)
    except OSError as error:
        reason = error.strerror or error
        raise DudmapError(f"cannot run {python}: {reason}; expected a Python that has open3d") from error
    if done.returncode:
        reason = _last_line(done.stderr)
        raise DudmapError(f"{python} cannot import open3d: {reason}; install it there, or leave it out")
    return str(python)


def compare_with_open3d(python: str, entry: Entry, frames: int, rounds: int = ROUNDS) -> Comparison:
    """Run both systems alternately on the first frames of a recording, each run in its own process.

    Both receive decoded images and are timed until the pose is estimated and the frame is fused: ours with the default
    configuration including dynamic labels, theirs with the same voxel size and largest depth.

    Raises:
        DudmapError: A run failed.
    """
    ours: list[Row] = []
    theirs: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="dudmap-") as temporary:
        folder = Path(temporary)
        truth, stamps = save_frames(entry.open(), frames, folder)
        for _ in range(rounds):
            ours.append(in_own_process(_run_ours, folder))
            if "error" in ours[-1]:
                raise DudmapError(f"our run of the comparison failed: {ours[-1]['error']}")
            theirs.append(run_open3d(python, folder, Config().volume.voxel_size))
    ates: list[Any] = []
    for row in (ours[-1], theirs[-1]):
        poses: list[Any] = [(t, np.array(T)) for t, T in zip(stamps, row["poses"], strict=True) if T is not None]
        known = truth is not None and len(poses) > 0
        ates.append(accuracy(Trajectory.from_poses(poses), truth, ("ate_rmse_m",))["ate_rmse_m"] if known else None)
    return Comparison(median_ms(ours), median_ms(theirs), *ates, len(stamps), str(theirs[-1]["version"]))


def save_frames(sequence: "Sequence", frames: int, folder: Path) -> tuple[Trajectory | None, NDArray[np.float64]]:
    """Write the arrays that open3d_slam.py reads; returns the ground truth and the timestamps (n,)."""
    camera, count = sequence.camera, min(frames, len(sequence))
    if count < 2:
        raise DatasetError(f"{sequence.name} has {count} frames; a comparison needs two or more")
    depth = np.lib.format.open_memmap(folder / "depth.npy", "w+", np.uint16, (count, *camera.shape))
    color = np.lib.format.open_memmap(folder / "color.npy", "w+", np.uint8, (count, *camera.shape, 3))
    stamps = np.empty(count)
    for index in range(count):
        frame = sequence[index]
        depth[index] = np.clip(np.round(frame.depth * camera.depth_scale), 0, 65535).astype(np.uint16)
        color[index], stamps[index] = frame.color, frame.timestamp
    depth.flush()
    color.flush()
    values = {key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy", "width", "height", "depth_scale")}
    (folder / "camera.json").write_text(json.dumps(values), encoding="utf-8")
    np.save(folder / "timestamps.npy", stamps)
    return sequence.ground_truth, stamps


def _run_ours(folder: Path) -> Row:
    from dudmap.core.frames.frame import Frame
    from dudmap.core.geometry.camera import Camera
    from dudmap.core.slam import Slam

    camera = Camera(**json.loads((folder / "camera.json").read_text(encoding="utf-8")))
    depths, colors = (np.load(folder / f"{kind}.npy", mmap_mode="r", allow_pickle=False) for kind in ("depth", "color"))
    slam, ms, poses = Slam(camera, Config()), [], []
    for stamp, depth, color in zip(np.load(folder / "timestamps.npy", allow_pickle=False), depths, colors, strict=True):
        frame = Frame(float(stamp), depth.astype(np.float32) / np.float32(camera.depth_scale), np.array(color))
        start = time.perf_counter()
        result = slam.process(frame)
        ms.append(1000 * (time.perf_counter() - start))
        poses.append(None if result.T_world_camera is None else result.T_world_camera.tolist())
    return {"ms": ms, "poses": poses}


def run_open3d(python: str, folder: Path, voxel_size: float, device: str = "CPU:0") -> Row:
    """Open3D's dense SLAM on the frames that ``save_frames`` wrote: version, ms per frame, poses.

    Args:
        python: Interpreter with open3d.
        folder: Folder of the frames.
        voxel_size: Metres.
        device: Device in Open3D, such as "CUDA:0".

    Raises:
        DudmapError: The run failed.
    """
    program = Path(__file__).with_name("open3d_slam.py").read_text(encoding="utf-8")
    arguments = [str(folder), str(voxel_size), str(Config().preprocess.depth_max), device]
    done = subprocess.run([python, "-c", program, *arguments], cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise DudmapError(f"Open3D's dense SLAM failed: {_last_line(done.stderr)}")
    return json.loads(done.stdout.strip().splitlines()[-1])


def median_ms(rows: list[Row]) -> float:
    """Median of the times per frame of runs, without the first frames of each, milliseconds."""
    return float(np.median([row["ms"][WARM_UP:] or row["ms"] for row in rows]))


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["without a word"])[-1]
