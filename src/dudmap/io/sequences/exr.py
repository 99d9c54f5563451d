"""Depth in OpenEXR images (https://openexr.com/en/latest/OpenEXRFileLayout.html): one part, in lines, uncompressed or
zlib, which OpenCV's wheels cannot decode."""

import struct
import zlib
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.camera import LARGEST_PIXELS
from dudmap.errors import FrameError
from dudmap.input_files import damaged

MAGIC = b"v/1\x01"
NOT_ONE_PART_IN_LINES = 0x02 | 0x08 | 0x10
"""Flags of tiles, deep images and several parts."""
LINES = {0: 1, 2: 1, 3: 16}
"""Lines of a block by compression: none, ZIPS and ZIP."""
KINDS = ("<u4", "<f2", "<f4")
DEPTH_CHANNELS = "RYVZ"
"""Last letter of depth channel names, by increasing certainty."""


def decode(data: bytes, name: str) -> NDArray[np.float32]:
    """Values (H, W) of the depth channel, or of the only one; ``name`` is used in messages."""
    with damaged(FrameError, f"the image {name}"):
        fields, at = _header(data)
        left, top, right, bottom = struct.unpack("<4i", fields["dataWindow"])
        width, height, lines = right - left + 1, bottom - top + 1, LINES.get(fields["compression"][0])
        if data[5] & NOT_ONE_PART_IN_LINES or lines is None:
            raise FrameError(f"the image {name} is not an EXR image of one part in lines, uncompressed or ZIP")
        if not 0 < width * height <= LARGEST_PIXELS:
            raise FrameError(f"the image {name} says it has {width}x{height} pixels")
        line = np.dtype([(channel, kind, width) for channel, kind in _channels(fields["channels"])])
        channel = max(line.names or (), key=lambda label: DEPTH_CHANNELS.find(label[-1:]))
        image = np.empty((height, width), np.float32)
        for number in range(-(-height // lines)):
            (place,) = struct.unpack_from("<Q", data, at + 8 * number)
            y, size = struct.unpack_from("<2i", data, place)
            block = _inflated(data[place + 8 : place + 8 + size], line.itemsize * min(lines, bottom - y + 1))
            values = np.frombuffer(block, line)[channel]
            image[y - top : y - top + len(values)] = values
        return image


def _header(data: bytes) -> tuple[dict[str, bytes], int]:
    fields, at = {}, 8
    while data[at]:
        end = data.index(b"\0", at)
        kind = data.index(b"\0", end + 1)
        (size,) = struct.unpack_from("<I", data, kind + 1)
        fields[data[at:end].decode()] = data[kind + 5 : kind + 5 + size]
        at = kind + 5 + size
    return fields, at + 1


def _channels(listed: bytes) -> Iterator[tuple[str, str]]:
    at = 0
    while listed[at]:
        end = listed.index(b"\0", at)
        kind, *sampling = struct.unpack_from("<i4x2i", listed, end + 1)
        if sampling != [1, 1]:
            raise ValueError("a channel has fewer pixels than the image")
        yield listed[at:end].decode(), KINDS[kind]
        at = end + 17


def _inflated(block: bytes, size: int) -> bytes:
    if len(block) == size:
        return block
    packed = np.frombuffer(zlib.decompressobj().decompress(block, size + 1), np.uint8)
    if len(packed) != size:
        raise ValueError(f"a block has {len(packed)} bytes; expected {size}")
    values = np.cumsum(packed, dtype=np.uint8) - (128 * np.arange(size)).astype(np.uint8)
    whole = np.empty(size, np.uint8)
    whole[::2], whole[1::2] = values[: (size + 1) // 2], values[(size + 1) // 2 :]
    return whole.tobytes()
