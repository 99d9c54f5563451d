"""The table of the GPU: what it measures on the machine at hand, and what it makes of a device's events."""

from dudmap.errors import DeviceError
from dudmap.lab.benchmark import gpu
from dudmap.lab.synthetic import sequence
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA


def test_runs_on_the_cpu_and_says_that_no_gpu_was_measured(monkeypatch):
    monkeypatch.setattr(gpu, "obstacle", lambda: "no NVIDIA driver was found")
    room = sequence(frames=4, camera=DEFAULT_CAMERA.resized(160, 120))
    row = gpu.measure("room 160x120", room, 4, 0.04, "cpu")
    assert 1.2 * row["frame_ms"] >= sum(row["stages"].values()) > 0  # medians of four frames do not add up exactly
    assert row["triangles"] > 1000
    assert row["map_mb"] > 1
    text = gpu.table([row])
    assert "| room 160x120 | 4 | cpu |" in text
    assert "Nothing was measured on a GPU: no NVIDIA driver was found." in text


def test_kernels_are_listed_by_their_time():
    row = {"what": "room", "voxel": 0.01, "device": "cuda:0", "frame_ms": 2.0, "stages": {"track": 1.0},
           "kernels": {"trace": 0.1, "integrate": 0.5}}  # fmt: skip
    text = gpu.table([row])
    assert text.index("| integrate | 0.500 |") < text.index("| trace | 0.100 |")
    assert "Nothing was measured" not in text


def test_a_device_that_fails_gives_a_row_that_says_so(monkeypatch):
    def failing(*arguments):
        raise DeviceError("cuda:0 has too little free memory for the map")

    monkeypatch.setattr(gpu, "_measured", failing)
    room = sequence(frames=2, camera=DEFAULT_CAMERA.resized(160, 120))
    row = gpu.measure("room", room, 2, 0.01, "cuda:0")
    assert row["error"] == "cuda:0 has too little free memory for the map"
