"""The table of the GPU: what it measures on the machine at hand, and what it makes of a device's events."""

import types

import pytest

from dudmap.benchmark import gpu
from dudmap.errors import ConfigError
from dudmap.synthetic import sequence
from dudmap.synthetic.recording import DEFAULT_CAMERA


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
    shares = gpu._shares(times, 640 * 480, 1e6, "cuda:0")
    # two passes of 8 bytes a pixel in 0.4 ms, and 8 bytes a voxel in 0.5 ms, of 100 GB/s
    assert shares == pytest.approx({"bilateral_line": 16 * 640 * 480 / 0.4e-3 / 1e11, "integrate": 0.16})
    row = gpu.DeviceRun("room", 0.01, "cuda:0", 2.0, {"track": 1.0}, kernels=times, shares=shares)
    assert "| integrate | 0.500 | 16 |" in gpu.table([row])
    assert "Nothing was measured" not in gpu.table([row])


def test_lists_of_the_command_line():
    assert gpu.numbers("2,0.5", "640x480,") == ([0.02, 0.005], [(640, 480)])
    with pytest.raises(ConfigError, match="640 by 480"):
        gpu.numbers("2", "640 by 480")
