"""iPhones and iPads with the application Record3D, by USB, through record3d (LGPL-2.1: only as an optional package)."""

import time
from threading import Event
from typing import Any

import numpy as np

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.errors import CameraError
from dudmap.io.cameras import CameraFrame, LiveCamera, driver

LONGEST_SILENCE = 5.0
"""Time without frames after which the phone counts as lost, seconds."""
FRONT_CAMERA = 0
"""Type of device of the front camera, whose images Record3D sends mirrored."""


class IPhoneCamera(LiveCamera):
    """A phone that streams depth and colour by USB; its depth images are smaller and seen from the same place.

    Record3D sends no times, so a frame has that of its arrival.

    Raises:
        CameraError: No phone is connected, it does not stream, or the package is missing.
    """

    def __init__(self) -> None:
        record3d = driver("record3d", "iphone")
        self.name = "iphone"
        self._arrived, self._stopped = Event(), Event()
        self._numbers = 0
        phones = record3d.Record3DStream.get_connected_devices()
        if not phones:
            raise CameraError("no iPhone is connected; plug it in, unlock it, and choose USB streaming in Record3D")
        self._stream = record3d.Record3DStream()
        self._stream.on_new_frame = self._arrived.set
        self._stream.on_stream_stopped = self._stop
        if not self._stream.connect(phones[0]) or not self._arrived.wait(LONGEST_SILENCE):
            raise CameraError("the iPhone sends no frames; press the red button of USB streaming in Record3D")
        frame = self._frame()
        own = self._stream.get_intrinsic_mat()
        color = Camera(own.fx, own.fy, own.tx, own.ty, frame.color.shape[1], frame.color.shape[0])
        self.camera = color.resized(frame.depth.shape[1], frame.depth.shape[0])
        calibration = Calibration(color)
        self.calibration = None if calibration.is_registered(self.camera) else calibration

    def read(self) -> CameraFrame | None:
        """Next pair of depth and colour images."""
        if not self._arrived.wait(LONGEST_SILENCE) and not self._stopped.is_set():
            raise CameraError(f"the iPhone sent no frame for {LONGEST_SILENCE:.0f} s; is Record3D still in front?")
        if self._stopped.is_set():
            return None
        self._arrived.clear()
        self._numbers += 1
        return CameraFrame(self._numbers - 1, self._frame(), time.perf_counter())

    def close(self) -> None:
        """Stop the stream."""
        if not self._stopped.is_set():
            self._stop()
            self._stream.disconnect()

    def _stop(self) -> None:
        self._stopped.set()
        self._arrived.set()

    def _frame(self) -> Frame:
        images: list[Any] = [self._stream.get_depth_frame(), self._stream.get_rgb_frame()]
        if self._stream.get_device_type() == FRONT_CAMERA:
            images = [image[:, ::-1] for image in images]
        depth = np.array(images[0], np.float32)
        depth[~(np.isfinite(depth) & (depth > 0))] = 0
        return Frame(time.time(), depth, np.array(images[1], np.uint8))
