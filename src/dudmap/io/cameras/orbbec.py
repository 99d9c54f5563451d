"""Orbbec cameras through pyorbbecsdk2: unregistered depth and colour with the factory calibration."""

import time
from threading import Event, Lock
from typing import Any

import numpy as np

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.errors import CameraError
from dudmap.io.cameras import CameraFrame, LiveCamera, driver
from dudmap.io.sequences.lens import RATIONAL, Lens

PATIENCE_MS = 200
"""Time after which it is looked whether the camera was closed, milliseconds."""
LONGEST_SILENCE = 5.0
"""Time without frames after which the camera counts as lost, seconds."""


class OrbbecCamera(LiveCamera):
    """An Orbbec camera, of which the Femto series has the sensors of the Azure Kinect.

    Raises:
        CameraError: No camera is connected, it is in use or has no RGB mode, or the driver is missing.
    """

    def __init__(self) -> None:
        ob = driver("pyorbbecsdk", "orbbec")
        self.name = "orbbec"
        self._closed, self._reading = Event(), Lock()
        self._numbers = 0
        if ob.Context().query_devices().get_count() == 0:
            raise CameraError("no Orbbec camera is connected; plug it in, and on Linux set the udev rule of its manual")
        try:
            self._pipeline = ob.Pipeline()
            config = ob.Config()
            colors = self._pipeline.get_stream_profile_list(ob.OBSensorType.COLOR_SENSOR)
            config.enable_stream(colors.get_video_stream_profile(0, 0, ob.OBFormat.RGB, 0))
            depths = self._pipeline.get_stream_profile_list(ob.OBSensorType.DEPTH_SENSOR)
            config.enable_stream(depths.get_default_video_stream_profile())
            config.set_frame_aggregate_output_mode(ob.OBFrameAggregateOutputMode.FULL_FRAME_REQUIRE)
            self._pipeline.start(config)
            own = self._pipeline.get_camera_param()
        except (ob.OBError, RuntimeError) as error:
            raise CameraError(f"the Orbbec camera cannot be started: {error}") from error
        self._lenses = _lens(own.depth_intrinsic, own.depth_distortion), _lens(own.rgb_intrinsic, own.rgb_distortion)
        self.camera = self._lenses[0].camera
        T = np.eye(4)
        T[:3, :3] = se3.nearest_rotation(np.array(own.transform.rot, dtype=np.float64).reshape(3, 3))
        T[:3, 3] = 1e-3 * np.array(own.transform.transform, dtype=np.float64).reshape(3)
        self.calibration = Calibration(self._lenses[1].camera, T)

    def read(self) -> CameraFrame | None:
        """Next pair of depth and colour images."""
        silent_since = time.perf_counter()
        while not self._closed.is_set():
            with self._reading:
                frames = self._pipeline.wait_for_frames(PATIENCE_MS)
            depth, color = (frames.get_depth_frame(), frames.get_color_frame()) if frames else (None, None)
            if depth and color:
                self._numbers += 1
                return CameraFrame(self._numbers - 1, self._frame(depth, color), time.perf_counter())
            if time.perf_counter() - silent_since > LONGEST_SILENCE:
                raise CameraError(f"the Orbbec camera sent no frame for {LONGEST_SILENCE:.0f} s; was it unplugged?")
        return None

    def close(self) -> None:
        """Stop the camera."""
        if not self._closed.is_set():
            self._closed.set()
            with self._reading:
                self._pipeline.stop()

    def _frame(self, depth: Any, color: Any) -> Frame:  # noqa: ANN401 - types of the driver
        millimetres = np.frombuffer(depth.get_data(), np.uint16).reshape(depth.get_height(), depth.get_width())
        metres = millimetres.astype(np.float32) * np.float32(1e-3 * depth.get_depth_scale())
        image = np.frombuffer(color.get_data(), np.uint8).reshape(color.get_height(), color.get_width(), 3)
        return Frame(
            1e-6 * depth.get_timestamp_us(),
            self._lenses[0].rectify(metres, depth=True),
            self._lenses[1].rectify(image.copy(), depth=False),
            1e-6 * color.get_timestamp_us(),
        )


def _lens(own: Any, lens: Any) -> Lens:  # noqa: ANN401
    """Lens of factory intrinsics, whose eight coefficients are those of the rational model."""
    camera = Camera(own.fx, own.fy, own.cx, own.cy, own.width, own.height)
    coefficients = (lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, lens.k4, lens.k5, lens.k6)
    return Lens.of(camera, RATIONAL, coefficients)
