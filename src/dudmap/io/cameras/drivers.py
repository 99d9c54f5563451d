"""Cameras by the packages of their makers: RealSense, OAK, Orbbec, and iPhones by Record3D.

Constructors raise a ``CameraError`` if no camera is connected or it does not start, and a ``MissingExtraError`` if the
package is missing.
"""

import time
from abc import abstractmethod
from contextlib import suppress
from datetime import timedelta
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
from dudmap.io.sequences.intrinsics import RATIONAL, Lens

WIDTH, HEIGHT, RATE = 640, 480, 30
"""Mode of both streams of a RealSense camera."""
OAK_SIZE = (640, 400)
"""Size of all images of an OAK."""
PATIENCE_MS = 200
"""Interval of checks for a closed camera or end of a recording, milliseconds."""
LONGEST_SILENCE = 5.0
"""Time without frames after which a camera is lost, seconds."""
FRONT_CAMERA = 0
"""Device type of an iPhone's front camera, whose images are mirrored."""


class _PolledCamera(LiveCamera):
    """A camera whose driver is polled; lens distortion is removed."""

    kind = ""
    _lenses: tuple[Lens, Lens]
    _pipeline: Any

    def __init__(self) -> None:
        self.name = self.kind.lower()
        self._closed, self._reading = Event(), Lock()

    @abstractmethod
    def _poll(self) -> tuple[int, Any, Any] | None:
        """Number, depth and colour of the next frame, None after ``PATIENCE_MS``."""

    @abstractmethod
    def _frame(self, depth: Any, color: Any) -> Frame:  # noqa: ANN401 - types of the driver
        """The frame of two images of the driver."""

    def _ended(self) -> bool:
        return False

    def read(self) -> CameraFrame | None:
        silent_since = time.perf_counter()
        while not self._closed.is_set():
            with self._reading:
                found = self._poll()
            now = time.perf_counter()
            if found is not None:
                return CameraFrame(found[0], self._frame(*found[1:]), now)
            if self._ended():
                return None
            if now - silent_since > LONGEST_SILENCE:
                raise CameraError(
                    f"the {self.kind} camera sent no frame for {LONGEST_SILENCE:.0f} s; was it unplugged?"
                )
        return None

    def close(self) -> None:
        if not self._closed.is_set():
            self._closed.set()
            with self._reading, suppress(RuntimeError):  # it may have stopped by itself
                self._pipeline.stop()

    def _rectified(self, depth: NDArray, color: NDArray, times: tuple[float, float]) -> Frame:
        depth, color = self._lenses[0].rectify(depth, depth=True), self._lenses[1].rectify(color, depth=False)
        return Frame(times[0], depth, color, times[1])


class RealSenseCamera(_PolledCamera):
    """A RealSense camera by pyrealsense2; colour is registered by its factory calibration.

    Args:
        file: Recording that is played in real time instead.
    """

    kind = "RealSense"

    def __init__(self, file: str | None = None) -> None:
        super().__init__()
        rs = self._rs = driver("pyrealsense2", "realsense")
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
        self._pause()
        depth, color = profile.get_stream(rs.stream.depth), profile.get_stream(rs.stream.color)
        self._lenses = self._lens(depth), self._lens(color)
        self._swapped = color.format() == rs.format.bgr8
        self.camera = self._lenses[0].camera
        extrinsics = depth.get_extrinsics_to(color)  # the rotation is stored column by column
        T_color_depth = _motion(np.reshape(extrinsics.rotation, (3, 3)).T, extrinsics.translation)
        calibration = Calibration(self._lenses[1].camera, T_color_depth)
        self.calibration = None if calibration.is_registered(self.camera) else calibration

    def read(self) -> CameraFrame | None:
        """Next pair of depth and colour images."""
        if self._paused:
            self._paused = False
            self._playback.resume()
        return super().read()

    def preview(self, count: int) -> list[Frame]:
        """Some frames; a recording pauses meanwhile."""
        frames = super().preview(count)
        self._pause()
        return frames

    def _pause(self) -> None:
        self._paused = self._playback is not None
        if self._paused:
            self._playback.pause()

    def _ended(self) -> bool:
        return self._playback is not None and self._playback.current_status() == self._rs.playback_status.stopped

    def _poll(self) -> tuple[int, Any, Any] | None:
        found, frames = self._pipeline.try_wait_for_frames(PATIENCE_MS)
        if not (found and frames.get_depth_frame() and frames.get_color_frame()):
            return None
        depth = frames.get_depth_frame()
        number = int(depth.get_frame_number())
        if number <= self._last:  # the driver also pairs one depth image with two colour images
            return None
        self._last = number
        return number, depth, frames.get_color_frame()

    def _frame(self, depth: Any, color: Any) -> Frame:  # noqa: ANN401
        metres = np.asanyarray(depth.get_data()).astype(np.float32) * np.float32(depth.get_units())
        image = np.array(np.asanyarray(color.get_data())[..., ::-1] if self._swapped else color.get_data(), np.uint8)
        return self._rectified(metres, image, (1e-3 * depth.get_timestamp(), 1e-3 * color.get_timestamp()))

    def _lens(self, stream: Any) -> Lens:  # noqa: ANN401
        own = stream.as_video_stream_profile().get_intrinsics()
        camera = Camera(own.fx, own.fy, own.ppx, own.ppy, own.width, own.height)
        return Lens.of(camera, str(own.model).removeprefix("distortion."), tuple(own.coeffs))


