"""Matroska recordings of Azure Kinect and Femto cameras (``k4arecorder``, ``k4aviewer``)."""

from collections.abc import Generator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.association import associate
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.errors import DatasetError, FrameError
from dudmap.extras import extra
from dudmap.input_files import LARGEST_FILE, foreign, open_plain, parse_json
from dudmap.io.sequences import Recording, images
from dudmap.io.sequences.bag_file import MessageStream
from dudmap.io.sequences.intrinsics import RATIONAL, Lens

BEFORE = 1_000_000_000
"""Seeks begin this much earlier, nanoseconds."""
DEPTH_MODES = {
    (320, 288): (512, 96, 90), (640, 576): (1024, 192, 180), (512, 512): (512, 0, 0), (1024, 1024): (1024, 0, 0),
}  # fmt: skip
"""By size of depth images: size of the sensor image of the calibration, and offset of the crop (Azure Kinect Sensor
SDK, src/transformation/mode_specific_calibration.c)."""
RAW_COLORS = {"nv12": "COLOR_YUV2RGB_NV12", "yuyv422": "COLOR_YUV2RGB_YUY2", "bgra": "COLOR_BGRA2RGB"}


class _Track(NamedTuple):
    """Stream, width and height of its images, and times (N,) in nanoseconds."""

    stream: Any
    size: tuple[int, int]
    times: NDArray[np.int64]


