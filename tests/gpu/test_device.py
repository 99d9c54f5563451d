"""Which device is taken, and what is said where it does not work; without Warp and without a GPU."""

import sys

import pytest
from typer.testing import CliRunner

from dudmap.cli import app
from dudmap.config import Config
from dudmap.core.backends import device
from dudmap.core.backends.cpu.backend import CpuBackend
from dudmap.core.backends.warp import faults
from dudmap.core.slam import Slam
from dudmap.errors import ConfigError, DeviceError, MissingExtraError
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA


@pytest.fixture
def machine(monkeypatch):
    """A machine with a driver, GPUs and Warp, or without."""

    def make(driver=(13, 0), warp=True, supported=(0, 1)):
        monkeypatch.setattr(device, "driver_version", lambda: driver)
        monkeypatch.setattr(device, "_has_warp", lambda: warp)
        monkeypatch.setattr(device, "warp_failure", lambda: "")
        monkeypatch.setattr(device, "start_failure", lambda name: "")
        if not warp:
            monkeypatch.setitem(sys.modules, "warp", None)
        monkeypatch.setattr(device, "supported_gpus", lambda: list(supported))
        device._resolved.cache_clear()

    yield make
    device._resolved.cache_clear()


def test_automatic_choice(machine):
    machine()
    assert device.resolve("auto") == "cuda:0"
    for without in (
        {"driver": None},
        {"driver": (12, 8)},
        {"warp": False},
        {"supported": ()},
    ):
        machine(**without)
        assert device.resolve("auto") == "cpu"
        assert isinstance(device.make_backend("auto"), CpuBackend)


def test_gpus_by_number(machine):
    machine()
    assert device.resolve("cuda") == "cuda:0"
    assert device.resolve("cuda:1") == "cuda:1"
    with pytest.raises(ConfigError, match="no device cuda:2 that Warp supports; this machine has cuda:0, cuda:1"):
        device.resolve("cuda:2")


def test_one_gpu(machine):
    machine(supported=(0,))
    assert device.resolve("cuda:0") == "cuda:0"
    with pytest.raises(ConfigError, match=r"there is no device cuda:1 that Warp supports; this machine has cuda:0$"):
        device.resolve("cuda:1")


def test_the_command_line_refuses_before_the_recording_is_opened(machine, tmp_path):
    machine(driver=(12, 8))
    done = CliRunner().invoke(app, ["run", str(tmp_path / "nothing"), "--device", "cuda"])
    assert done.exit_code == 1
    assert "supports CUDA 12.8, but Warp needs 13.0, that is driver 580 or later" in done.stderr


def test_an_old_gpu_beside_a_new_one(machine):
    """The first that Warp supports is taken, and the old one is refused by its name."""
    machine(supported=(1,))
    assert device.resolve("auto") == device.resolve("cuda") == "cuda:1"
    with pytest.raises(ConfigError, match="no device cuda:0 that Warp supports; this machine has cuda:1"):
        device.resolve("cuda:0")


def test_a_warp_that_does_not_start(monkeypatch):
    def broken():
        raise OSError("warp.so: cannot open\nshared object file")

    monkeypatch.setattr(device, "_load_warp", broken)
    assert device.warp_failure.__wrapped__() == "Warp does not start (warp.so: cannot open shared object file)"


def test_a_gpu_that_does_nothing(machine, monkeypatch):
    """Another program fills its memory: ``auto`` says so and takes the CPU, and who asked for it is refused."""
    machine()
    monkeypatch.setattr(device, "start_failure", lambda name: f"Failed to acquire primary context for device {name}")
    with pytest.raises(ConfigError, match=r"device cuda cannot be used: Failed to acquire .*; take --device cpu"):
        device.make_backend("cuda")
    with pytest.warns(device.DeviceWarning, match=r"cuda:0 cannot be used \(Failed to acquire"):
        assert isinstance(device.make_backend("auto"), CpuBackend)


def test_a_device_that_has_failed_is_not_used_again(machine):
    machine()
    with pytest.raises(DeviceError, match=r"cuda:0 failed \(CUDA error 700\)"), faults.using("cuda:0"):
        raise RuntimeError("CUDA error 700")
    try:
        assert isinstance(device.make_backend("auto"), CpuBackend)
        assert device.resolve("cuda:0") == "cpu"
        with pytest.raises(DeviceError, match="cuda:0 has failed before"), faults.using("cuda:0"):
            pass
    finally:
        faults.forget()


def test_maps_with_several_voxel_sizes_are_the_cpus(machine):
    machine()
    config = Config().override(["volume.adaptive=true"])
    assert Slam(DEFAULT_CAMERA, config).device == "cpu"
    with pytest.raises(ConfigError, match=r"found device cuda and volume\.adaptive=true.*take --device cpu"):
        Slam(DEFAULT_CAMERA, config.override(["device=cuda"]))


@pytest.mark.parametrize(
    ("without", "reason"),
    [
        ({"driver": None}, "no NVIDIA driver was found"),
        ({"driver": (12, 8)}, "supports CUDA 12.8, but Warp needs 13.0, that is driver 580 or later"),
        ({"warp": False}, r'pip install "\.\[gpu\]"'),
        ({"supported": ()}, r"cannot be used: Warp finds no GPU .*7\.5 or later.*; take --device cpu"),
    ],
)
def test_what_is_missing_is_said(machine, without, reason):
    machine(**without)
    with pytest.raises(ConfigError, match=reason) as caught:
        device.make_backend("cuda")
    assert "\n" not in str(caught.value)


def test_the_test_device_needs_warp(machine):
    machine(warp=False)
    with pytest.raises(MissingExtraError, match="warp-cpu needs the extra gpu"):
        device.make_backend("warp-cpu")


@pytest.mark.parametrize("name", ["gpu", "cuda:x", "cuda:-1", "CPU"])
def test_unknown_devices_are_refused(name):
    with pytest.raises(ConfigError, match="device"):
        Config().override([f"device={name}"])
    assert Config().override(["device=cuda:1"]).device == "cuda:1"
