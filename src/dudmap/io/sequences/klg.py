"""The ``.klg`` logs of ElasticFusion and Kintinuous (Whelan et al. 2015)."""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera
from dudmap.errors import DatasetError, FrameError
from dudmap.input_files import LARGEST_FILE, open_plain
from dudmap.io.sequences import images, intrinsics
from dudmap.io.sequences.recording import Recording
from dudmap.io.sequences.sens import decode_values

FRAME_HEADER = struct.Struct("<qii")
"""Time in microseconds, bytes of the depth image and bytes of the colour image."""
DEPTH_SCALE = 1000.0
"""Depth units per metre: the logger writes the millimetres of OpenNI."""


class _Entry(NamedTuple):
    offset: int
    time: int
    depth_bytes: int
    color_bytes: int


class KlgRecording(Recording):
    """Recording in a ``.klg`` file: depth in millimetres (raw or zlib) and colour (raw or JPEG), registered.

    The file gives neither the intrinsics nor the image size: the intrinsics must be given, and the size comes from
    them, else from the first JPEG image, else it is 640x480, which the logger always wrote.

    Args:
        path: The file.
        camera: Intrinsics.

    Raises:
        DatasetError: No intrinsics are given, or the file is cut off or holds no frames.
    """

    format = "ElasticFusion .klg"
    suffix = ".klg"
    options: tuple[str, ...] = ("depth_unit",)

    def __init__(self, path: str | Path, camera: Camera | str | None = None) -> None:
        super().__init__(path)
        if camera is None:
            raise DatasetError(
                f"{self.path} is a .klg file, which holds no intrinsics; give --camera "
                "fx,fy,cx,cy[,w,h[,depth_scale]], "
                "for the Xtion of ElasticFusion's own recordings --camera 528,528,320,240"
            )
        known = intrinsics.given(camera)
        self._entries = _read_index(self.path)
        times = 1e-6 * np.array([entry.time for entry in self._entries], dtype=np.float64)
        self._order = np.unique(times, return_index=True)[1]
        self.timestamps: NDArray[np.float64] = times[self._order]
        unit = known.source if "depth_scale" in known.values else "the format"
        self.sources = {"intrinsics": known.source, "depth unit": unit, "times": "the file"}
        self.camera = known.camera(*self._size(known), DEPTH_SCALE)

    def _frame(self, index: int, name: str) -> Frame:
        depth_data, color_data = self._read(index)
        raw = len(depth_data) == 2 * self.camera.width * self.camera.height
        values = decode_values(depth_data, self.camera.shape, compressed=not raw, name=name)
        color = self._color(color_data, name)
        if color.shape[:2] != self.camera.shape:
            raise FrameError(f"{name}: the colour image is not {self.camera.width}x{self.camera.height} pixels")
        depth = images.metres(values, self.camera.depth_scale, name)
        return Frame(float(self.timestamps[index]), depth, color)

    def _read(self, index: int) -> tuple[bytes, bytes]:
        entry = self._entries[self._order[index]]
        with open_plain(self.path) as file:
            file.seek(entry.offset)
            return file.read(entry.depth_bytes), file.read(entry.color_bytes)

    def _color(self, data: bytes, name: str) -> NDArray[np.uint8]:
        if len(data) == 3 * self.camera.width * self.camera.height:
            return np.frombuffer(data, np.uint8).reshape(*self.camera.shape, 3).copy()
        return images.decode_color(data, f"the colour image of {name}")

    def _size(self, known: intrinsics.Intrinsics) -> tuple[int, int]:
        """Width and height of the images."""
        if "width" in known.values:
            return int(known.values["width"]), int(known.values["height"])
        _, color = self._read(0)
        if color.startswith(images.JPEG):
            height, width = images.decode_color(color, f"the first colour image of {self.path}").shape[:2]
            return width, height
        return 640, 480


def _read_index(path: Path) -> list[_Entry]:
    """Places of the frames, without reading the images."""
    entries = []
    size = path.stat().st_size
    with open_plain(path) as file:
        head = file.read(4)
        count = struct.unpack("<i", head)[0] if len(head) == 4 else 0
        if count < 1:
            raise DatasetError(f"{path} holds no frames; expected a .klg file, which starts with their number")
        for number in range(count):
            header = file.read(FRAME_HEADER.size)
            if len(header) < FRAME_HEADER.size:
                raise DatasetError(f"{path} is cut off: it says {count} frames and holds {number}")
            time, depth_bytes, color_bytes = FRAME_HEADER.unpack(header)
            entries.append(_Entry(file.tell(), time, depth_bytes, color_bytes))
            if max(depth_bytes, color_bytes) > LARGEST_FILE:
                raise DatasetError(f"{path} is damaged: frame {number} says it has {depth_bytes + color_bytes} bytes")
            if min(depth_bytes, color_bytes) < 0 or file.seek(depth_bytes + color_bytes, 1) > size:
                raise DatasetError(f"{path} is cut off: it says {count} frames and holds {number}")
    return entries
