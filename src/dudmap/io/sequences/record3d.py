"""The ``.r3d`` files of the iPhone application Record3D: a ZIP archive of JPEG colour and LZFSE depth."""

import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.errors import DatasetError, FrameError
from dudmap.extras import extra
from dudmap.input_files import DAMAGE, LARGEST_FILE, RATIO_FREE_BYTES, open_plain, parse_json
from dudmap.io.sequences import images
from dudmap.io.sequences.recording import Recording

LARGEST_COMMAND = 315 + 2359
"""Bytes that one command of an LZFSE block can write."""


class Record3DRecording(Recording):
    """Recording in a ``.r3d`` file.

    The depth (256x192 of a LiDAR, 640x480 of the front camera) is smaller than the colour and seen from the same
    place, so that the depth camera is the colour camera resized, and ``calibration`` holds the colour camera. Readings
    of confidence 0 are left out. The poses in the file are estimates of ARKit and therefore no ground truth.
    """

    format = "Record3D .r3d"
    suffix = ".r3d"

    def __init__(self, path: str | Path, camera: Camera | str | None = None) -> None:
        super().__init__(path)
        self._lzfse = _lzfse(self.path)
        try:
            open_plain(self.path).close()
            self._zip = zipfile.ZipFile(self.path)
        except zipfile.BadZipFile as error:
            raise DatasetError(f"{self.path} is not a whole .r3d file: {error}") from None
        self._numbers = sorted(
            int(Path(member).stem) for member in self._zip.namelist()
            if member.startswith("rgbd/") and member.endswith(".depth") and Path(member).stem.isdigit()
        )  # fmt: skip
        if not self._numbers:
            raise DatasetError(f"{self.path} holds no depth images rgbd/N.depth")
        color, size, times = self._metadata()
        self.timestamps = times
        self._set_cameras(color.resized(*size), Calibration(color), "the metadata of the file", camera)
        self.sources["depth unit"] = "the format"

    def _frame(self, index: int, name: str) -> Frame:
        number = self._numbers[index]
        color = images.decode_color(self._member(f"rgbd/{number}.jpg"), f"rgbd/{number}.jpg of {self.path}")
        return Frame(float(self.timestamps[index]), self._depth(number), color)

    def _depth(self, number: int) -> NDArray[np.float32]:
        values = self._unpacked(f"rgbd/{number}.depth", "<f4")
        depth = images.metres(values, 1.0, f"rgbd/{number}.depth of {self.path}")
        if f"rgbd/{number}.conf" in self._zip.NameToInfo:
            depth[self._unpacked(f"rgbd/{number}.conf", "u1") == 0] = 0
        return depth

    def _unpacked(self, member: str, kind: str) -> NDArray[Any]:
        """Image (H, W) of a member that holds the pixels of the depth camera, compressed by LZFSE."""
        name, width, height = f"{member} of {self.path}", self.camera.width, self.camera.height
        packed = self._member(member)
        if largest_unpacked(packed) > RATIO_FREE_BYTES:
            raise FrameError(f"{name} unpacks to too much; expected {width}x{height} pixels")
        try:
            data = self._lzfse.decompress(packed)
        except (self._lzfse.error, MemoryError) as error:
            # where a block ends too early, the decoder asks for more and more memory, which it does not use
            raise FrameError(f"{name} cannot be decompressed: {error or 'a block ends too early'}") from error
        if len(data) != np.dtype(kind).itemsize * width * height:
            raise FrameError(f"{name} has {len(data)} bytes; expected {width}x{height} pixels of {kind}")
        return np.frombuffer(data, kind).reshape(height, width)

    def _member(self, name: str) -> bytes:
        try:
            if self._zip.getinfo(name).file_size > LARGEST_FILE:
                raise FrameError(f"{name} in {self.path} has more than {LARGEST_FILE / 1e6:.0f} MB")
            return self._zip.read(name)
        except (RuntimeError, *DAMAGE) as error:
            raise FrameError(f"cannot read {name} in {self.path}: {error}") from None

    def _metadata(self) -> tuple[Camera, tuple[int, int], NDArray[np.float64]]:
        """Colour camera, size of the depth images, and times (N,) in seconds of the frames."""
        try:
            tree: dict[str, Any] = parse_json(self._member("metadata"))
            fx, _, _, _, fy, _, cx, cy, _ = (float(number) for number in tree["K"])  # column by column
            color = Camera(fx, fy, cx, cy, int(tree["w"]), int(tree["h"]))
            size = int(tree["dw"]), int(tree["dh"])
            stamps = tree.get("frameTimestamps") or [n / float(tree["fps"]) for n in range(max(self._numbers) + 1)]
            times = np.array([stamps[number] for number in self._numbers], dtype=np.float64)
        except DAMAGE as error:
            raise DatasetError(f"cannot understand the metadata of {self.path}: {error!r}") from None
        if np.any(np.diff(times) <= 0):
            raise DatasetError(f"the frame times in the metadata of {self.path} do not increase")
        return color, size, times


def largest_unpacked(packed: bytes) -> int:
    """Upper bound of the bytes to which LZFSE data unpack, from the headers of their blocks alone.

    A command of a block ``bvx2`` writes at most 315 literals and a match of 2359 bytes (reference implementation of
    Apple, lzfse_internal.h, whose decoder does not stop at the size that the block declares); other blocks declare it.

    Raises:
        ValueError: A block is cut off or of another kind.
    """
    total, at = 0, 0
    while packed[at : at + 4] != b"bvx$":
        if (len(packed) < at + 32 and packed[at : at + 4] == b"bvx2") or len(packed) < at + 8:
            raise ValueError("its LZFSE data are cut off")
        kind, size = struct.unpack_from("<4sI", packed, at)
        if kind == b"bvx2":
            first, second, third = struct.unpack_from("<3Q", packed, at + 8)
            literals, commands = first >> 20 & 0xFFFFF, first >> 40 & 0xFFFFF
            total += max(size, commands * LARGEST_COMMAND)
            at += max(third & 0xFFFFFFFF, 32) + literals + (second >> 40 & 0xFFFFF)
        elif kind in (b"bvxn", b"bvx-"):
            total += size
            at += 12 + struct.unpack_from("<I", packed, at + 8)[0] if kind == b"bvxn" else 8 + size
        else:
            raise ValueError(f"its LZFSE data have no block at byte {at}")
    return total


def _lzfse(path: Path) -> Any:  # noqa: ANN401 - an optional package
    with extra("record3d", f"the recording {path}"):
        import lzfse  # pyright: ignore[reportMissingImports]
    return lzfse
