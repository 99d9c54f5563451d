"""Decoding of colour, depth and mask images; defects raise a ``FrameError``. The size is checked before allocation."""

import struct
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.camera import Camera
from dudmap.errors import DatasetError, FrameError
from dudmap.input_files import damaged, load_array, read_bytes
from dudmap.io.sequences import exr
from dudmap.io.sequences.image_headers import JPEG, PNG, check_size, content

if TYPE_CHECKING:
    from dudmap.core.geometry.calibration import Calibration


def read_color(path: Path) -> NDArray[np.uint8]:
    """Colour image (H, W, 3) in RGB order."""
    return decode_color(_bytes(path), str(path))


def decode_color(data: bytes | NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
    """Colour image (H, W, 3), RGB, from the content of a file; ``name`` is used in messages."""
    import cv2

    image = _decoded(data, name, cv2.IMREAD_COLOR)
    if content(bytes(data)) == "depth":
        raise FrameError(
            f"the colour image {name} holds one channel of 16 bits or floats, as depth images do; expected 8-bit "
            "colour: name the colour images with --color PATTERN"
        )
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)


def read_depth(path: Path, depth_scale: float) -> NDArray[np.float32]:
    """Depth image (H, W) in metres, 0 = missing: 16-bit values over ``depth_scale``, or metres as floats."""
    return decode_depth(_bytes(path), depth_scale, str(path))


def decode_depth(data: bytes | NDArray[np.uint8], depth_scale: float, name: str) -> NDArray[np.float32]:
    """Depth image (H, W) in metres from the content of a file; ``name`` is used in messages."""
    import cv2

    raw = bytes(data)
    image = exr.decode(raw, name) if raw.startswith(exr.MAGIC) else _decoded(data, name, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2:
        raise FrameError(f"the depth image {name} has {image.shape[2]} channels; expected one with 16 bit or float")
    return metres(image, depth_scale, name)


def metres(image: NDArray[Any], depth_scale: float, name: str) -> NDArray[np.float32]:
    """Depth (H, W) in metres of 16-bit values over ``depth_scale``, or float metres; 0 = missing."""
    if image.dtype == np.uint16:
        return image.astype(np.float32) / np.float32(depth_scale)
    if image.dtype.kind == "f":
        depth = image.astype(np.float32)
        depth[~(np.isfinite(depth) & (depth > 0))] = 0
        return depth
    raise FrameError(f"the depth image {name} holds {image.dtype} values; expected 16 bit or float")


def read_depth_array(path: Path) -> NDArray[np.float32]:
    """Depth image (H, W) or (H, W, 1) in metres of a ``.npy`` file."""
    try:
        depth = np.squeeze(load_array(path))
    except (OSError, ValueError, EOFError) as error:
        raise FrameError(f"cannot read the array {path}: {error}") from error
    if depth.ndim != 2 or depth.dtype.kind != "f":
        raise FrameError(f"the array {path} holds {depth.dtype} of shape {depth.shape}; expected floats (H, W)")
    return metres(depth, 1.0, str(path))


def read_mask(path: Path) -> NDArray[np.bool_]:
    """Mask (H, W) of an 8-bit image; above 127 is true."""
    return read_gray(path) > 127


def read_ignored(path: str | Path, camera: Camera, calibration: "Calibration | None" = None) -> NDArray[np.bool_]:
    """Ignored pixels (H, W) of an image, white (above 127).

    Raises:
        DatasetError: There is no such image, or it has neither image's size.
    """
    path = Path(path)
    if not path.is_file():
        raise DatasetError(f"there is no file {path}; expected a mask image, white where pixels never count (--ignore)")
    mask = read_mask(path)
    sizes = dict.fromkeys(c.shape for c in (camera, calibration and calibration.camera) if c is not None)
    if mask.shape not in sizes:
        expected = " or ".join(f"{w}x{h}" for h, w in sizes)
        raise DatasetError(
            f"the mask {path} is {mask.shape[1]}x{mask.shape[0]} pixels; expected {expected}, the size of the depth or "
            "colour image"
        )
    if mask.all():
        raise DatasetError(f"the mask {path} is white everywhere; expected white only where pixels never count")
    return mask


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
    """The stored image; depth lacks EXIF orientation."""
    import cv2

    with damaged(FrameError, name):
        image = cv2.imdecode(_checked(data, name), flags if flags < 0 else flags | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise FrameError(f"{name} is not an image that can be decoded")
    return np.asarray(image)


def _checked(data: bytes | NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
    """Content of a complete file; decoders fill gaps with grey."""
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
    """Check length, type, data and CRC-32 of all chunks (PNG specification, section 5.3)."""
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
