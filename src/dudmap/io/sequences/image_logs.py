"""Files with one frame after another: ScanNet's ``.sens`` (Dai et al. 2017), ElasticFusion's ``.klg``, Record3D's
``.r3d`` (a ZIP archive of JPEG and LZFSE)."""

import struct
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError, FrameError
from dudmap.extras import extra
from dudmap.input_files import DAMAGE, LARGEST_FILE, RATIO_FREE_BYTES, open_plain, parse_json
from dudmap.io.sequences import Recording, images, intrinsics
from dudmap.io.sequences.phones import record3d_times

SENS_VERSION = 4
SENS_FRAME = struct.Struct("<16f4Q")
"""Pose camera to world by rows, times in microseconds, bytes of the images."""
KLG_FRAME = struct.Struct("<qii")
"""Time in microseconds, bytes of depth and colour."""
PERIOD = 1 / 30
"""Seconds between frames without times: ScanNet's Structure Sensor."""


class FrameEntry(NamedTuple):
    """Offset of a frame, bytes of its images in file order, times in microseconds."""

    offset: int
    sizes: tuple[int, int]
    time: int
    color_time: int = 0


class _FrameLog(Recording):
    """Base of these formats; opening reads only headers."""

    options: tuple[str, ...] = ("depth_unit",)
    _entries: list[FrameEntry]

    def _images(self, index: int) -> tuple[bytes, bytes]:
        entry = self._entries[index]
        with open_plain(self.path) as file:
            file.seek(entry.offset)
            return file.read(entry.sizes[0]), file.read(entry.sizes[1])

    def _depth(self, data: bytes, name: str, *, compressed: bool) -> NDArray[np.float32]:
        height, width = self.camera.shape
        expected = 2 * height * width
        if compressed:
            try:
                data = zlib.decompressobj().decompress(data, expected + 1)
            except zlib.error as error:
                raise FrameError(f"{name}: the depth image is damaged, {error}") from None
        if len(data) != expected:
            raise FrameError(f"{name}: the depth image has {len(data)} bytes; expected {expected} of {width}x{height}")
        values = np.frombuffer(data, "<u2").reshape(height, width).astype(np.uint16, copy=False)
        return images.metres(values, self.camera.depth_scale, name)


class SensRecording(_FrameLog):
    """``.sens`` file. Colour comes from another camera (``calibration``). Useless times become 1/30 s apart."""

    format = "ScanNet .sens"
    suffix = ".sens"

    def __init__(self, path: str | Path, camera: Camera | str | None = None) -> None:
        super().__init__(path)
        with open_plain(self.path) as file:
            try:
                num_frames, end = self._read_header(file, camera), self.path.stat().st_size
                entries = [self._read_entry(file, end) for _ in range(num_frames)]
            except struct.error:
                raise DatasetError(f"{self.path} is cut off: its frames end before the file says") from None
        self._entries = [entry for entry, _ in entries]
        self.timestamps = 1e-6 * np.array([entry.time for entry in self._entries], dtype=np.float64)
        self.timed = not np.any(np.diff(self.timestamps) <= 0)
        if not self.timed:
            self.timestamps = PERIOD * np.arange(num_frames, dtype=np.float64)
            self.sources["times"] = "assumed, 30 frames a second"
        poses = np.array([pose for _, pose in entries], dtype=np.float64).reshape(-1, 4, 4)
        valid = np.isfinite(poses).all(axis=(1, 2))
        truth = Trajectory(self.timestamps[valid], poses[valid] @ self._depth_extrinsic)
        self.ground_truth = truth if valid.any() else None

    def _read_header(self, file: IO[bytes], camera: Camera | str | None) -> int:
        (version,) = _unpack(file, "<I")
        if version != SENS_VERSION:
            raise DatasetError(
                f"{self.path} has version {version} of the .sens format; expected {SENS_VERSION}, which ScanNet uses"
            )
        (length,) = _unpack(file, "<Q")
        file.seek(length, 1)  # name of the sensor
        color_K, color_extrinsic, depth_K, depth_extrinsic = (
            np.array(_unpack(file, "<16f"), dtype=np.float64).reshape(4, 4) for _ in range(4)
        )
        color_codec, depth_codec = _unpack(file, "<2i")
        color_width, color_height, width, height, depth_scale, num_frames = _unpack(file, "<4IfQ")
        if color_codec not in (1, 2) or depth_codec not in (0, 1):
            raise DatasetError(
                f"{self.path} stores colour as number {color_codec} and depth as number {depth_codec}; expected PNG or "
                "JPEG (1, 2) and raw or zlib (0, 1)"
            )
        if num_frames == 0:
            raise DatasetError(f"{self.path} holds no frames")
        self._deflated, self._depth_extrinsic = depth_codec == 1, depth_extrinsic
        own, color = (
            Camera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], *size, depth_scale=depth_scale)
            for K, size in ((depth_K, (width, height)), (color_K, (color_width, color_height)))
        )
        calibration = Calibration(color, se3.inverse(color_extrinsic) @ depth_extrinsic)
        self._set_cameras(own, calibration, "the header of the file", camera)
        return num_frames

    def _read_entry(self, file: IO[bytes], end: int) -> tuple[FrameEntry, list[float]]:
        *pose, color_time, depth_time, color_bytes, depth_bytes = _unpack(file, SENS_FRAME.format)
        entry = FrameEntry(file.tell(), (color_bytes, depth_bytes), depth_time, color_time)
        if sum(entry.sizes) > LARGEST_FILE or file.seek(sum(entry.sizes), 1) > end:
            raise struct.error
        return entry, pose

    def _frame(self, index: int, name: str) -> Frame:
        color_data, depth_data = self._images(index)
        color = images.decode_color(color_data, f"the colour image of {name}")
        expected = self.camera if self.calibration is None else self.calibration.camera
        if color.shape[:2] != expected.shape:
            raise FrameError(f"{name}: the colour image has another size than the file's header says")
        depth = self._depth(depth_data, name, compressed=self._deflated)
        taken = 1e-6 * self._entries[index].color_time if self.timed else None
        return Frame(float(self.timestamps[index]), depth, color, taken)


