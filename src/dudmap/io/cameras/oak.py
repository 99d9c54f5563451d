"""OAK cameras through depthai 3 (MIT): stereo depth, registered to colour in the camera."""

import time
from datetime import timedelta

import numpy as np

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera
from dudmap.errors import CameraError
from dudmap.io.cameras import CameraFrame, LiveCamera, driver

SIZE = (640, 400)
"""Size of all images: the mono cameras halved, in the aspect ratio of all OAK cameras."""
RATE = 30
LONGEST_SILENCE = timedelta(seconds=5)
"""Time without frames after which the camera counts as lost."""


class OakCamera(LiveCamera):
    """An OAK camera; depth is registered to colour, and both are rectified, by its factory calibration.

    Raises:
        CameraError: No camera is connected, it is in use, or the driver is missing.
    """

    def __init__(self) -> None:
        dai = driver("depthai", "oak")
        self.name = "oak"
        if not dai.Device.getAllAvailableDevices():
            raise CameraError("no OAK camera is connected; plug it in, and on Linux set the udev rule of its manual")
        sockets = dai.CameraBoardSocket
        try:
            self._pipeline = dai.Pipeline()
            color = self._pipeline.create(dai.node.Camera).build(sockets.CAM_A)
            stereo = self._pipeline.create(dai.node.StereoDepth)
            for socket, place in ((sockets.CAM_B, stereo.left), (sockets.CAM_C, stereo.right)):
                self._pipeline.create(dai.node.Camera).build(socket).requestOutput(SIZE, fps=RATE).link(place)
            stereo.setLeftRightCheck(True)
            stereo.setSubpixel(True)
            stereo.setDepthAlign(sockets.CAM_A)
            stereo.setOutputSize(*SIZE)
            sync = self._pipeline.create(dai.node.Sync)
            output = color.requestOutput(SIZE, dai.ImgFrame.Type.BGR888p, fps=RATE, enableUndistortion=True)
            output.link(sync.inputs["color"])
            stereo.depth.link(sync.inputs["depth"])
            self._queue = sync.out.createOutputQueue(maxSize=2, blocking=False)
            K = self._pipeline.getDefaultDevice().readCalibration().getCameraIntrinsics(sockets.CAM_A, *SIZE)
            self._pipeline.start()
        except RuntimeError as error:
            raise CameraError(f"the OAK camera cannot be started: {error}") from error
        self.camera = Camera(K[0][0], K[1][1], K[0][2], K[1][2], *SIZE)
        self._closed_error = dai.MessageQueue.QueueException

    def read(self) -> CameraFrame | None:
        """Next pair of depth and colour images."""
        try:
            group = self._queue.get(LONGEST_SILENCE)
        except self._closed_error:
            return None
        if group is None:
            raise CameraError("the OAK camera sent no frame for 5 s; was it unplugged?")
        depth, color = group["depth"], group["color"]
        frame = Frame(
            depth.getTimestamp().total_seconds(),
            depth.getFrame().astype(np.float32) * np.float32(1e-3),
            np.ascontiguousarray(color.getCvFrame()[..., ::-1]),
            color.getTimestamp().total_seconds(),
        )
        return CameraFrame(depth.getSequenceNum(), frame, time.perf_counter())

    def close(self) -> None:
        """Stop the camera."""
        if self._pipeline.isRunning():
            self._pipeline.stop()
