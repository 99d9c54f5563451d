"""Primesense, Xtion and Astra cameras through OpenNI 2, where OpenCV is built with it; wheels of OpenCV are not."""

import time

import numpy as np

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera
from dudmap.errors import CameraError
from dudmap.io.cameras import CameraFrame, LiveCamera


class OpenNiCamera(LiveCamera):
    """An OpenNI 2 camera whose driver registers depth to colour.

    Raises:
        CameraError: OpenCV is built without OpenNI 2, or no camera is connected.
    """

    def __init__(self) -> None:
        import cv2

        self.name = "openni"
        self._numbers, self._closed = 0, False
        if cv2.CAP_OPENNI2 not in cv2.videoio_registry.getCameraBackends():
            raise CameraError(
                "OpenCV is built without OpenNI 2 here, as all its wheels are; build OpenCV with WITH_OPENNI2=ON"
            )
        self._capture = cv2.VideoCapture(cv2.CAP_OPENNI2)
        if not self._capture.isOpened():
            raise CameraError("no OpenNI 2 camera is connected; plug it in, and install its driver (libopenni2-0)")
        self._capture.set(cv2.CAP_OPENNI_DEPTH_GENERATOR_REGISTRATION, 1)
        focal = self._capture.get(cv2.CAP_OPENNI_DEPTH_GENERATOR_FOCAL_LENGTH)
        height, width = self._frame().depth.shape
        self.camera = Camera(focal, focal, width / 2 - 0.5, height / 2 - 0.5, width, height)

    def read(self) -> CameraFrame | None:
        """Next pair of depth and colour images."""
        if self._closed:
            self._capture.release()
            return None
        self._numbers += 1
        return CameraFrame(self._numbers - 1, self._frame(), time.perf_counter())

    def close(self) -> None:
        """Stop the camera."""
        self._closed = True

    def _frame(self) -> Frame:
        import cv2

        if not self._capture.grab():
            raise CameraError("the OpenNI 2 camera sent no frame; was it unplugged?")
        arrival = time.time()
        found_depth, depth = self._capture.retrieve(flag=cv2.CAP_OPENNI_DEPTH_MAP)
        found_color, color = self._capture.retrieve(flag=cv2.CAP_OPENNI_BGR_IMAGE)
        if not (found_depth and found_color):
            raise CameraError("the OpenNI 2 camera sends no depth or no colour")
        return Frame(arrival, depth.astype(np.float32) * np.float32(1e-3), np.array(color[..., ::-1], np.uint8))
