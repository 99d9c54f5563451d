"""ScanNet's ``.sens`` files (Dai et al. 2017): one file with the images, poses and cameras of a recording."""

import struct
import zlib
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError, FrameError
from dudmap.input_files import LARGEST_FILE, open_plain
from dudmap.io.sequences import images
from dudmap.io.sequences.recording import Recording

VERSION = 4
"""The version of the format that ScanNet publishes."""
FRAME_HEADER = struct.Struct("<16f4Q")
"""Pose camera to world row by row, colour and depth time in microseconds, bytes of the colour and depth image."""
PERIOD = 1 / 30
"""Seconds between frames that have no usable times: the rate of ScanNet's Structure Sensor."""


class _Entry(NamedTuple):
    """Place of a frame in the file, its sizes in bytes and times in microseconds."""

    offset: int
    color_bytes: int
    depth_bytes: int
    color_time: int
    depth_time: int


class SensRecording(Recording):
    """Recording in a ``.sens`` file.

    Opening walks over the headers of the frames and keeps their offsets; images are read when they are asked for. The
    colour images of ScanNet are larger than the depth images and come from another camera, so that ``calibration``
    holds the colour camera. Frames whose times are all zero or do not increase are taken to be 1/30 s apart.

    Args:
        path: The file.
        camera: Intrinsics of the depth images that replace those of the file.

    Raises:
        DatasetError: The file is damaged, of another version, or compressed in a way that is not supported.
    """

    format = "ScanNet .sens"
    suffix = ".sens"
    options: tuple[str, ...] = ("depth_unit",)

    def __init__(self, path: str | Path, camera: Camera | str | None = None) -> None:
        super().__init__(path)
        with open_plain(self.path) as file:
            try:
                header = _read_header(file, self.path)
                self._entries, poses = _read_index(file, header.num_frames)
            except struct.error:
                raise DatasetError(f"{self.path} is cut off: its frames end before the file says") from None
        self._deflated = header.depth_codec == 1
        T_color_depth = se3.inverse(header.color_extrinsic) @ header.depth_extrinsic
        color = Calibration(header.camera(header.color_intrinsic, header.color_size), T_color_depth)
        own = header.camera(header.depth_intrinsic, header.depth_size)
        self._set_cameras(own, color, "the header of the file", camera)
        self.timestamps = _times([entry.depth_time for entry in self._entries])
        self.timed = self.timestamps[-1] == 1e-6 * self._entries[-1].depth_time
        if not self.timed:
            self.sources["times"] = "assumed, 30 frames a second"
        self._color_times = [1e-6 * entry.color_time if self.timed else None for entry in self._entries]
        valid = np.isfinite(poses).all(axis=(1, 2))
        truth = Trajectory(self.timestamps[valid], poses[valid] @ header.depth_extrinsic)
        self.ground_truth = truth if valid.any() else None

    def _frame(self, index: int, name: str) -> Frame:
        entry = self._entries[index]
        with open_plain(self.path) as file:
            file.seek(entry.offset)
            color = images.decode_color(file.read(entry.color_bytes), f"the colour image of {name}")
            data = file.read(entry.depth_bytes)
        expected = self.camera if self.calibration is None else self.calibration.camera
        if color.shape[:2] != expected.shape:
            raise FrameError(f"{name}: the colour image has another size than the file's header says")
        depth = decode_values(data, self.camera.shape, compressed=self._deflated, name=name)
        depth = images.metres(depth, self.camera.depth_scale, name)
        return Frame(float(self.timestamps[index]), depth, color, self._color_times[index])


class _Header(NamedTuple):
    color_intrinsic: NDArray[np.float64]
    color_extrinsic: NDArray[np.float64]
    depth_intrinsic: NDArray[np.float64]
    depth_extrinsic: NDArray[np.float64]
    depth_codec: int
    color_size: tuple[int, int]
    depth_size: tuple[int, int]
    depth_scale: float
    num_frames: int

    def camera(self, K: NDArray[np.float64], size: tuple[int, int]) -> Camera:
        return Camera(
            K[0, 0], K[1, 1], K[0, 2], K[1, 2], *size, depth_scale=self.depth_scale
        )  # fmt: skip


def _read_header(file: IO[bytes], path: Path) -> _Header:
    (version,) = _unpack(file, "<I")
    if version != VERSION:
        raise DatasetError(f"{path} has version {version} of the .sens format; expected {VERSION}, which ScanNet uses")
    (length,) = _unpack(file, "<Q")
    file.seek(length, 1)  # name of the sensor
    color_K, color_extrinsic, depth_K, depth_extrinsic = (
        np.array(_unpack(file, "<16f"), dtype=np.float64).reshape(4, 4) for _ in range(4)
    )
    color_codec, depth_codec = _unpack(file, "<2i")
    color_w, color_h, depth_w, depth_h, depth_shift, num_frames = _unpack(file, "<4IfQ")
    if color_codec not in (1, 2) or depth_codec not in (0, 1):
        raise DatasetError(
            f"{path} stores colour as number {color_codec} and depth as number {depth_codec}; expected PNG or JPEG (1, "
            "2) and raw or zlib (0, 1)"
        )
    if num_frames == 0:
        raise DatasetError(f"{path} holds no frames")
    return _Header(
        color_K, color_extrinsic, depth_K, depth_extrinsic, depth_codec, (color_w, color_h),
        (depth_w, depth_h), depth_shift, num_frames,
    )  # fmt: skip


def _read_index(file: IO[bytes], num_frames: int) -> tuple[list[_Entry], NDArray[np.float64]]:
    """Places of the frames and their poses (N, 4, 4), without reading the images."""
    end = file.seek(0, 1), file.seek(0, 2)
    file.seek(end[0])
    entries, poses = [], []
    for _ in range(num_frames):
        *pose, color_time, depth_time, color_bytes, depth_bytes = _unpack(file, FRAME_HEADER.format)
        entries.append(_Entry(file.tell(), color_bytes, depth_bytes, color_time, depth_time))
        poses.append(pose)
        if color_bytes + depth_bytes > LARGEST_FILE or file.seek(color_bytes + depth_bytes, 1) > end[1]:
            raise struct.error
    return entries, np.array(poses, dtype=np.float64).reshape(-1, 4, 4)


def _times(microseconds: list[int]) -> NDArray[np.float64]:
    times = 1e-6 * np.array(microseconds, dtype=np.float64)
    if np.any(np.diff(times) <= 0):
        times = PERIOD * np.arange(len(times))
    return times.astype(np.float64)


def _unpack(file: IO[bytes], form: str) -> tuple:
    return struct.unpack(form, file.read(struct.calcsize(form)))


def decode_values(data: bytes, shape: tuple[int, int], *, compressed: bool, name: str) -> NDArray[np.uint16]:
    """16-bit depth values (H, W) of a buffer, raw or deflated by zlib.

    Raises:
        FrameError: The data cannot be inflated, or are not of this size.
    """
    expected = 2 * shape[0] * shape[1]
    if compressed:
        try:
            data = zlib.decompressobj().decompress(data, expected + 1)
        except zlib.error as error:
            raise FrameError(f"{name}: the depth image is damaged, {error}") from None
    if len(data) != expected:
        raise FrameError(f"{name}: the depth image has {len(data)} bytes; expected {expected} of {shape[1]}x{shape[0]}")
    return np.frombuffer(data, dtype="<u2").reshape(shape).astype(np.uint16, copy=False)
