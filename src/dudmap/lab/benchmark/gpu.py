"""Time per frame and per kernel on a GPU and on the CPU, by image size and voxel size."""

import statistics
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dudmap.config import Config
from dudmap.core.backends.device import obstacle, resolve
from dudmap.errors import ConfigError, DeviceError, DudmapError, MapError
from dudmap.io.sequences import Sequence, open_sequence
from dudmap.lab.benchmark.interleaved import median_ms, run_open3d, save_frames
from dudmap.lab.benchmark.speed import WARM_UP
from dudmap.lab.benchmark.table import grid
from dudmap.lab.synthetic import sequence as synthetic_sequence
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA

KERNELS_EVERY = 4
"""Every so many frames the kernels are measured, and in the others the frames and their stages: events around each
kernel take time."""


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
    error: str = ""


def numbers(voxels: str, sizes: str) -> tuple[list[float], list[tuple[int, int]]]:
    """Voxel sizes in metres, and image sizes, of comma-separated lists as the command line gives them.

    Raises:
        ConfigError: A list cannot be understood.
    """
    try:
        pairs = [size.split("x") for size in sizes.split(",") if size]
        return [float(voxel) / 100 for voxel in voxels.split(",")], [
            (int(width), int(height)) for width, height in pairs
        ]
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
    try:
        return _measured(name, recording, frames, voxel, device)
    except (DeviceError, MapError) as error:
        return DeviceRun(name, voxel, device, error=str(error))


def _measured(name: str, recording: Sequence, frames: int, voxel: float, device: str) -> DeviceRun:
    from dudmap.core.slam import Slam

    assignments = [f"volume.voxel_size={voxel}", f"device={device}", "sensor.self_calibration=false"]
    slam, on_gpu = Slam(recording.camera, Config().override(assignments)), device.startswith("cuda")
    times, stages, kernels = [], [], []
    for index in range(min(frames, len(recording))):
        frame = recording[index]
        if on_gpu and index % KERNELS_EVERY == 0:
            kernels.append(_kernel_times(lambda frame=frame: slam.process(frame)))
            continue
        ms, result = _timed(lambda frame=frame: slam.process(frame))
        times.append(ms)
        stages.append(result.timings)
    pose = slam.trajectory.Ts_world_camera[-1]
    slam.volume.extract_mesh(1)
    mesh_ms, mesh = _timed(lambda: slam.volume.extract_mesh(1))
    slam.volume.raycast(pose)
    view_ms, _ = _timed(lambda: slam.volume.raycast(pose))
    device_mb = float("nan")
    if on_gpu:
        import warp as wp  # pyright: ignore[reportMissingImports]

        device_mb = wp.get_mempool_used_mem_high(device) / 1e6
    warm = slice(WARM_UP if len(times) > 2 * WARM_UP else 0, None)
    return DeviceRun(
        name, voxel, device, statistics.median(times[warm]), _medians(stages[warm]), mesh_ms, view_ms, len(mesh.faces),
        slam.volume.num_bytes / 1e6, device_mb,
        _medians(kernels[-len(kernels) // 2 :]),  # the first frames load the kernels
    )  # fmt: skip


def _timed(action: Callable[[], Any]) -> tuple[float, Any]:
    start = time.perf_counter()
    result = action()
    return 1000 * (time.perf_counter() - start), result


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


def table(rows: list[DeviceRun]) -> str:
    """Markdown: times and memory of each run, then the kernels of those on a GPU."""
    stages, body = list(dict.fromkeys(stage for row in rows for stage in row.stages)), []
    for row in rows:
        times = [row.frame_ms, *(row.stages.get(stage, np.nan) for stage in stages), row.mesh_ms, row.view_ms]
        cells = ["" if np.isnan(x) else f"{x:.1f}" for x in (*times, row.map_mb, row.device_mb)]
        body.append([row.what, f"{100 * row.voxel:g}", row.device, *cells])
    head = ["recording", "voxel, cm", "device", "frame", *stages, "mesh", "view", "map, MB", "device, MB"]
    text, reason = grid(head, body), obstacle()
    if not any(row.device.startswith("cuda") for row in rows):
        text += f"\nNothing was measured on a GPU{': ' + reason if reason else ', which was not asked for'}.\n"
    for row in rows:
        what = f"{row.what}, {100 * row.voxel:g} cm, {row.device}"
        text += f"\n{what}: {row.error}\n" if row.error else ""
        if row.kernels:
            lines = [[name, f"{ms:.3f}"] for name, ms in sorted(row.kernels.items(), key=lambda item: -item[1])]
            text += f"\n{what}: kernels per frame\n\n{grid(['kernel', 'ms'], lines)}"
    return text