class OrbbecCamera(_PolledCamera):
    """An Orbbec camera by pyorbbecsdk2, including Femto; depth and colour are not registered."""

    kind = "Orbbec"

    def __init__(self) -> None:
        super().__init__()
        ob = driver("pyorbbecsdk", "orbbec")
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
        depth = _rational_lens(own.depth_intrinsic, own.depth_distortion)
        self._lenses = depth, _rational_lens(own.rgb_intrinsic, own.rgb_distortion)
        self.camera = self._lenses[0].camera
        millimetres = np.reshape(own.transform.transform, 3)
        T_color_depth = _motion(np.reshape(own.transform.rot, (3, 3)), 1e-3 * millimetres)
        self.calibration = Calibration(self._lenses[1].camera, T_color_depth)

    def _poll(self) -> tuple[int, Any, Any] | None:
        frames = self._pipeline.wait_for_frames(PATIENCE_MS)
        depth, color = (frames.get_depth_frame(), frames.get_color_frame()) if frames else (None, None)
        if not (depth and color):
            return None
        self._numbers += 1
        return self._numbers - 1, depth, color

    def _frame(self, depth: Any, color: Any) -> Frame:  # noqa: ANN401
        millimetres = np.frombuffer(depth.get_data(), np.uint16).reshape(depth.get_height(), depth.get_width())
        metres = millimetres.astype(np.float32) * np.float32(1e-3 * depth.get_depth_scale())
        image = np.frombuffer(color.get_data(), np.uint8).reshape(color.get_height(), color.get_width(), 3)
        times = 1e-6 * depth.get_timestamp_us(), 1e-6 * color.get_timestamp_us()
        return self._rectified(metres, image.copy(), times)


def _rational_lens(own: Any, lens: Any) -> Lens:  # noqa: ANN401
    camera = Camera(own.fx, own.fy, own.cx, own.cy, own.width, own.height)
    coefficients = (lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, lens.k4, lens.k5, lens.k6)
    return Lens.of(camera, RATIONAL, coefficients)


def _motion(R: Any, t: Any) -> NDArray[np.float64]:  # noqa: ANN401
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = se3.nearest_rotation(np.asarray(R, np.float64)), t
    return T


class OakCamera(LiveCamera):
    """An OAK camera by depthai 3; depth is registered to colour in the camera."""

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
                self._pipeline.create(dai.node.Camera).build(socket).requestOutput(OAK_SIZE, fps=RATE).link(place)
            stereo.setLeftRightCheck(True)
            stereo.setSubpixel(True)
            stereo.setDepthAlign(sockets.CAM_A)
            stereo.setOutputSize(*OAK_SIZE)
            sync = self._pipeline.create(dai.node.Sync)
            output = color.requestOutput(OAK_SIZE, dai.ImgFrame.Type.BGR888p, fps=RATE, enableUndistortion=True)
            output.link(sync.inputs["color"])
            stereo.depth.link(sync.inputs["depth"])
            self._queue = sync.out.createOutputQueue(maxSize=2, blocking=False)
            K = self._pipeline.getDefaultDevice().readCalibration().getCameraIntrinsics(sockets.CAM_A, *OAK_SIZE)
            self._pipeline.start()
        except RuntimeError as error:
            raise CameraError(f"the OAK camera cannot be started: {error}") from error
        self.camera = Camera(K[0][0], K[1][1], K[0][2], K[1][2], *OAK_SIZE)
        self._closed_error = dai.MessageQueue.QueueException

    def read(self) -> CameraFrame | None:
        """Next pair of images."""
        try:
            group = self._queue.get(timedelta(seconds=LONGEST_SILENCE))
        except self._closed_error:
            return None
        if group is None:
            raise CameraError(f"the OAK camera sent no frame for {LONGEST_SILENCE:.0f} s; was it unplugged?")
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


class IPhoneCamera(LiveCamera):
    """An iPhone or iPad that streams by USB with Record3D (package record3d, LGPL-2.1: only optional); frames have
    their time of arrival."""

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
        color = Camera(own.fx, own.fy, own.tx, own.ty, frame.rgb.shape[1], frame.rgb.shape[0])
        self.camera = color.resized(frame.depth.shape[1], frame.depth.shape[0])
        calibration = Calibration(color)
        self.calibration = None if calibration.is_registered(self.camera) else calibration

    def read(self) -> CameraFrame | None:
        """Next pair of images."""
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
