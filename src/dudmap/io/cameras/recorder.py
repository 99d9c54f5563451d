"""Recording of live frames into an MCAP file of ROS 2 messages, in a thread of its own."""

import shutil
from pathlib import Path
from queue import Full, Queue
from threading import Thread
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.errors import CameraError
from dudmap.extras import extra

if TYPE_CHECKING:
    from dudmap.core.frames.frame import Frame
    from dudmap.core.geometry.calibration import Calibration
    from dudmap.core.geometry.camera import Camera

AHEAD = 60
"""Frames that wait for the disk at most: two seconds of a camera, about 130 MB at 640x480."""
COLOR, ALIGNED, DEPTH = "/camera/color", "/camera/aligned_depth_to_color", "/camera/depth"
"""Namespaces of the topics ``image_raw`` and ``camera_info``; depth that is registered to colour is ``ALIGNED``."""
COLOR_FRAME, DEPTH_FRAME = "camera_color_optical_frame", "camera_depth_optical_frame"
"""Frames of reference (ROS REP 103: x right, y down, z forward)."""


class Recorder:
    """Writes frames without loss to an MCAP file that ``dudmap run`` and ROS 2 read.

    ``put`` never waits: if the disk is too slow for the camera, frames are left out and counted. The file is written
    beside its final place and moved there when it is complete.

    Args:
        path: The file; it must not exist and end in .mcap.
        camera: Intrinsics of the depth images.
        calibration: Of the colour camera, None for registered colour.

    Attributes:
        written: Number of frames in the file.
        dropped: Number of frames for which there was no time.

    Raises:
        CameraError: The file exists, has another suffix or cannot be created.
    """

    def __init__(self, path: Path, camera: "Camera", calibration: "Calibration | None") -> None:
        if path.suffix != ".mcap":
            raise CameraError(f"cannot record to {path}; expected a file that ends in .mcap")
        if path.exists():
            raise CameraError(f"cannot record to {path}, which exists; name another file")
        self.path, self.written, self.dropped = path, 0, 0
        self._folder = path.with_name(f"{path.stem}.recording")
        self._messages = _Messages(camera, calibration)
        self._writer = _open_writer(self._folder)
        self._error: Exception | None = None
        self._queue: Queue[Frame | None] = Queue(AHEAD)
        self._thread = Thread(target=self._run, name="dudmap-recorder", daemon=True)
        self._thread.start()

    def put(self, frame: "Frame") -> None:
        """Record a frame, or count it as dropped if too many wait already; never blocks."""
        try:
            self._queue.put_nowait(frame)
        except Full:
            self.dropped += 1

    def close(self) -> None:
        """Write what waits and move the file to its place.

        Raises:
            CameraError: The disk is full or the file cannot be written.
        """
        self._queue.put(None)
        self._thread.join()
        try:
            self._writer.close()
            if self._error is None and self.written:
                (self._folder / f"{self._folder.name}.mcap").replace(self.path)
            if self._error is None:
                shutil.rmtree(self._folder)
        except OSError as error:
            self._error = self._error or error
        if self._error is not None:
            raise CameraError(f"the recording {self.path} is incomplete: {self._error}") from self._error

    def _run(self) -> None:
        while (frame := self._queue.get()) is not None:
            if self._error is not None:
                self.dropped += 1
                continue
            try:
                self._messages.write(self._writer, frame)
                self.written += 1
            except Exception as error:  # reported by close
                self._error = error
                self.dropped += 1


