"""Time per frame and per kernel on a GPU and on the CPU, by image size and voxel size."""

import statistics
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dudmap.benchmark.interleaved import median_ms, run_open3d, save_frames
from dudmap.benchmark.table import grid
from dudmap.benchmark.timing import WARM_UP
from dudmap.config import Config
from dudmap.errors import ConfigError, DudmapError, MapError
from dudmap.gpu import faults
from dudmap.gpu.device import obstacle, resolve
from dudmap.sequences import Sequence, open_sequence
from dudmap.synthetic import sequence as synthetic_sequence
from dudmap.synthetic.recording import DEFAULT_CAMERA

BYTES_PER_THREAD = {
    "limit_depth": 8, "drop_mixed": 8, "fill_holes": 8, "bilateral_line": 8, "intensities": 7, "halve": 40,
    "tile_ranges": 268, "reading_weights": 5, "pack_pixels": 16, "integrate": 8, "linearize": 288,
    "linearize_trial": 288, "sample": 17,
    "first_spins": 8, "mean_field_sweep": 20, "probabilities": 8, "trace": 19, "classify": 9, "find_vertices": 10,
    "trace_levels": 19, "prolong": 8, "scatter": 8, "gather": 8,
}  # fmt: skip
"""Bytes that each thread of a kernel must read and write at least: its elements of each image and each sum once, and
the words of the voxels that belong to it alone; not those of the map that neighbouring pixels share."""
KERNELS_EVERY = 4
"""Every so many frames the kernels are measured, launched one by one, and in the others the frames and their stages:
events around each kernel take time, and kernels in a graph have none."""
COPY_BYTES = 1 << 28
"""Size of the array whose copy measures the bandwidth of the device."""


@dataclass(frozen=True)
class DeviceRun:
    """Medians of a recording on a device.

    Attributes:
        what: Recording and image size.
        voxel: Voxel size, metres.
        device: "cpu", "cuda:0", ...
        frame_ms: Time per frame, milliseconds.
        stages: Time of each stage, milliseconds.
        mesh_ms, view_ms: Time of a mesh and of an artificial view of the camera's size.
        triangles: Of that mesh.
        map_mb, device_mb: Size of the map, and peak memory of the device where it is known.
        kernels: Milliseconds per frame of each kernel, by the device's events; empty on the CPU.
        shares: Share of the device's bandwidth that each memory-bound kernel reaches.
        error: Why there are no figures.
    """

    what: str
    voxel: float
    device: str
    frame_ms: float = float("nan")
    stages: dict[str, float] = field(default_factory=dict)
    mesh_ms: float = float("nan")
    view_ms: float = float("nan")
    triangles: int = 0
    map_mb: float = float("nan")
    device_mb: float = float("nan")
    kernels: dict[str, float] = field(default_factory=dict)
    shares: dict[str, float] = field(default_factory=dict)
    error: str = ""


def numbers(voxels: str, sizes: str) -> tuple[list[float], list[tuple[int, int]]]:
    """Voxel sizes in metres, and image sizes, of comma-separated lists as the command line gives them.

    Raises:
        ConfigError: A list cannot be understood.
    """
    try:
        steps = [float(voxel) / 100 for voxel in voxels.split(",")]
        pairs = [size.split("x") for size in sizes.split(",") if size]
        return steps, [(int(width), int(height)) for width, height in pairs]
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


def devices(wanted: str) -> list[str]:
    """The GPU to measure, if there is one, and the CPU beside it."""
    device = resolve(wanted)
    return ["cpu"] if device == "cpu" else [device, "cpu"]


def measure(name: str, recording: Sequence, frames: int, voxel: float, device: str) -> DeviceRun:
    """Process the first ``frames`` frames; a device that cannot do all of it gives a row that says so."""
    if faults.is_lost(device):
        return DeviceRun(name, voxel, device, error=f"{device} has failed before")
    failures: list[str] = []
    with faults.told_to(failures.append):
        row = _measured(name, recording, frames, voxel, device)
    return DeviceRun(name, voxel, device, error=failures[0]) if failures else row


