"""Decoding of colour, depth and mask images, with one clear error for every defect of a file; folders of masks.

A file that is missing, cut off, damaged, too large or no such image is a ``FrameError``. The size that a file declares
is read before a decoder takes memory for it.
"""

import re
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.association import LARGEST_GAP, associate
from dudmap.core.geometry.camera import LARGEST_PIXELS, Camera
from dudmap.errors import DatasetError, FrameError
from dudmap.input_files import damaged, load_array, read_bytes
from dudmap.io.sequences import exr

PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"


def read_color(path: Path) -> NDArray[np.uint8]:
    """Colour image (H, W, 3) in RGB order."""
    return decode_color(_bytes(path), str(path))


def decode_color(data: bytes | NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
    """Colour image (H, W, 3) in RGB order from the content of an image file; ``name`` is used in messages."""
    import cv2

    image = _decoded(data, name, cv2.IMREAD_COLOR)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)


def read_depth(path: Path, depth_scale: float) -> NDArray[np.float32]:
    """Depth image (H, W) in metres, 0 = no reading: 16-bit values over ``depth_scale``, or metres as floats."""
    return decode_depth(_bytes(path), depth_scale, str(path))


def decode_depth(data: bytes | NDArray[np.uint8], depth_scale: float, name: str) -> NDArray[np.float32]:
    """Depth image (H, W) in metres from the content of an image file; ``name`` is used in messages."""
    import cv2

    raw = bytes(data)
    image = exr.decode(raw, name) if raw.startswith(exr.MAGIC) else _decoded(data, name, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2:
        raise FrameError(f"the depth image {name} has {image.shape[2]} channels; expected one with 16 bit or float")
    return metres(image, depth_scale, name)


def metres(image: NDArray[Any], depth_scale: float, name: str) -> NDArray[np.float32]:
    """Depth (H, W) in metres of 16-bit values over ``depth_scale``, or of metres as floats; 0 = no reading."""
    if image.dtype == np.uint16:
        return image.astype(np.float32) / np.float32(depth_scale)
    if image.dtype.kind == "f":
        depth = image.astype(np.float32)
        depth[~(np.isfinite(depth) & (depth > 0))] = 0
        return depth
    raise FrameError(f"the depth image {name} holds {image.dtype} values; expected 16 bit or float")


def read_depth_array(path: Path) -> NDArray[np.float32]:
    """Depth image (H, W) in metres of a ``.npy`` file of floats; (H, W, 1) is taken, too."""
    try:
        depth = np.squeeze(load_array(path))
    except (OSError, ValueError, EOFError) as error:
        raise FrameError(f"cannot read the array {path}: {error}") from error
    if depth.ndim != 2 or depth.dtype.kind != "f":
        raise FrameError(f"the array {path} holds {depth.dtype} of shape {depth.shape}; expected floats (H, W)")
    return metres(depth, 1.0, str(path))


def read_mask(path: Path) -> NDArray[np.bool_]:
    """Mask (H, W) of an 8-bit image; values above 127 are true."""
    return read_gray(path) > 127


def read_gray(path: Path) -> NDArray[np.uint8]:
    """8-bit image (H, W) of one channel; colours are converted."""
    import cv2

    return _decoded(_bytes(path), str(path), cv2.IMREAD_GRAYSCALE)


def _bytes(path: Path) -> bytes:
    try:
        return read_bytes(path)
    except FileNotFoundError:
        raise FrameError(f"the listed file {path} does not exist") from None
    except OSError as error:
        raise FrameError(f"cannot read {path}: {error.strerror}") from error


def _decoded(data: bytes | NDArray[np.uint8], name: str, flags: int) -> NDArray[Any]:
    """Image of the content of an image file."""
    import cv2

    with damaged(FrameError, name):
        image = cv2.imdecode(_checked(data, name), flags)
    if image is None:
        raise FrameError(f"{name} is not an image that can be decoded")
    return np.asarray(image)


def _checked(data: bytes | NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
    """Content of a complete image file; decoders would fill the missing part of a truncated one with grey."""
    raw = bytes(data)
    if not raw:
        raise FrameError(f"{name} is an empty file")
    if raw.startswith(PNG):
        _check_png(name, raw)
    elif raw.startswith(JPEG) and b"\xff\xd9" not in raw[-1024:]:
        raise FrameError(f"{name} is cut off: the JPEG end marker is missing")
    check_size(raw, name)
    return np.frombuffer(raw, dtype=np.uint8)


def _check_png(name: str, data: bytes) -> None:
    """Check all chunks: length, type, data, CRC-32 of type and data (PNG specification, section 5.3)."""
    at = len(PNG)
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        end = at + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(data[at + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise FrameError(f"{name} is damaged: a PNG checksum does not match")
        if data[at + 4 : at + 8] == b"IEND":
            return
        at = end + 4
    raise FrameError(f"{name} is cut off: the PNG end is missing")


LARGEST_SCANS = 100
"""Largest number of passes over the image in a progressive JPEG file; encoders write up to 10, and each takes time."""
_TIFF_TYPES = {3: "H", 4: "I"}
_JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
_JPEG_ALONE = {0x01, *range(0xD0, 0xD9)}


def check_size(data: bytes, name: str) -> None:
    """Check that an image is in a format that is read, and has a possible size; ``name`` is used in messages.

    Other formats that the decoder knows are refused: each is code of its own that would read what others wrote.

    Raises:
        FrameError: It is in another format, too large, or its header is damaged.
    """
    read = next((read for magic, read in _FORMATS.items() if data.startswith(magic)), None)
    if read is None:
        raise FrameError(f"{name} is not an image that can be decoded; expected PNG, JPEG, TIFF, BMP, WebP or PNM")
    try:
        width, height = read(data)
    except (struct.error, ValueError, IndexError):
        raise FrameError(f"{name} is damaged: its header gives no image size") from None
    if not 0 < width * height <= LARGEST_PIXELS:
        raise FrameError(
            f"{name} says it has {width}x{height} pixels; expected {LARGEST_PIXELS / 1e6:.0f} million or less"
        )


def _png(data: bytes) -> tuple[int, int]:
    return struct.unpack_from(">II", data, 16)


def _jpeg(data: bytes) -> tuple[int, int]:
    """Size in the frame header; segments before it are skipped by their length (ITU T.81, B.1.1)."""
    if data.count(b"\xff\xda") > LARGEST_SCANS:
        raise ValueError("more scans than an encoder writes")
    at = 2
    while True:
        if data[at] != 0xFF:
            raise ValueError("no marker")
        marker = data[at + 1]
        if marker in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        if marker == 0xFF:
            at += 1
        elif marker in _JPEG_ALONE:
            at += 2
        else:
            at += 2 + max(struct.unpack_from(">H", data, at + 2)[0], 2)


def _tiff(data: bytes) -> tuple[int, int]:
    """Size in the first directory (TIFF 6.0, section 2); tiles may not be larger than that either."""
    order = "<" if data.startswith(b"II") else ">"
    (at,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, at)
    found = {}
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        tag, kind = struct.unpack_from(order + "HH", data, entry)
        if kind in _TIFF_TYPES:
            found.setdefault(tag, struct.unpack_from(order + _TIFF_TYPES[kind], data, entry + 8)[0])
    if found.get(322, 1) * found.get(323, 1) > LARGEST_PIXELS or found.get(277, 1) > 4:
        raise ValueError("tiles or channels beyond all images")
    if 256 not in found or 257 not in found:
        raise ValueError("no size")
    return found[256], found[257]


def _bmp(data: bytes) -> tuple[int, int]:
    (header,) = struct.unpack_from("<I", data, 14)
    width, height = struct.unpack_from("<HH" if header == 12 else "<ii", data, 18)
    return abs(width), abs(height)


def _webp(data: bytes) -> tuple[int, int]:
    """Size in a simple or extended file (RFC 9649, section 2)."""
    kind = data[12:16]
    if kind == b"VP8X":
        return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    if kind == b"VP8L":
        bits = int.from_bytes(data[21:25], "little")
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    width, height = struct.unpack_from("<HH", data, 26)
    return width & 0x3FFF, height & 0x3FFF


def _pnm(data: bytes) -> tuple[int, int]:
    found = re.match(rb"P[1-6fF](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s", data[:4096])
    if found is None:
        raise ValueError("no size")
    return int(found[1]), int(found[2])


_FORMATS = {
    b"\x89PNG\r\n\x1a\n": _png, b"\xff\xd8": _jpeg, b"II*\0": _tiff, b"MM\0*": _tiff, b"BM": _bmp, b"RIFF": _webp,
    **{b"P" + digit: _pnm for digit in (b"1", b"2", b"3", b"4", b"5", b"6", b"f", b"F")},
}  # fmt: skip
"""First bytes of the formats that are read, and what finds their size."""


class MaskFolder:
    """Folder of masks ``<timestamp>.png`` (255 = dynamic), each paired with the nearest frame at most 20 ms away.

    Args:
        path: The folder.
        timestamps: (N,) increasing timestamps of the frames, seconds.
        camera: Camera of the frames; the masks must have its image size.

    Raises:
        DatasetError: The folder does not exist, holds no image named by a timestamp, or no mask is near a frame.
    """

    def __init__(self, path: str | Path, timestamps: NDArray[np.float64], camera: Camera) -> None:
        path = Path(path)
        if not path.is_dir():
            raise DatasetError(f"there is no folder {path}; expected one with masks named <timestamp>.png")
        stamps = dict(stamped_masks(path))
        if not stamps:
            raise DatasetError(
                f"{path} holds no masks; expected images named <timestamp>.png, e.g. 1305031102.175304.png"
            )
        times = np.array(sorted(stamps))
        pairs = associate(times, timestamps)
        if not pairs:
            raise DatasetError(
                f"none of the {len(times)} masks in {path} belongs to a frame: their times run from {times[0]:.6f} to "
                f"{times[-1]:.6f} s, the frames' from {timestamps[0]:.6f} to {timestamps[-1]:.6f} s; expected masks at "
                f"most {1000 * LARGEST_GAP:.0f} ms from a frame"
            )
        self._shape = camera.shape
        self._files = {j: stamps[float(times[i])] for i, j in pairs}

    def __getitem__(self, index: int) -> NDArray[np.bool_] | None:
        """Mask (H, W) of a frame, or None if it has none.

        Raises:
            FrameError: The image cannot be decoded.
            DatasetError: The image does not have the size of the frames.
        """
        file = self._files.get(index)
        if file is None:
            return None
        mask = read_mask(file)
        if mask.shape != self._shape:
            raise DatasetError(
                f"the mask {file} is {mask.shape[1]}x{mask.shape[0]} pixels, but the frames are "
                f"{self._shape[1]}x{self._shape[0]}; masks must have the size of the images"
            )
        return mask


def stamped_masks(folder: Path) -> list[tuple[float, Path]]:
    """Timestamps in seconds and paths of the PNG files of a folder that are named by a timestamp."""
    masks = []
    for path in folder.glob("*.png"):
        try:
            stamp = float(path.stem)
        except ValueError:
            continue
        if np.isfinite(stamp):
            masks.append((stamp, path))
    return masks
