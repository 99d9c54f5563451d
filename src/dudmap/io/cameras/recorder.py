"""Recording of live frames into an MCAP file of ROS 2 messages, in threads."""

import os
import shutil
from pathlib import Path
from queue import Full, Queue
from threading import Event, Lock, Thread
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.errors import CameraError
from dudmap.io.exporting import ros_messages as ros
from dudmap.io.exporting.ros_messages import McapWriter

if TYPE_CHECKING:
    from dudmap.core.frames.frame import Frame
    from dudmap.core.geometry.calibration import Calibration
    from dudmap.core.geometry.camera import Camera

AHEAD = 60
"""Frames that wait for the disk: two seconds, about 130 MB at 640x480."""
UNSAVED = 0.5
"""Seconds after which a frame is on a fast disk."""
COLOR, ALIGNED, DEPTH = "/camera/color", "/camera/aligned_depth_to_color", "/camera/depth"
"""Namespaces of the topics ``image_raw`` and ``camera_info``; ``ALIGNED``: depth registered to colour."""
COLOR_FRAME, DEPTH_FRAME = "camera_color_optical_frame", "camera_depth_optical_frame"
"""Frames of reference (ROS REP 103: x right, y down, z forward)."""


class Recorder:
    """Writes frames without loss to an MCAP file that ``dudmap run`` and ROS 2 read.

    ``put`` never waits: frames too fast for the disk are dropped and counted. The file is ``<name>.recording`` until
    complete; after a kill it lacks at most ``UNSAVED`` seconds.

    Args:
        path: New .mcap file.

    Attributes:
        written, dropped: Numbers of frames.

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
        self._camera, self._calibration, self._last = camera, calibration, -1
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if self._folder.exists():
                raise CameraError(
                    f"{self._folder} holds a recording that was not closed, which dudmap reads; rename the folder to "
                    "keep it, or remove it"
                )
            self._writer = McapWriter(self._folder, "recording", compressed=False)
        except OSError as error:
            raise CameraError(f"cannot record to {path.parent}: {error.strerror or error}") from error
        self._error: Exception | None = None
        self._queue: Queue[Frame | None] = Queue(AHEAD)
        self._lock, self._closed = Lock(), Event()
        self._threads = [
            Thread(target=work, name="dudmap-recorder", daemon=True) for work in (self._run, self._bring_to_disk)
        ]
        for thread in self._threads:
            thread.start()

    def put(self, frame: "Frame") -> None:
        """Record a frame, or count it as dropped; never blocks."""
        try:
            self._queue.put_nowait(frame)
        except Full:
            self.dropped += 1

    def close(self) -> None:
        """Write the waiting frames and move the file to its place.

        Raises:
            CameraError: The disk is full or the file cannot be written.
        """
        self._queue.put(None)
        self._closed.set()
        for thread in self._threads:
            thread.join()
        try:
            self._writer.close()
            if self._error is None and self.written:
                self._writer.file.replace(self.path)
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
                with self._lock:
                    self._write(frame)
                self.written += 1
            except Exception as error:  # reported by close
                self._error = error
                self.dropped += 1

    def _bring_to_disk(self) -> None:
        while not self._closed.wait(UNSAVED) and self._error is None:
            try:
                with self._lock:
                    handle = self._writer.flush()
                os.fsync(handle)
            except OSError as error:  # reported by close
                self._error = error

    def _write(self, frame: "Frame") -> None:
        writer, types, calibration = self._writer, self._writer.types, self._calibration
        recorded = max(round(frame.timestamp * 1e9), self._last + 1)
        depth_frame, depth_space = (COLOR_FRAME, ALIGNED) if calibration is None else (DEPTH_FRAME, DEPTH)
        if self._last < 0 and calibration is not None:
            T_depth_color = se3.inverse(calibration.T_color_depth)
            place = ros.transform(types, frame.timestamp, T_depth_color, DEPTH_FRAME, COLOR_FRAME)
            writer.write("/tf_static", recorded, ros.transforms(types, [place]))
        self._last = recorded
        color_stamp = frame.timestamp if frame.color_timestamp is None else frame.color_timestamp
        color_camera = self._camera if calibration is None else calibration.camera
        images: list[tuple[str, str, Camera, float, tuple[NDArray[Any], str]]] = [
            (depth_space, depth_frame, self._camera, frame.timestamp, self._depth(frame.depth))
        ]
        if frame.color is not None:
            images.append((COLOR, COLOR_FRAME, color_camera, color_stamp, (frame.color, "rgb8")))
        for space, name, camera, stamp, (pixels, encoding) in images:
            writer.write(f"{space}/camera_info", recorded, ros.camera_info(types, stamp, camera, name))
            writer.write(f"{space}/image_raw", recorded, ros.image(types, stamp, pixels, encoding, name))

    def _depth(self, depth: NDArray[np.float32]) -> tuple[NDArray[Any], str]:
        if self._camera.depth_scale == 1000:
            millimetres = np.rint(depth * np.float32(1000))
            if millimetres.max(initial=0) <= np.iinfo(np.uint16).max:
                values = millimetres.astype(np.uint16)
                if np.array_equal(values.astype(np.float32) / np.float32(1000), depth):
                    return values, "16UC1"
        return depth, "32FC1"
