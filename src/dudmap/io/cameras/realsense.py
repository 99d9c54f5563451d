"""RealSense cameras through pyrealsense2 (Apache-2.0), and recordings of them played in real time."""

import time
from contextlib import suppress
from threading import Event, Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.errors import CameraError
from dudmap.io.cameras import CameraFrame, LiveCamera, driver
from dudmap.io.sequences.lens import Lens

WIDTH, HEIGHT, RATE = 640, 480, 30
"""Mode of both streams, which all cameras of the D400 and L500 series have."""
PATIENCE_MS = 200
"""Time after which it is looked whether the camera was closed or a recording has ended, milliseconds."""
LONGEST_SILENCE = 5.0
"""Time without frames after which a camera counts as lost, seconds; the first frame takes up to 2 s."""


class RealSenseCamera(LiveCamera):
    """A RealSense camera; colour is registered by its factory calibration.

    Args:
        file: Recording of a RealSense camera that is played in real time instead of a camera.

    Raises:
        CameraError: No camera is connected, it is in use, or the driver is missing.
    """

    def __init__(self, file: str | None = None) -> None:
        rs = self._rs = driver("pyrealsense2", "realsense")
        self.name, self._file = "realsense", file
        self._closed, self._reading, self._paused = Event(), Lock(), False
        self._last = -1
        config = rs.config()
        if file is not None:
            config.enable_device_from_file(file, repeat_playback=False)
        elif len(rs.context().query_devices()) == 0:
            raise CameraError("no RealSense camera is connected; plug it into a USB 3 port")
        else:
            config.enable_stream(rs.stream.depth, WIDTH, HEIGHT, rs.format.z16, RATE)
            config.enable_stream(rs.stream.color, WIDTH, HEIGHT, rs.format.rgb8, RATE)
        self._pipeline = rs.pipeline()
        try:
            profile = self._pipeline.start(config)
        except RuntimeError as error:
            raise CameraError(f"the RealSense camera cannot be started: {error}") from error
        self._playback: Any = profile.get_device().as_playback() if file is not None else None
        if self._playback is not None:
            self._playback.pause()
            self._paused = True
        depth, color = profile.get_stream(rs.stream.depth), profile.get_stream(rs.stream.color)
        self._lenses = _lens(rs, depth), _lens(rs, color)
        self._swapped = color.format() == rs.format.bgr8
        self.camera = self._lenses[0].camera
        calibration = Calibration(self._lenses[1].camera, _motion(depth.get_extrinsics_to(color)))
        self.calibration = None if calibration.is_registered(self.camera) else calibration

    def read(self) -> CameraFrame | None:
        """Next pair of depth and colour images."""
        if self._paused:
            self._paused = False
            self._playback.resume()
        silent_since = time.perf_counter()
        while not self._closed.is_set():
            with self._reading:
                found, frames = self._pipeline.try_wait_for_frames(PATIENCE_MS)
            now = time.perf_counter()
            if found and frames.get_depth_frame() and frames.get_color_frame():
                number = int(frames.get_depth_frame().get_frame_number())
                if number > self._last:  # the driver also pairs one depth image with two colour images
                    self._last = number
                    return CameraFrame(number, self._frame(frames), now)
            if self._playback is not None and self._playback.current_status() == self._rs.playback_status.stopped:
                return None
            if now - silent_since > LONGEST_SILENCE:
                raise CameraError(f"the RealSense camera sent no frame for {LONGEST_SILENCE:.0f} s; was it unplugged?")
        return None

    def preview(self, count: int) -> list[Frame]:
        """Some frames; a recording goes on when the next is read, not while the kernels are loaded."""
        frames = super().preview(count)
        if self._playback is not None:
            self._playback.pause()
            self._paused = True
        return frames

    def close(self) -> None:
        """Stop the camera."""
        if not self._closed.is_set():
            self._closed.set()
            with self._reading, suppress(RuntimeError):  # it may have stopped by itself
                self._pipeline.stop()

    def _frame(self, frames: Any) -> Frame:  # noqa: ANN401 - a type of the driver
        depth, color = frames.get_depth_frame(), frames.get_color_frame()
        metres = np.asanyarray(depth.get_data()).astype(np.float32) * np.float32(depth.get_units())
        image = np.array(np.asanyarray(color.get_data())[..., ::-1] if self._swapped else color.get_data(), np.uint8)
        return Frame(
            1e-3 * depth.get_timestamp(),
            self._lenses[0].rectify(metres, depth=True),
            self._lenses[1].rectify(image, depth=False),
            1e-3 * color.get_timestamp(),
        )


def _lens(rs: Any, stream: Any) -> Lens:  # noqa: ANN401
    """Lens of a stream, from its factory intrinsics."""
    own = stream.as_video_stream_profile().get_intrinsics()
    camera = Camera(own.fx, own.fy, own.ppx, own.ppy, own.width, own.height)
    return Lens.of(camera, str(own.model).removeprefix("distortion."), tuple(own.coeffs))


def _motion(extrinsics: Any) -> NDArray[np.float64]:  # noqa: ANN401
    """Motion (4, 4) of extrinsics, whose rotation is stored column by column."""
    T = np.eye(4)
    T[:3, :3] = se3.nearest_rotation(np.array(extrinsics.rotation, dtype=np.float64).reshape(3, 3).T)
    T[:3, 3] = extrinsics.translation
    return T
