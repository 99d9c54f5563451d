"""Live cameras: one class per driver, all with the interface ``LiveCamera``."""

import logging
from abc import ABC, abstractmethod
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

from dudmap.errors import CameraError, FrameError, MissingExtraError
from dudmap.extras import extra

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from dudmap.core.frames.frame import Frame
    from dudmap.core.geometry.calibration import Calibration
    from dudmap.core.geometry.camera import Camera
    from dudmap.core.geometry.trajectory import Trajectory

__all__ = ["CAMERAS", "MAX_WAIT", "CameraFrame", "LiveCamera", "driver", "open_camera"]

log = logging.getLogger(__name__)

CAMERAS = {
    "realsense": "drivers:RealSenseCamera",
    "oak": "drivers:OakCamera",
    "orbbec": "drivers:OrbbecCamera",
    "iphone": "drivers:IPhoneCamera",
    "replay": "replay:ReplayCamera",
}
"""Module and class of every camera by name; without a name the first connected camera is used."""
MAX_WAIT = 0.1
"""Longest time for which a frame may wait, seconds: a frame of triple duration at 30 Hz drops none."""


class CameraFrame(NamedTuple):
    """One frame of a camera.

    Attributes:
        number: Number of the frame in the stream; a gap means that the camera or its driver lost frames.
        frame: The frame, or the error of reading it.
        time: Time of arrival, seconds of ``time.perf_counter``.
    """

    number: int
    frame: "Frame | FrameError"
    time: float


class LiveCamera(ABC):
    """A camera that delivers frames until it is closed.

    Attributes:
        name: Short name, usable as a folder name.
        camera: Intrinsics of the depth images.
        calibration: Of the colour camera; None for colour that is registered to depth.
        ground_truth: True poses; a camera knows none.
        length: Number of frames in the stream, None for an endless one.
        timed: Whether frame times come from a clock.
    """

    name: str
    camera: "Camera"
    calibration: "Calibration | None" = None
    ground_truth: "Trajectory | None" = None
    length: int | None = None
    timed: bool = True
    _previewed: "list[Frame] | None" = None

    @abstractmethod
    def read(self) -> CameraFrame | None:
        """Next frame; waits for it. None at the end of the stream.

        Raises:
            CameraError: The camera stopped to deliver frames.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop the camera; ``read`` in another thread returns soon."""

    def mask(self, index: int) -> "NDArray[np.bool_] | None":
        """True dynamic mask (H, W) of a frame; a camera knows none."""
        return None

    def preview(self, count: int) -> "list[Frame]":
        """Some frames before the stream begins, to load the kernels; fewer if the stream ends.

        Later calls return the frames of the first call.
        """
        if self._previewed is None:
            self._previewed = []
            while len(self._previewed) < count and (arrived := self.read()) is not None:
                if not isinstance(arrived.frame, FrameError):
                    self._previewed.append(arrived.frame)
        return self._previewed[:count]


def open_camera(text: str | None = None) -> LiveCamera:
    """Open a camera by ``name`` or ``name:argument``; None takes the first connected one.

    Raises:
        CameraError: There is no such name, no such camera is connected, or its driver is missing.
    """
    if text is None:
        return _first_connected()
    name, _, argument = text.partition(":")
    if name not in CAMERAS:
        raise CameraError(f"there is no camera {name!r}; expected one of {', '.join(CAMERAS)}")
    if name == "replay" and not argument:
        raise CameraError("which recording is to be replayed? expected replay:PATH")
    module, class_name = CAMERAS[name].split(":")
    kind = getattr(import_module(f"dudmap.io.cameras.{module}"), class_name)
    return kind(argument) if argument else kind()


def _first_connected() -> LiveCamera:
    for name in CAMERAS:
        if name != "replay":
            try:
                return open_camera(name)
            except (CameraError, MissingExtraError) as error:
                log.warning("%s: %s", name, error)
    raise CameraError("no camera was found; connect one, or replay a recording as one: dudmap live replay:PATH")


def driver(module: str, extra_name: str) -> Any:  # noqa: ANN401 - an optional package
    """Import the module of a driver.

    Raises:
        MissingExtraError: It is not installed, or a system library that it needs is missing.
    """
    with extra(extra_name, "the camera"):
        return import_module(module)
