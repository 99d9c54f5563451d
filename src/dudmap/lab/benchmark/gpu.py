"""Time per frame and kernel on a GPU and the CPU."""

import statistics
import time
from collections.abc import Callable, Iterable, Mapping

from dudmap.config import Config
from dudmap.core.backends.device import obstacle, resolve
from dudmap.core.slam import Slam
from dudmap.errors import DeviceError, MapError
from dudmap.evaluation.tables import grid
from dudmap.io.sequences import Sequence
from dudmap.lab.benchmark.measure import Row
from dudmap.lab.benchmark.speed import WARM_UP, median_seconds

KERNELS_EVERY = 4
"""Frames that measure kernels, whose events take time."""


def measure_devices(
    recordings: Mapping[str, Sequence],
    voxels: Iterable[float],
    frames: int,
    wanted: str,
    announce: Callable[[str], None],
) -> list[Row]:
    """Rows of recordings by name at each voxel size (m), on GPU, if any, and CPU.

    ``announce`` receives the next measurement.
    """
    device, rows = resolve(wanted), list[Row]()
    for name, recording in recordings.items():
        for voxel in voxels:
            for one in dict.fromkeys((device, "cpu")):
                announce(f"{name}, {100 * voxel:g} cm, {one}")
                rows.append(measure(name, recording, frames, voxel, one))
    return rows


def measure(name: str, recording: Sequence, frames: int, voxel: float, device: str) -> Row:
    """Process ``frames`` frames with a voxel size (m).

    Returns:
        Medians in milliseconds of a frame, its ``stages``, ``kernels``, a mesh, a view; triangles, MB of map and peak
        GPU memory. Only ``error`` if the device fails.
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


def table(rows: list[Row]) -> str:
    """Markdown: times and memory of each run, then kernels."""
    stages, body = list(dict.fromkeys(stage for row in rows for stage in row.get("stages", ()))), []
    for row in rows:
        figures = {**row.get("stages", {}), **row}
        cells = [figures.get(key) for key in ("frame_ms", *stages, "mesh_ms", "view_ms", "map_mb", "device_mb")]
        shown = ["" if value is None else f"{value:.1f}" for value in cells]
        body.append([row["what"], f"{100 * row['voxel']:g}", row["device"], *shown])
    head = ["recording", "voxel, cm", "device", "frame", *stages, "mesh", "view", "map, MB", "device, MB"]
    text, reason = grid(head, body), obstacle()
    if not any(row["device"].startswith("cuda") for row in rows):
        text += f"\nNothing was measured on a GPU{': ' + reason if reason else ', which was not requested'}.\n"
    for row in rows:
        what = f"{row['what']}, {100 * row['voxel']:g} cm, {row['device']}"
        text += f"\n{what}: {row['error']}\n" if "error" in row else ""
        if row.get("kernels"):
            lines = [[name, f"{ms:.3f}"] for name, ms in sorted(row["kernels"].items(), key=lambda item: -item[1])]
            text += f"\n{what}: kernels per frame\n\n{grid(['kernel', 'ms'], lines)}"
    return text