def _measured(name: str, recording: Sequence, frames: int, voxel: float, device: str) -> DeviceRun:
    from dudmap.slam import Slam

    assignments = [f"volume.voxel_size={voxel}", f"device={device}", "sensor.self_calibration=false"]
    try:
        slam = Slam(recording.camera, Config().override(assignments))
        times, stages, kernels, moved = [], [], [], []
        for index in range(min(frames, len(recording))):
            frame = recording[index]
            if device.startswith("cuda") and index % KERNELS_EVERY == 0:
                with _kernel_times(device) as (measured, threads):
                    slam.process(frame)
                kernels.append(measured)
                moved.append({key: count * BYTES_PER_THREAD.get(key, 0) for key, count in threads.items()})
            else:
                start = time.perf_counter()
                result = slam.process(frame)
                times.append(1000 * (time.perf_counter() - start))
                stages.append(result.timings)
        pose = slam.trajectory.Ts_world_camera[-1]
        slam.volume.extract_mesh(1)
        mesh_ms, mesh = _timed(lambda: slam.volume.extract_mesh(1))
        slam.volume.raycast(pose)
        view_ms, _ = _timed(lambda: slam.volume.raycast(pose))
    except MapError as error:
        return DeviceRun(name, voxel, device, error=str(error))
    warm = slice(WARM_UP if len(times) > 2 * WARM_UP else 0, None)
    per_kernel = _medians(kernels[-len(kernels) // 2 :])  # the first frames load the kernels
    shares = _shares(per_kernel, _medians(moved[-len(moved) // 2 :]), device)
    return DeviceRun(
        name, voxel, device, statistics.median(times[warm]), _medians(stages[warm]), mesh_ms, view_ms, len(mesh.faces),
        slam.volume.num_bytes / 1e6, _peak_megabytes(device), per_kernel, shares,
    )  # fmt: skip


def _timed(action: Any) -> tuple[float, Any]:  # noqa: ANN401
    start = time.perf_counter()
    result = action()
    return 1000 * (time.perf_counter() - start), result


def _medians(rows: list[dict[str, float]]) -> dict[str, float]:
    keys = list(dict.fromkeys(key for row in rows for key in row))
    return {key: statistics.median(row.get(key, 0.0) for row in rows) for key in keys}


@contextmanager
def _kernel_times(device: str) -> Iterator[tuple[dict[str, float], dict[str, int]]]:
    """Milliseconds that each kernel takes within the block, by events of the device, and its number of threads."""
    times, threads = {}, {}
    if not device.startswith("cuda"):
        yield times, threads
        return
    import warp as wp  # pyright: ignore[reportMissingImports]

    from dudmap.gpu.sequence import one_by_one

    wp.timing_begin(cuda_filter=wp.TIMING_KERNEL)
    with counted_launches(threads), one_by_one():
        yield times, threads
    add_up(wp.timing_end(), times)


@contextmanager
def counted_launches(threads: dict[str, int]) -> Iterator[None]:
    """Add the threads of every launch within the block to those of its kernel."""
    import warp as wp  # pyright: ignore[reportMissingImports]

    launch, repeat = wp.launch, wp.Launch.launch

    def counted(kernel: Any, dim: Any, *arguments: Any, **named: Any) -> Any:  # noqa: ANN401
        if not named.get("record_cmd"):
            threads[kernel.key] = threads.get(kernel.key, 0) + int(np.prod(dim))
        return launch(kernel, dim, *arguments, **named)

    def repeated(command: Any, *arguments: Any, **named: Any) -> None:  # noqa: ANN401
        threads[command.kernel.key] = threads.get(command.kernel.key, 0) + command.bounds.size
        repeat(command, *arguments, **named)

    wp.launch, wp.Launch.launch = counted, repeated  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        wp.launch, wp.Launch.launch = launch, repeat


def add_up(results: Iterable[Any], times: dict[str, float]) -> None:
    """Add the milliseconds of Warp's timing results to those of each kernel; names lose Warp's prefix and hash."""
    for result in results:
        name = result.name.removeprefix("forward kernel ")
        base, _, tail = name.rpartition("_")
        name = base if len(tail) == 8 and base else name
        times[name] = times.get(name, 0.0) + result.elapsed


def _shares(kernels: dict[str, float], moved: dict[str, float], device: str) -> dict[str, float]:
    """Share of the measured bandwidth that each kernel reaches with the bytes that it must move per frame."""
    if not device.startswith("cuda"):
        return {}
    bandwidth = measured_bandwidth(device)
    return {name: moved[name] / (1e-3 * ms) / bandwidth for name, ms in kernels.items() if moved.get(name) and ms > 0}


def measure_open3d(
    python: str, name: str, recording: Sequence, frames: int, voxels: Iterable[float], device: str
) -> list[DeviceRun]:
    """Time per frame of Open3D's dense SLAM (``t.pipelines.slam``) with each voxel size, in a program of its own.

    Args:
        python: Interpreter with open3d.
        name: Of the recording.
        recording: The recording.
        frames: Number of frames.
        voxels: Voxel sizes, metres.
        device: Device in Open3D: "CUDA:0" or "CPU:0".
    """
    rows = []
    with tempfile.TemporaryDirectory(prefix="dudmap-") as folder:
        save_frames(recording, frames, Path(folder))
        for voxel in voxels:
            try:
                row = run_open3d(python, Path(folder), voxel, device)
                rows.append(DeviceRun(name, voxel, f"Open3D {row['version']}, {device}", median_ms([row])))
            except DudmapError as error:
                rows.append(DeviceRun(name, voxel, f"Open3D, {device}", error=str(error)))
    return rows


def measured_bandwidth(device: str) -> float:
    """Bytes per second that a copy of a large array reads and writes."""
    import warp as wp  # pyright: ignore[reportMissingImports]

    source = wp.zeros(COPY_BYTES, dtype=wp.uint8, device=device)
    target = wp.empty_like(source)
    best = float("inf")
    for _ in range(6):
        wp.synchronize_device(device)
        start = time.perf_counter()
        wp.copy(target, source)
        wp.synchronize_device(device)
        best = min(best, time.perf_counter() - start)
    return 2 * COPY_BYTES / best


def _peak_megabytes(device: str) -> float:
    if not device.startswith("cuda"):
        return float("nan")
    import warp as wp  # pyright: ignore[reportMissingImports]

    return wp.get_mempool_used_mem_high(device) / 1e6


def table(rows: list[DeviceRun]) -> str:
    """Markdown: times and memory of each run, then the kernels of those on a GPU."""
    stages = list(dict.fromkeys(stage for row in rows for stage in row.stages))
    head = ["recording", "voxel, cm", "device", "frame", *stages, "mesh", "view", "map, MB", "device, MB"]
    text = grid(head, [_line(row, stages) for row in rows])
    reason = obstacle()
    if not any(row.device.startswith("cuda") for row in rows):
        text += f"\nNothing was measured on a GPU{': ' + reason if reason else ', which was not asked for'}.\n"
    for row in rows:
        if row.error:
            text += f"\n{row.what}, {100 * row.voxel:g} cm, {row.device}: {row.error}\n"
        if row.kernels:
            text += f"\n{row.what}, {100 * row.voxel:g} cm, {row.device}: kernels per frame\n\n"
            lines = [
                [name, f"{ms:.3f}", f"{100 * row.shares[name]:.0f}" if name in row.shares else ""]
                for name, ms in sorted(row.kernels.items(), key=lambda item: -item[1])
            ]
            text += grid(["kernel", "ms", "bandwidth, %"], lines)
    return text


def _line(row: DeviceRun, stages: list[str]) -> list[str]:
    times = [row.frame_ms, *(row.stages.get(stage, float("nan")) for stage in stages), row.mesh_ms, row.view_ms]
    figures = [*times, row.map_mb, row.device_mb]
    return [row.what, f"{100 * row.voxel:g}", row.device, *("" if np.isnan(x) else f"{x:.1f}" for x in figures)]
