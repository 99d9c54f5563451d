"""Open3D's dense SLAM and dudmap alternately on the same frames. Failures raise a ``DudmapError``."""

import json
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dudmap.config import Config
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.slam import Slam
from dudmap.errors import DatasetError, DudmapError
from dudmap.evaluation.trajectory import accuracy
from dudmap.io.sequences import Sequence
from dudmap.lab.benchmark.measure import Row, in_own_process

ROUNDS = 3
"""Alternating runs of each system."""
WARM_UP = 10
"""First frames of a run, not timed."""


class Comparison(NamedTuple):
    """Median times per frame (ms), ATE RMSE of the last round (m; None without ground truth), frames, Open3D's
    version."""

    ours_ms: float
    theirs_ms: float
    ours_ate: float | None
    theirs_ate: float | None
    frames: int
    version: str


def compare_with_open3d(python: Path, sequence: Sequence, frames: int, rounds: int = ROUNDS) -> Comparison:
    """Run both systems on the first frames of a recording; ``python``: interpreter with open3d.

    Times include pose and fusion, not decoding. Voxel size and largest depth are equal; dudmap labels by default.
    """
    count = min(frames, len(sequence))
    if count < 2:
        raise DatasetError(f"{sequence.name} has {count} frames; a comparison needs two or more")
    ours, theirs = list[Row](), list[Row]()
    with tempfile.TemporaryDirectory(prefix="dudmap-") as temporary:
        folder = Path(temporary)
        stamps = _save_frames(sequence, count, folder)
        for _ in range(rounds):
            ours.append(in_own_process(_run_ours, folder))
            if "error" in ours[-1]:
                raise DudmapError(f"our run of the comparison failed: {ours[-1]['error']}")
            theirs.append(_run_open3d(python, folder))
    ates: list[Any] = []
    for row in (ours[-1], theirs[-1]):
        poses: list[Any] = [(t, np.array(T)) for t, T in zip(stamps, row["poses"], strict=True) if T is not None]
        truth = sequence.ground_truth
        scored = accuracy(Trajectory.from_poses(poses), truth, ("ate_rmse_m",)) if truth and poses else {}
        ates.append(scored.get("ate_rmse_m"))
    ours_ms, theirs_ms = (_median_ms(rows) for rows in (ours, theirs))
    return Comparison(ours_ms, theirs_ms, ates[0], ates[1], count, str(theirs[-1]["version"]))


def _median_ms(rows: list[Row]) -> float:
    return float(np.median([row["ms"][WARM_UP:] or row["ms"] for row in rows]))


def _save_frames(sequence: Sequence, count: int, folder: Path) -> list[float]:
    camera, stamps = sequence.camera, []
    depth = np.lib.format.open_memmap(folder / "depth.npy", "w+", np.uint16, (count, *camera.shape))
    color = np.lib.format.open_memmap(folder / "color.npy", "w+", np.uint8, (count, *camera.shape, 3))
    for index in range(count):
        frame = sequence[index]
        depth[index] = np.clip(np.round(frame.depth * camera.depth_scale), 0, 65535).astype(np.uint16)
        color[index] = frame.color
        stamps.append(frame.timestamp)
    depth.flush()
    color.flush()
    values = {key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy", "width", "height", "depth_scale")}
    (folder / "camera.json").write_text(json.dumps(values | {"stamps": stamps}), encoding="utf-8")
    return stamps


def _run_ours(folder: Path) -> Row:
    values = json.loads((folder / "camera.json").read_text(encoding="utf-8"))
    stamps = values.pop("stamps")
    depths, colors = (np.load(folder / f"{kind}.npy", mmap_mode="r", allow_pickle=False) for kind in ("depth", "color"))
    slam, ms, poses = Slam(Camera(**values), Config()), [], []
    for stamp, depth, color in zip(stamps, depths, colors, strict=True):
        frame = Frame(stamp, depth.astype(np.float32) / np.float32(values["depth_scale"]), np.array(color))
        start = time.perf_counter()
        result = slam.process(frame)
        ms.append(1000 * (time.perf_counter() - start))
        poses.append(None if result.T_world_camera is None else result.T_world_camera.tolist())
    return {"ms": ms, "poses": poses}


def _run_open3d(python: Path, folder: Path) -> Row:
    program = Path(__file__).with_name("open3d_slam.py").read_text(encoding="utf-8")
    arguments = [str(folder), str(Config().volume.voxel_size), str(Config().preprocess.depth_max)]
    command = [python, "-c", program, *arguments]
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    except OSError as error:
        raise DudmapError(f"cannot run {python}: {error.strerror}; expected a Python that has open3d") from error
    if done.returncode:
        why = (done.stderr.strip().splitlines() or ["without a word"])[-1]
        raise DudmapError(f"Open3D's dense SLAM failed: {why}")
    return json.loads(done.stdout.strip().splitlines()[-1])
