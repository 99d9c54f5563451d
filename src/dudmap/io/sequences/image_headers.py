"""Size that an image file declares, read before a decoder takes memory for it."""

import re
import struct

from dudmap.core.geometry.camera import LARGEST_PIXELS
from dudmap.errors import FrameError

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