class KlgRecording(_FrameLog):
    """``.klg`` log of ElasticFusion and Kintinuous (Whelan et al. 2015), with registered images.

    Depth is in millimetres (raw or zlib), colour raw or JPEG; no intrinsics. The image size is
    given, or taken from the first JPEG image, else 640x480.
    """

    format = "ElasticFusion .klg"
    suffix = ".klg"

    def __init__(self, path: str | Path, camera: Camera | str | None = None) -> None:
        super().__init__(path)
        if camera is None:
            raise DatasetError(
                f"{self.path} is a .klg file, which holds no intrinsics; give --camera "
                "fx,fy,cx,cy[,w,h[,depth_scale]], "
                "for the Xtion of ElasticFusion's own recordings --camera 528,528,320,240"
            )
        known = intrinsics.given(camera)
        entries = self._read_index()
        times, order = np.unique(1e-6 * np.array([entry.time for entry in entries], np.float64), return_index=True)
        self.timestamps, self._entries = times, [entries[k] for k in order]
        unit = known.source if "depth_scale" in known.values else "the format"
        self.sources = {"intrinsics": known.source, "depth unit": unit, "times": "the file"}
        self.camera = known.camera(*self._size(known), 1000.0)

    def _frame(self, index: int, name: str) -> Frame:
        depth_data, color_data = self._images(index)
        pixels = self.camera.width * self.camera.height
        depth = self._depth(depth_data, name, compressed=len(depth_data) != 2 * pixels)
        if len(color_data) == 3 * pixels:
            color = np.frombuffer(color_data, np.uint8).reshape(*self.camera.shape, 3).copy()
        else:
            color = images.decode_color(color_data, f"the colour image of {name}")
        if color.shape[:2] != self.camera.shape:
            raise FrameError(f"{name}: the colour image is not {self.camera.width}x{self.camera.height} pixels")
        return Frame(float(self.timestamps[index]), depth, color)

    def _size(self, known: intrinsics.Intrinsics) -> tuple[int, int]:
        if "width" in known.values:
            return int(known.values["width"]), int(known.values["height"])
        _, color = self._images(0)
        if color.startswith(images.JPEG):
            height, width = images.decode_color(color, f"the first colour image of {self.path}").shape[:2]
            return width, height
        return 640, 480

    def _read_index(self) -> list[FrameEntry]:
        entries, end = [], self.path.stat().st_size
        with open_plain(self.path) as file:
            head = file.read(4)
            count = struct.unpack("<i", head)[0] if len(head) == 4 else 0
            if count < 1:
                raise DatasetError(f"{self.path} holds no frames; expected a .klg file, which starts with their number")
            cut_off = f"{self.path} is cut off: it says {count} frames and holds"
            for number in range(count):
                header = file.read(KLG_FRAME.size)
                if len(header) < KLG_FRAME.size:
                    raise DatasetError(f"{cut_off} {number}")
                time, *sizes = KLG_FRAME.unpack(header)
                entries.append(FrameEntry(file.tell(), (sizes[0], sizes[1]), time))
                if max(sizes) > LARGEST_FILE:
                    raise DatasetError(f"{self.path} is damaged: frame {number} says it has {sum(sizes)} bytes")
                if min(sizes) < 0 or file.seek(sum(sizes), 1) > end:
                    raise DatasetError(f"{cut_off} {number}")
        return entries


def _unpack(file: IO[bytes], form: str) -> tuple:
    return struct.unpack(form, file.read(struct.calcsize(form)))


LARGEST_COMMAND = 315 + 2359
"""Bytes that one command of an LZFSE block can write."""


class Record3DRecording(Recording):
    """``.r3d`` file.

    Depth (LiDAR 256x192, front camera 640x480) is smaller than colour and has its view. Depth of confidence 0 is
    omitted; ARKit's poses are no ground truth.
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
        name, width, height = f"{member} of {self.path}", self.camera.width, self.camera.height
        packed = self._member(member)
        if largest_unpacked(packed) > RATIO_FREE_BYTES:
            raise FrameError(f"{name} unpacks to too much; expected {width}x{height} pixels")
        try:
            data = self._lzfse.decompress(packed)
        except (self._lzfse.error, MemoryError) as error:
            # if a block ends too early, the decoder allocates more and more memory
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
        try:
            tree: dict[str, Any] = parse_json(self._member("metadata"))
            fx, _, _, _, fy, _, cx, cy, _ = (float(number) for number in tree["K"])  # column by column
            color = Camera(fx, fy, cx, cy, int(tree["w"]), int(tree["h"]))
            size = int(tree["dw"]), int(tree["dh"])
            return color, size, np.array(record3d_times(tree, self._numbers, self.path))
        except DAMAGE as error:
            raise DatasetError(f"cannot understand the metadata of {self.path}: {error!r}") from None


def largest_unpacked(packed: bytes) -> int:
    """Largest unpacked size of LZFSE data, from block headers.

    A command of a block ``bvx2`` writes at most 315 literals and a match of 2359 bytes (Apple's reference
    implementation, lzfse_internal.h), even beyond the declared size.

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
