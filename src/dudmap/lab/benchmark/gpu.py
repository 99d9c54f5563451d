"""Time per frame and per kernel on a GPU and on the CPU, and Open3D's dense SLAM on the same frames and machine.

A program that fails is a ``DudmapError``, a list that cannot be understood a ``ConfigError``.
"""

import importlib.util
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.backends.device import obstacle, resolve
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.slam import Slam
from dudmap.errors import ConfigError, DatasetError, DeviceError, DudmapError, MapError
from dudmap.evaluation.trajectory import accuracy
from dudmap.io.sequences import Sequence, open_sequence
from dudmap.lab.benchmark.measure import Row, grid, in_own_process
from dudmap.lab.benchmark.speed import WARM_UP, median_seconds
from dudmap.lab.benchmark.suites import Entry
from dudmap.lab.synthetic import sequence as synthetic_sequence
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA

ROUNDS = 3
"""Number of alternating runs of each system, so that a varying load affects both."""


class Comparison(NamedTuple):
    """Median times per frame (ms), ATE RMSE of the last round (m; None without truth), frames, version of Open3D."""

    ours_ms: float
    theirs_ms: float
    ours_ate: float | None
    theirs_ate: float | None
    frames: int
    version: str


def find_open3d(python: Path | None) -> str | None:
    """Python interpreter with open3d: the given one, else this one if it has open3d, else None."""
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
    """
    ours, theirs = list[Row](), list[Row]()
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
        scored = accuracy(Trajectory.from_poses(poses), truth, ("ate_rmse_m",)) if truth and poses else {}
        ates.append(scored.get("ate_rmse_m"))
    return Comparison(median_ms(ours), median_ms(theirs), ates[0], ates[1], len(stamps), str(theirs[-1]["version"]))


def save_frames(sequence: Sequence, frames: int, folder: Path) -> tuple[Trajectory | None, NDArray[np.float64]]:
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

    Voxels are in metres; ``device`` is Open3D's word, such as "CUDA:0".
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


KERNELS_EVERY = 4
"""Every so many frames the kernels are measured, and in the others the frames and their stages: events around each
kernel take time."""


def numbers(voxels: str, sizes: str) -> tuple[list[float], list[tuple[int, int]]]:
    """Voxel sizes in metres, and image sizes, of comma-separated lists as the command line gives them."""
    try:
        shapes = [(int(width), int(height)) for width, height in (size.split("x") for size in sizes.split(",") if size)]
        return [float(voxel) / 100 for voxel in voxels.split(",")], shapes
    except ValueError:
        raise ConfigError(
            f"cannot understand --voxels {voxels!r} and --sizes {sizes!r}; expected centimetres, such as 2,1, and "
            "pixels, such as 640x480,1280x720"
        ) from None


def recordings(sizes: Iterable[tuple[int, int]], frames: int, paths: Iterable[Path]) -> Iterable[tuple[str, Sequence]]:
    """Names and recordings: the synthetic room in each size, then those of ``paths``."""
    for width, height in sizes:
        camera = replace(DEFAULT_CAMERA.resized(width, width * 3 // 4), height=height, cy=(height - 1) / 2)
        yield f"room {width}x{height}", synthetic_sequence(frames=frames, camera=camera)
    for path in paths:
        recording = open_sequence(path)
        yield f"{recording.name} {recording.camera.width}x{recording.camera.height}", recording


def measure_devices(
    content: Iterable[tuple[str, Sequence]],
    voxels: list[float],
    frames: int,
    wanted: str,
    python: str | None,
    announce: Callable[[str], None],
) -> list[Row]:
    """Rows of recordings by name with each voxel size (m), on the GPU, if there is one, and on the CPU beside it.

    A Python with Open3D also measures its dense SLAM. ``announce`` is called with what is measured next.
    """
    device, rows = resolve(wanted), list[Row]()
    for name, recording in content:
        for voxel in voxels:
            for one in dict.fromkeys((device, "cpu")):
                announce(f"{name}, {100 * voxel:g} cm, {one}")
                rows.append(measure(name, recording, frames, voxel, one))
        if python is not None:
            announce(f"{name}, Open3D's dense SLAM")
            other = "CPU:0" if device == "cpu" else device.upper()
            rows += measure_open3d(python, name, recording, frames, voxels, other)
    return rows


def measure(name: str, recording: Sequence, frames: int, voxel: float, device: str) -> Row:
    """Process the first ``frames`` frames with voxels in metres.

    Returns:
        Medians in milliseconds of a frame, of its ``stages``, on a GPU of its ``kernels``, of a mesh and its number of
            triangles, and of a view of the camera's size; the map and the peak memory of a GPU, MB. ``error`` stands in
            their place where the device cannot do all of it.
    """
    row: Row = {"what": name, "voxel": voxel, "device": device}
    try:
        return row | _measured(recording, frames, voxel, device)
    except (DeviceError, MapError) as error:
        return row | {"error": str(error)}


def _measured(recording: Sequence, frames: int, voxel: float, device: str) -> Row:
    assignments = [f"volume.voxel_size={voxel}", f"device={device}", "sensor.self_calibration=false"]
    slam, on_gpu = Slam(recording.camera, Config().override(assignments)), device.startswith("cuda")
    times, stages, kernels = [], [], []
    for index in range(min(frames, len(recording))):
        frame = recording[index]
        if on_gpu and index % KERNELS_EVERY == 0:
            kernels.append(_kernel_times(lambda frame=frame: slam.process(frame)))
            continue
        start = time.perf_counter()
        stages.append(slam.process(frame).timings)
        times.append(1000 * (time.perf_counter() - start))
    pose = slam.trajectory.Ts_world_camera[-1]
    mesh_s, mesh = median_seconds(lambda: slam.volume.extract_mesh(1), 1)
    view_s, _ = median_seconds(lambda: slam.volume.raycast(pose), 1)
    warm = slice(WARM_UP if len(times) > 2 * WARM_UP else 0, None)
    row: Row = {"frame_ms": statistics.median(times[warm]), "stages": _medians(stages[warm])}
    row |= {"mesh_ms": 1000 * mesh_s, "view_ms": 1000 * view_s, "triangles": len(mesh.faces)}
    row["map_mb"] = slam.volume.num_bytes / 1e6
    if on_gpu:
        import warp as wp  # pyright: ignore[reportMissingImports]

        row["device_mb"] = wp.get_mempool_used_mem_high(device) / 1e6
        row["kernels"] = _medians(kernels[-len(kernels) // 2 :])  # the first frames load the kernels
    return row


def _medians(rows: list[dict[str, float]]) -> dict[str, float]:
    return {key: statistics.median(row.get(key, 0.0) for row in rows) for one in rows for key in one}


def _kernel_times(action: Callable[[], object]) -> dict[str, float]:
    """Milliseconds that each kernel of an action takes, by events of the GPU; names lose Warp's prefix and hash."""
    import warp as wp  # pyright: ignore[reportMissingImports]

    wp.timing_begin(cuda_filter=wp.TIMING_KERNEL)
    action()
    times: dict[str, float] = {}
    for result in wp.timing_end():
        name = result.name.removeprefix("forward kernel ")
        base, _, tail = name.rpartition("_")
        name = base if len(tail) == 8 and base else name
        times[name] = times.get(name, 0.0) + result.elapsed
    return times


