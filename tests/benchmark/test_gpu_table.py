"""The table of the GPU: what it measures on the machine at hand, and what it makes of a device's events."""

import sys
import types
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from dudmap.benchmark import gpu
from dudmap.errors import ConfigError
from dudmap.gpu import faults
from dudmap.gpu.device import make_backend
from dudmap.kernels.parameters import RegistrationParameters
from dudmap.synthetic import sequence
from dudmap.synthetic.recording import DEFAULT_CAMERA
from small_maps import CAMERA, integrated


def test_runs_on_the_cpu_and_says_that_no_gpu_was_measured(monkeypatch):
    monkeypatch.setattr(gpu, "obstacle", lambda: "no NVIDIA driver was found")
    room = sequence(frames=4, camera=DEFAULT_CAMERA.resized(160, 120))
    row = gpu.measure("room 160x120", room, 4, 0.04, "cpu")
    assert row.frame_ms >= sum(row.stages.values()) > 0
    assert row.triangles > 1000
    assert row.map_mb > 1
    text = gpu.table([row])
    assert "| room 160x120 | 4 | cpu |" in text
    assert "Nothing was measured on a GPU: no NVIDIA driver was found." in text


def test_kernels_are_summed_and_compared_with_the_bandwidth(monkeypatch):
    events = [("forward kernel bilateral_line_0a1b2c3d", 0.2), ("forward kernel bilateral_line_0a1b2c3d", 0.2),
              ("forward kernel integrate_99aabbcc", 0.5), ("forward kernel trace", 0.1)]  # fmt: skip
    times: dict[str, float] = {}
    gpu.add_up([types.SimpleNamespace(name=name, elapsed=ms) for name, ms in events], times)
    assert times == pytest.approx({"bilateral_line": 0.4, "integrate": 0.5, "trace": 0.1})
    monkeypatch.setattr(gpu, "measured_bandwidth", lambda device: 1e11)
    moved = {"bilateral_line": 16 * 640 * 480, "integrate": 8e6, "trace": 0}
    shares = gpu._shares(times, moved, "cuda:0")
    # two passes of 8 bytes a pixel in 0.4 ms, and 8 bytes a voxel in 0.5 ms, of 100 GB/s
    assert shares == pytest.approx({"bilateral_line": 16 * 640 * 480 / 0.4e-3 / 1e11, "integrate": 0.16})
    row = gpu.DeviceRun("room", 0.01, "cuda:0", 2.0, {"track": 1.0}, kernels=times, shares=shares)
    assert "| integrate | 0.500 | 16 |" in gpu.table([row])
    assert "Nothing was measured" not in gpu.table([row])


def test_lists_of_the_command_line():
    assert gpu.numbers("2,0.5", "640x480,") == ([0.02, 0.005], [(640, 480)])
    with pytest.raises(ConfigError, match="640 by 480"):
        gpu.numbers("2", "640 by 480")


def test_threads_of_launches_are_counted():
    wp = pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")
    backend, threads = make_backend("warp-cpu"), {}
    with gpu.counted_launches(threads):
        backend.intensity(np.zeros((12, 20, 3), np.uint8))
        backend.label(*np.zeros((3, 12, 20), np.float32), 1.0, 5)
    assert threads == {"intensities": 240, "first_spins": 240, "mean_field_sweep": 1200, "probabilities": 240}
    assert wp.launch.__module__.startswith("warp")


def test_threads_of_recorded_launches_are_counted():
    pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")
    from dudmap.gpu.linearization import PER_THREAD

    volume, room = integrated(sequence(frames=1, camera=CAMERA), "warp-cpu", frames=1), np.zeros((120, 160), np.float32)
    parameters = RegistrationParameters(volume.band, 0.02, 0.0, 0.02, 0.1, 0.003, 1.0)
    arguments = room, room, room, CAMERA.intrinsics, np.eye(3, 4, dtype=np.float32), parameters
    threads = {}
    with gpu.counted_launches(threads):
        for _ in range(3):
            volume.backend.linearize(volume.grid, *arguments)
    assert 120 * 160 <= threads["linearize"] / 3 * PER_THREAD < 120 * 160 + 128 * PER_THREAD


def test_every_kernel_with_a_bound_exists():
    """A kernel that is renamed would silently have no share of the bandwidth."""
    pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")
    make_backend("warp-cpu")
    from dudmap.gpu.ahead import MODULES

    known = {name for module in MODULES for name in vars(import_module(module))}
    assert gpu.BYTES_PER_THREAD.keys() <= known


def test_a_device_that_fails_gives_a_row_that_says_so(monkeypatch):
    def failing(*arguments):
        faults.tell("the map needs 90 MB more on cuda:0")
        return gpu.DeviceRun("room", 0.01, "cuda:0", 2.0)

    monkeypatch.setattr(gpu, "_measured", failing)
    room = sequence(frames=2, camera=DEFAULT_CAMERA.resized(160, 120))
    for _ in range(2):
        assert gpu.measure("room", room, 2, 0.01, "cuda:0").error == "the map needs 90 MB more on cuda:0"


def test_open3d_is_measured_in_a_program_of_its_own(monkeypatch):
    """Open3D replaced by a program that prints the device it is asked for, and by one that fails."""
    room = sequence(frames=3, camera=DEFAULT_CAMERA.resized(160, 120))
    program = "import json, sys; print(json.dumps({'version': '0.20 ' + sys.argv[4], 'ms': [3.0] * 3, 'poses': []}))"
    monkeypatch.setattr(Path, "read_text", lambda path, *_, **__: program)
    rows = gpu.measure_open3d(sys.executable, "room", room, 3, [0.02, 0.01], "CUDA:0")
    assert [(row.voxel, row.device, row.frame_ms) for row in rows] == [
        (0.02, "Open3D 0.20 CUDA:0, CUDA:0", 3.0), (0.01, "Open3D 0.20 CUDA:0, CUDA:0", 3.0),
    ]  # fmt: skip
    monkeypatch.setattr(Path, "read_text", lambda path, *_, **__: "raise SystemExit('finds no GPU')")
    (row,) = gpu.measure_open3d(sys.executable, "room", room, 3, [0.02], "CUDA:0")
    assert "finds no GPU" in row.error
    assert "room, 2 cm, Open3D, CUDA:0: " in gpu.table([row])
