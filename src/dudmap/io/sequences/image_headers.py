"""Headers of image files: format, size, depth or colour."""

import re
import struct
from pathlib import Path

from dudmap.core.geometry.camera import LARGEST_PIXELS
from dudmap.errors import FrameError
from dudmap.input_files import DAMAGE, LARGEST_FILE, open_plain
from dudmap.io.sequences import exr

PNG, JPEG, TIFF = b"\x89PNG\r\n\x1a\n", b"\xff\xd8", (b"II*\0", b"MM\0*")
LARGEST_HEADER = 1 << 16
LARGEST_SCANS = 100
"""Passes of a progressive JPEG file; encoders write up to 10."""
_TIFF_TYPES = {3: "H", 4: "I"}
_JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
_JPEG_ALONE = {0x01, *range(0xD0, 0xD9)}


def check_size(data: bytes, name: str) -> None:
    """Check the format and size of an image;

    Raises:
        FrameError: Unsupported format, too large, or damaged.
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


def _tags(data: bytes) -> dict[int, int]:
    order = "<" if data.startswith(b"II") else ">"
    (at,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, at)
    found = {}
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        tag, kind = struct.unpack_from(order + "HH", data, entry)
        if kind in _TIFF_TYPES:
            found.setdefault(tag, struct.unpack_from(order + _TIFF_TYPES[kind], data, entry + 8)[0])
    return found


def _tiff(data: bytes) -> tuple[int, int]:
    found = _tags(data)
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
    PNG: _png, JPEG: _jpeg, **dict.fromkeys(TIFF, _tiff), b"BM": _bmp, b"RIFF": _webp,
    **{b"P" + digit: _pnm for digit in (b"1", b"2", b"3", b"4", b"5", b"6", b"f", b"F")},
}  # fmt: skip
"""Functions that find the size, by first bytes."""


def kind_of(file: Path) -> str:
    """Kind of an image file, see ``content``; empty if unreadable."""
    try:
        with open_plain(file) as opened:
            data = opened.read(LARGEST_HEADER)
            return content(data + opened.read(LARGEST_FILE) if data.startswith(TIFF) else data)
    except DAMAGE:
        return ""


def content(data: bytes) -> str:
    """Kind of an image by its header.

    Returns:
        ``depth`` (one channel of 16 bits or floats), ``color``, ``gray`` (8 bit), or ``other``; empty for no image.
    """
    try:
        if data.startswith(PNG):
            return {(16, 0): "depth", (8, 2): "color", (8, 6): "color", (8, 0): "gray"}.get(
                (data[24], data[25]), "other"
            )
        if data.startswith((JPEG, b"RIFF", b"P6")):
            return "color"
        if data.startswith((exr.MAGIC, b"Pf")):
            return "depth"
        if data.startswith(b"P5"):
            found = re.match(rb"P5(?:\s+(?:#[^\n]*\n)?(\d+)){3}\s", data)
            return "" if found is None else "depth" if int(found[1]) > 255 else "gray"
        if data.startswith(b"BM"):
            return "color" if struct.unpack_from("<H", data, 28)[0] >= 24 else "other"
        if data.startswith(TIFF):
            tags = _tags(data)
            if tags.get(277, 1) > 1:
                return "color"
            return "depth" if tags.get(258, 1) in (16, 32) else "gray" if tags.get(258, 1) == 8 else "other"
    except (struct.error, LookupError):
        return ""
    return "other" if data.startswith(b"P") else ""
