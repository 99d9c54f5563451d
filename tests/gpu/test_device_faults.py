"""A device that fails in the middle of a run: one sentence, and the CPU from the last checkpoint on."""

import numpy as np
import pytest

pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")

from failing import FULL, LOST, Device

from dudmap import resume_system, save_system
from dudmap.app.pipeline.observer import RunObserver
from dudmap.app.pipeline.run import run
from dudmap.app.pipeline.storing import Storing
from dudmap.config import Config
from dudmap.core.backends.cpu.backend import CpuBackend
from dudmap.core.backends.device import make_backend, start_failure
from dudmap.core.backends.warp import faults
from dudmap.core.slam import Slam
from dudmap.errors import DeviceError
from dudmap.lab import synthetic
from small_maps import CAMERA, integrated

SETTINGS = Config().override(["volume.voxel_size=0.03", "sensor.self_calibration=false", "device=warp-cpu"])


@pytest.fixture
def device(monkeypatch):
    yield Device(monkeypatch)
    faults.forget()


def add(volume, recording, index):
    volume.integrate(recording[index], recording.ground_truth.Ts_world_camera[index])


@pytest.mark.parametrize(
    ("error", "sentence"),
    [(LOST, r"warp-cpu failed .*take --device cpu$"), (FULL, r"too little free memory .*voxel_size .*--device cpu$")],
    ids=["lost", "full"],
)
def test_a_device_that_fails_is_said_and_not_used_again(recording, device, error, sentence):
    volume = integrated(recording, "warp-cpu", frames=2)
    device.breaks(error)
    with pytest.raises(DeviceError, match=sentence) as caught:
        add(volume, recording, 2)
    assert "\n" not in str(caught.value)
    device.works()
    with pytest.raises(DeviceError, match="has failed before"):
        add(volume, recording, 3)
    assert type(make_backend("warp-cpu")) is CpuBackend


def test_a_device_is_tried_before_it_is_used(device):
    assert start_failure.__wrapped__("warp-cpu") == ""
    device.breaks(FULL)
    assert start_failure.__wrapped__("warp-cpu") == FULL


def test_errors_of_the_program_are_raised(recording, monkeypatch):
    import warp as wp

    volume = integrated(recording, "warp-cpu", frames=1)

    def wrong(*_, **__):
        raise TypeError("an argument has the wrong type")

    monkeypatch.setattr(wp, "launch", wrong)
    with pytest.raises(TypeError):
        add(volume, recording, 1)
    assert not faults.is_lost("warp-cpu")


class Breaks(RunObserver):
    """The device fails after a frame."""

    def __init__(self, device, number):
        self.device, self.number, self.seen = device, number, []

    def frame(self, index, read, result, ms):
        self.seen.append((index, result.status))
        if index == self.number:
            self.device.breaks()


def test_a_run_goes_on_from_its_last_checkpoint(device, tmp_path, capfd):
    """No frame is missing, none is there twice, and the poses are those of a system that is moved to the CPU there."""
    recording = synthetic.sequence(frames=10, camera=CAMERA, movers=())
    storing = Storing({"path": "", "camera": None, "topics": None}, 0.0)
    observer, out = Breaks(device, 6), tmp_path / "run"
    report = run(recording, SETTINGS, out, progress=False, observers=(observer,), storing=storing, ahead=0)
    assert report.metrics["complete"]
    assert report.metrics["device"] == "cpu"
    assert len(report.trajectory) == report.metrics["frames"] == 10
    np.testing.assert_allclose(report.trajectory.timestamps, recording.timestamps[:10], atol=1e-6)
    numbers = [index for index, _ in observer.seen]
    again = numbers[numbers.index(6) + 1]
    assert again <= 6
    assert numbers[-1] == 9
    said = capfd.readouterr().err
    assert "warp-cpu failed" in said
    assert "the run goes on on the CPU" in said
    assert "after the last checkpoint, are processed again" in said
    device.works()
    faults.forget()
    slam = Slam(CAMERA, SETTINGS)
    for index in range(10):
        if index == again:
            save_system(slam, tmp_path / "slam.db")
            slam = resume_system(tmp_path / "slam.db", "cpu")
        slam.process(recording[index])
    assert np.array_equal(report.trajectory.Ts_world_camera, slam.trajectory.Ts_world_camera)


def test_without_checkpoints_a_run_ends_with_its_trajectory(device, tmp_path):
    recording = synthetic.sequence(frames=8, camera=CAMERA, movers=())
    with pytest.raises(DeviceError, match=r"warp-cpu failed .*take --device cpu"):
        run(recording, SETTINGS, tmp_path / "run", progress=False, observers=(Breaks(device, 4),), ahead=0)
    rows = [line for line in (tmp_path / "run" / "trajectory.txt").read_text().splitlines() if line[0] != "#"]
    assert len(rows) == 5
