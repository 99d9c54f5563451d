"""The table of cameras, and the sentences where a camera or its driver is missing."""

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from dudmap.core.frames.frame import Frame
from dudmap.errors import CameraError, DatasetError, FrameError, MissingExtraError
from dudmap.io.cameras import CAMERAS, CameraFrame, LiveCamera, open_camera

DRIVERS = {
    "realsense": "pyrealsense2",
    "oak": "depthai",
    "orbbec": "pyorbbecsdk",
    "iphone": "record3d",
}


@pytest.mark.parametrize("name", DRIVERS)
def test_a_missing_driver_is_named_with_the_command_that_installs_it(name, monkeypatch):
    module = DRIVERS[name]
    monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.setattr(sys, "meta_path", [Absent(module), *sys.meta_path])
    with pytest.raises(MissingExtraError, match=rf'\({module} is not installed\); pip install "\.\[{name}\]" in'):
        open_camera(name)


class Absent:
    """Finder that knows that a module is not there."""

    def __init__(self, module):
        self.module = module

    def find_spec(self, name, path=None, target=None):
        if name == self.module:
            raise ModuleNotFoundError(name)


def test_a_missing_system_library_is_named(monkeypatch):
    class Broken(Absent):
        def find_spec(self, name, path=None, target=None):
            if name == self.module:
                raise ImportError("libusb-1.0.so.0: cannot open shared object file")

    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Broken("pyrealsense2"), *sys.meta_path])
    with pytest.raises(MissingExtraError, match=r"cannot be loaded \(libusb-1.0.so.0.*; install the system library"):
        open_camera("realsense")


FAKES = {
    "realsense": ("pyrealsense2", {"config": object, "context": lambda: SimpleNamespace(query_devices=list)}),
    "oak": ("depthai", {"Device": SimpleNamespace(getAllAvailableDevices=list)}),
    "orbbec": (
        "pyorbbecsdk",
        {"Context": lambda: SimpleNamespace(query_devices=lambda: SimpleNamespace(get_count=lambda: 0))},
    ),
    "iphone": ("record3d", {"Record3DStream": SimpleNamespace(get_connected_devices=list)}),
}


@pytest.mark.parametrize("name", FAKES)
def test_a_camera_that_is_not_connected_is_one_sentence(name, monkeypatch):
    """Drivers that answer as the real ones do without a camera."""
    module, attributes = FAKES[name]
    fake = ModuleType(module)
    for key, value in attributes.items():
        setattr(fake, key, value)
    monkeypatch.setitem(sys.modules, module, fake)
    with pytest.raises(CameraError, match=r"^no .* is connected; plug it in"):
        open_camera(name)


@pytest.mark.parametrize("name", DRIVERS)
def test_the_real_driver_without_a_camera(name):
    pytest.importorskip(DRIVERS[name], exc_type=ImportError)
    with pytest.raises(CameraError, match=r"^no .* is connected; plug it in"):
        open_camera(name)


def test_without_a_name_all_are_tried_and_their_reasons_told(monkeypatch, caplog):
    tried = []

    class Kind(LiveCamera):
        def __init__(self):
            tried.append(self)
            if len(tried) < 3:
                raise CameraError("it is not there")

        def read(self):
            return None

        def close(self):
            pass

    for entry in CAMERAS.values():
        monkeypatch.setattr(f"dudmap.io.cameras.{entry.replace(':', '.')}", Kind)
    assert open_camera() is tried[2]
    monkeypatch.setattr(Kind, "__init__", lambda self: (_ for _ in ()).throw(CameraError("it is not there")))
    caplog.clear()
    with pytest.raises(CameraError, match="no camera was found; connect one, or replay a recording as one"):
        open_camera()
    assert caplog.messages == [f"{name}: it is not there" for name in CAMERAS if name != "replay"]


def test_wrong_names_are_told():
    with pytest.raises(CameraError, match="no camera 'webcam'; expected one of realsense, oak, orbbec, iphone, replay"):
        open_camera("webcam")
    with pytest.raises(CameraError, match="expected replay:PATH"):
        open_camera("replay")
    with pytest.raises(DatasetError, match="there is no"):
        open_camera("replay:/nowhere")


def test_the_preview_skips_what_cannot_be_read():
    class Kind(LiveCamera):
        frames = iter([FrameError("bad"), 1.0, 2.0, 3.0])

        def read(self):
            item = next(self.frames, None)
            if item is None:
                return None
            if isinstance(item, float):
                item = Frame(item, np.zeros((2, 2), np.float32), np.zeros((2, 2, 3), np.uint8))
            return CameraFrame(0, item, 0.0)

        def close(self):
            pass

    assert [frame.timestamp for frame in Kind().preview(2)] == [1.0, 2.0]
    assert [frame.timestamp for frame in Kind().preview(9)] == [3.0]