class _Messages:
    """Frames as messages of ROS 2."""

    def __init__(self, camera: "Camera", calibration: "Calibration | None") -> None:
        from rosbags.typesys import Stores, get_typestore

        self._store = get_typestore(Stores.ROS2_HUMBLE)
        self._camera, self._calibration = camera, calibration
        self._connections: dict[str, Any] = {}
        self._last = -1

    def write(self, writer: Any, frame: "Frame") -> None:  # noqa: ANN401
        """Write images and camera_info of a frame; with the first one the place of the colour camera."""
        recorded = max(round(frame.timestamp * 1e9), self._last + 1)
        registered = self._calibration is None
        depth_frame, depth_space = (COLOR_FRAME, ALIGNED) if registered else (DEPTH_FRAME, DEPTH)
        if self._last < 0 and self._calibration is not None:
            self._put(writer, "/tf_static", self._transform(frame.timestamp, self._calibration), recorded)
        self._last = recorded
        color_stamp = frame.timestamp if frame.color_timestamp is None else frame.color_timestamp
        cameras = (
            (depth_space, depth_frame, self._camera, frame.timestamp, self._depth(frame.depth)),
            (COLOR, COLOR_FRAME, self._camera if self._calibration is None else self._calibration.camera,
             color_stamp, (frame.color, "rgb8")),
        )  # fmt: skip
        for space, name, camera, stamp, (pixels, encoding) in cameras:
            header = self._header(stamp, name)
            self._put(writer, f"{space}/camera_info", self._info(header, camera), recorded)
            self._put(writer, f"{space}/image_raw", self._image(header, pixels, encoding), recorded)

    def _depth(self, depth: NDArray[np.float32]) -> tuple[NDArray[Any], str]:
        """16-bit millimetres where they hold the depth exactly, else metres as floats."""
        if self._camera.depth_scale == 1000:
            millimetres = np.rint(depth * np.float32(1000))
            if millimetres.max(initial=0) <= np.iinfo(np.uint16).max:
                values = millimetres.astype(np.uint16)
                if np.array_equal(values.astype(np.float32) / np.float32(1000), depth):
                    return values, "16UC1"
        return depth, "32FC1"

    def _put(self, writer: Any, topic: str, message: Any, recorded: int) -> None:  # noqa: ANN401
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = writer.add_connection(topic, kind, typestore=self._store)
        writer.write(self._connections[topic], recorded, self._store.serialize_cdr(message, kind))

    def _type(self, name: str) -> Any:  # noqa: ANN401
        return self._store.types[name]

    def _header(self, stamp: float, frame: str) -> Any:  # noqa: ANN401
        seconds, nanoseconds = divmod(round(stamp * 1e9), 10**9)
        time = self._type("builtin_interfaces/msg/Time")(sec=seconds, nanosec=nanoseconds)
        return self._type("std_msgs/msg/Header")(stamp=time, frame_id=frame)

    def _image(self, header: Any, pixels: NDArray[Any], encoding: str) -> Any:  # noqa: ANN401
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
        return self._type("sensor_msgs/msg/Image")(
            header=header, height=pixels.shape[0], width=pixels.shape[1], encoding=encoding, is_bigendian=0,
            step=rows.shape[1], data=rows.reshape(-1),
        )  # fmt: skip

    def _info(self, header: Any, camera: "Camera") -> Any:  # noqa: ANN401
        P = np.zeros((3, 4))
        P[:, :3] = camera.K
        D = np.zeros(5)
        D[: len(camera.distortion)] = camera.distortion
        whole = self._type("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
        return self._type("sensor_msgs/msg/CameraInfo")(
            header=header, height=camera.height, width=camera.width, distortion_model="plumb_bob", d=D,
            k=camera.K.reshape(-1), r=np.eye(3).reshape(-1), p=P.reshape(-1), binning_x=0, binning_y=0, roi=whole,
        )  # fmt: skip

    def _transform(self, stamp: float, calibration: "Calibration") -> Any:  # noqa: ANN401
        T_depth_color = se3.inverse(calibration.T_color_depth)
        quaternion = self._type("geometry_msgs/msg/Quaternion")
        vector = self._type("geometry_msgs/msg/Vector3")
        motion = self._type("geometry_msgs/msg/Transform")(
            translation=vector(*T_depth_color[:3, 3].tolist()),
            rotation=quaternion(*se3.rotation_to_quat_xyzw(T_depth_color[:3, :3]).tolist()),
        )
        header = self._header(stamp, DEPTH_FRAME)
        stamped = self._type("geometry_msgs/msg/TransformStamped")(header, COLOR_FRAME, motion)
        return self._type("tf2_msgs/msg/TFMessage")(transforms=[stamped])


def _open_writer(folder: Path) -> Any:  # noqa: ANN401 - a type of an optional package
    with extra("ros-bags", "recording"):
        from rosbags.rosbag2 import StoragePlugin, Writer
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        if folder.exists():
            raise CameraError(f"{folder} is left from a recording that was cut off; remove it")
        writer = Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP)
        writer.open()
    except OSError as error:
        raise CameraError(f"cannot record to {folder.parent}: {error.strerror or error}") from error
    return writer