class AzureKinectRecording(Recording):
    """``.mkv`` file with tracks COLOR and DEPTH and the attachment calibration.json.

    Layout: https://learn.microsoft.com/previous-versions/azure/kinect-dk/record-file-format. Depth is in millimetres,
    of its own camera; lenses are corrected. Opening reads the whole file.
    """

    format = "Azure Kinect .mkv"
    suffix = ".mkv"

    def __init__(self, path: str | Path, camera: Camera | str | None = None) -> None:
        super().__init__(path)
        open_plain(self.path).close()
        with extra("azure-kinect", f"the recording {path}"):
            import av  # pyright: ignore[reportMissingImports]
        with foreign(DatasetError, f"the recording {path}"):
            self._container = av.open(str(self.path), format="matroska")
            color, depth = self._tracks()
            pairs = associate(color.times / 1e9, depth.times / 1e9)
            self._times = [(int(color.times[i]), int(depth.times[j])) for i, j in pairs]
            if not pairs:
                raise DatasetError(
                    f"{path} has {len(color.times)} colour and {len(depth.times)} depth images in no pair"
                )
            self.timestamps = np.array([time for _, time in self._times]) / 1e9
            self._color, self._depth = color, depth
            self._find_cameras(camera)
        self._stream = MessageStream(self._passing)

    def _frame(self, index: int, name: str) -> Frame:
        times = self._times[index]
        with foreign(FrameError, name):
            color_data, depth_data = self._stream.read([("COLOR", times[0]), ("DEPTH", times[1])])
        values = np.frombuffer(depth_data, ">u2").reshape(self.camera.shape).astype(np.uint16)
        depth = images.metres(values, self.camera.depth_scale, name)
        color = self._color_image(color_data, name)
        depth, color = self._depth_lens.rectify(depth, depth=True), self._color_lens.rectify(color, depth=False)
        return Frame(1e-9 * times[1], depth, color, 1e-9 * times[0])

    def _color_image(self, data: bytes, name: str) -> NDArray[np.uint8]:
        import cv2

        width, height = self._color.size
        kind = self._color.stream.codec_context.pix_fmt
        if self._color.stream.codec_context.name == "mjpeg":
            color = images.decode_color(data, f"the colour image of {name}")
        elif kind in RAW_COLORS:
            rows = height * 3 // 2 if kind == "nv12" else height
            pixels = np.frombuffer(data, np.uint8).reshape(rows, width, -1)
            color = np.asarray(cv2.cvtColor(pixels, getattr(cv2, RAW_COLORS[kind])), np.uint8)
        else:
            raise FrameError(f"the colour images of {self.path} are {kind}; expected MJPG, NV12, YUY2 or BGRA")
        if color.shape[:2] != (height, width):
            raise FrameError(f"the colour image of {name} is not {width}x{height} pixels, as its track says")
        return color

    def _tracks(self) -> list[_Track]:
        found = {s.metadata.get("title"): s for s in self._container.streams.video}
        if "COLOR" not in found or "DEPTH" not in found:
            raise DatasetError(
                f"{self.path} is a video with the tracks {list(found)}; expected COLOR and DEPTH of an Azure Kinect"
            )
        streams = [found["COLOR"], found["DEPTH"]]
        times: dict[int, set[int]] = {stream.index: set() for stream in streams}
        for packet in self._container.demux(streams):
            if packet.pts is not None:
                times[packet.stream.index].add(_nanoseconds(packet))
        return [
            _Track(s, (s.codec_context.width, s.codec_context.height), np.array(sorted(times[s.index]), np.int64))
            for s in streams
        ]

    def _passing(self, _: list[str], start: int) -> Generator[tuple[str, int, bytes]]:
        streams = {track.stream.index: name for name, track in (("COLOR", self._color), ("DEPTH", self._depth))}
        first = self._depth.stream
        self._container.seek(max(0, int((start - BEFORE) * 1e-9 / first.time_base)), stream=first)
        for packet in self._container.demux([self._color.stream, self._depth.stream]):
            if packet.pts is not None and packet.size <= LARGEST_FILE:
                yield streams[packet.stream.index], _nanoseconds(packet), bytes(packet)

    def _find_cameras(self, given: Camera | str | None) -> None:
        attached = next((s for s in self._container.streams.attachments if s.name == "calibration.json"), None)
        if attached is None:
            raise DatasetError(f"{self.path} lacks the attachment calibration.json, which holds the cameras")
        found = parse_json(bytes(attached.data).rstrip(b"\0"))["CalibrationInformation"]["Cameras"]
        tree = {camera["Location"]: camera for camera in found}
        mode = DEPTH_MODES.get(self._depth.size)
        if mode is None:
            raise DatasetError(
                f"{self.path} has depth images of {self._depth.size}; expected one of {list(DEPTH_MODES)}"
            )
        sensor, left, top = mode
        self._depth_lens = _lens(tree["CALIBRATION_CameraLocationD0"], self._depth.size, (sensor, sensor), (left, top))
        other, (width, height) = tree["CALIBRATION_CameraLocationPV0"], self._color.size
        whole = width * other["SensorHeight"] / other["SensorWidth"]  # rows of an image of the whole sensor
        self._color_lens = _lens(other, self._color.size, (width, whole), (0, (whole - height) / 2))
        T_color_depth = np.eye(4)
        T_color_depth[:3, :3] = np.array(other["Rt"]["Rotation"], np.float64).reshape(3, 3)
        T_color_depth[:3, 3] = other["Rt"]["Translation"]
        calibration = Calibration(self._color_lens.camera, T_color_depth)
        self._set_cameras(self._depth_lens.camera, calibration, "calibration.json in the file", given)
        self._depth_lens = replace(self._depth_lens, camera=self.camera)


def _nanoseconds(packet: Any) -> int:  # noqa: ANN401
    return round(packet.pts * packet.time_base * 1_000_000_000)


def _lens(tree: dict[str, Any], size: tuple[int, int], whole: tuple[float, float], cut: tuple[float, float]) -> Lens:
    model = tree["Intrinsics"]["ModelType"]
    if model != "CALIBRATION_LensDistortionModelBrownConrady":
        raise DatasetError(
            f"calibration.json has the lens {model}; expected CALIBRATION_LensDistortionModelBrownConrady"
        )
    cx, cy, fx, fy, *rest = (float(number) for number in islice(tree["Intrinsics"]["ModelParameters"], 14))
    k1, k2, k3, k4, k5, k6, _, _, p2, p1 = rest
    camera = Camera(
        fx * whole[0], fy * whole[1], cx * whole[0] - cut[0] - 0.5, cy * whole[1] - cut[1] - 0.5, *size, 1000.0
    )
    return Lens.of(camera, RATIONAL, (k1, k2, p1, p2, k3, k4, k5, k6))
