"""Which device is taken, and what is said where it does not work; without Warp and without a GPU."""

import sys

import pytest

from dudmap.config import Config
from dudmap.errors import ConfigError, MissingExtraError
from dudmap.gpu import device
from dudmap.kernels.cpu import CpuBackend


@pytest.fixture
def machine(monkeypatch):
    """A machine with a driver, GPUs and Warp, or without."""

    def make(driver=(13, 0), gpus=2, warp=True, supported=2):
        monkeypatch.setattr(device, "driver_version", lambda: driver)
        monkeypatch.setattr(device, "num_gpus", lambda: gpus)
        monkeypatch.setattr(device, "_has_warp", lambda: warp)
        if not warp:
            monkeypatch.setitem(sys.modules, "warp", None)
        monkeypatch.setattr(device, "supported_gpus", lambda: supported)
        device.resolve.cache_clear()

    yield make
    device.resolve.cache_clear()


def test_automatic_choice(machine):
    machine()
    assert device.resolve("auto") == "cuda:0"
    for without in ({"driver": None}, {"driver": (12, 8)}, {"gpus": 0}, {"warp": False}, {"supported": 0}):
        machine(**without)
        assert device.resolve("auto") == "cpu"
        assert isinstance(device.make_backend("auto"), CpuBackend)


def test_gpus_by_number(machine):
    machine()
    assert device.resolve("cuda") == "cuda:0"
    assert device.resolve("cuda:1") == "cuda:1"
    with pytest.raises(ConfigError, match="no device cuda:2; this machine has cuda:0, cuda:1"):
        device.resolve("cuda:2")


@pytest.mark.parametrize(
    ("without", "reason"),
    [
        ({"driver": None}, "no NVIDIA driver was found"),
        ({"driver": (12, 8)}, "supports CUDA 12.8, but Warp needs 13.0, that is driver 580 or later"),
        ({"gpus": 0}, "finds no GPU"),
        ({"warp": False}, r'pip install "dudmap\[gpu\]"'),
        ({"supported": 0}, "compute capability 7.5 or later"),
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