def measure_open3d(
    python: str, name: str, recording: Sequence, frames: int, voxels: Iterable[float], device: str
) -> list[Row]:
    """Time per frame of Open3D's dense SLAM with each voxel size (m), on "CUDA:0" or "CPU:0"."""
    rows = []
    with tempfile.TemporaryDirectory(prefix="dudmap-") as folder:
        save_frames(recording, frames, Path(folder))
        for voxel in voxels:
            rows.append({"what": name, "voxel": voxel, "device": f"Open3D, {device}"})
            try:
                found = run_open3d(python, Path(folder), voxel, device)
                rows[-1] |= {"device": f"Open3D {found['version']}, {device}", "frame_ms": median_ms([found])}
            except DudmapError as error:
                rows[-1]["error"] = str(error)
    return rows


def table(rows: list[Row]) -> str:
    """Markdown: times and memory of each run, then the kernels of those on a GPU."""
    stages, body = list(dict.fromkeys(stage for row in rows for stage in row.get("stages", ()))), []
    for row in rows:
        figures = {**row.get("stages", {}), **row}
        cells = [figures.get(key) for key in ("frame_ms", *stages, "mesh_ms", "view_ms", "map_mb", "device_mb")]
        shown = ["" if value is None else f"{value:.1f}" for value in cells]
        body.append([row["what"], f"{100 * row['voxel']:g}", row["device"], *shown])
    head = ["recording", "voxel, cm", "device", "frame", *stages, "mesh", "view", "map, MB", "device, MB"]
    text, reason = grid(head, body), obstacle()
    if not any(row["device"].startswith("cuda") for row in rows):
        text += f"\nNothing was measured on a GPU{': ' + reason if reason else ', which was not asked for'}.\n"
    for row in rows:
        what = f"{row['what']}, {100 * row['voxel']:g} cm, {row['device']}"
        text += f"\n{what}: {row['error']}\n" if "error" in row else ""
        if row.get("kernels"):
            lines = [[name, f"{ms:.3f}"] for name, ms in sorted(row["kernels"].items(), key=lambda item: -item[1])]
            text += f"\n{what}: kernels per frame\n\n{grid(['kernel', 'ms'], lines)}"
    return text
