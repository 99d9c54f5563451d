"""Images of ROS messages: sensor_msgs/Image and CompressedImage.

An encoding that is not known, and data that are damaged or too short, are a ``FrameError``.
"""

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import FrameError
from dudmap.io.sequences import images

COLOR_ENCODINGS = {
    "rgb8": (3, ""), "8UC3": (3, "COLOR_BGR2RGB"), "bgr8": (3, "COLOR_BGR2RGB"), "rgba8": (4, "COLOR_RGBA2RGB"),
    "bgra8": (4, "COLOR_BGRA2RGB"), "8UC4": (4, "COLOR_BGRA2RGB"), "mono8": (1, "COLOR_GRAY2RGB"),
    "8UC1": (1, "COLOR_GRAY2RGB"), "yuv422": (2, "COLOR_YUV2RGB_UYVY"), "uyvy": (2, "COLOR_YUV2RGB_UYVY"),
    "yuv422_yuy2": (2, "COLOR_YUV2RGB_YUY2"), "yuyv": (2, "COLOR_YUV2RGB_YUY2"),
    "bayer_rggb8": (1, "COLOR_BayerRGGB2RGB"), "bayer_bggr8": (1, "COLOR_BayerBGGR2RGB"),
    "bayer_gbrg8": (1, "COLOR_BayerGBRG2RGB"), "bayer_grbg8": (1, "COLOR_BayerGRBG2RGB"),
}  # fmt: skip
"""Encoding (sensor_msgs/image_encodings) to the number of channels and the conversion to RGB of OpenCV."""
DEPTH_ENCODINGS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
"""Encoding to type: 16-bit values in millimetres, or metres as floats (ROS REP 118)."""
COMPRESSED_DEPTH_HEADER = struct.Struct("<i2f")
"""Number of the format and the two parameters of the quantisation, before the PNG (ROS package
compressed_depth_image_transport)."""


def color_of(message: Any, name: str) -> NDArray[np.uint8]:  # noqa: ANN401 - the type is made from the bag
    """Colour image (H, W, 3), RGB, of an Image or CompressedImage; ``name`` is used in messages."""
    import cv2

    if hasattr(message, "format"):
        return images.decode_color(message.data, name)
    if message.encoding not in COLOR_ENCODINGS:
        raise FrameError(
            f"{name} is encoded as {message.encoding}; expected one of {', '.join(sorted(COLOR_ENCODINGS))}"
        )
    channels, conversion = COLOR_ENCODINGS[message.encoding]
    pixels = _pixels(message, np.dtype("u1"), channels, name)
    if not conversion:
        return pixels.copy()
    return np.asarray(cv2.cvtColor(pixels, getattr(cv2, conversion)), np.uint8)


def depth_of(message: Any, depth_scale: float, name: str) -> NDArray[np.float32]:  # noqa: ANN401
    """Depth image (H, W), metres, 0 = no reading, of an Image or CompressedImage; ``name`` is used in messages."""
    if hasattr(message, "format"):
        return _compressed_depth(message, depth_scale, name)
    if message.encoding not in DEPTH_ENCODINGS:
        raise FrameError(
            f"{name} is encoded as {message.encoding}; expected one of {', '.join(sorted(DEPTH_ENCODINGS))}"
        )
    order = ">" if message.is_bigendian else "<"
    pixels = _pixels(message, np.dtype(order + DEPTH_ENCODINGS[message.encoding]), 1, name)
    return images.metres(pixels.astype(pixels.dtype.newbyteorder("=")), depth_scale, name)


def _pixels(message: Any, kind: np.dtype, channels: int, name: str) -> NDArray[Any]:  # noqa: ANN401
    """Pixels (H, W[, C]) of an Image whose rows may be padded to ``step`` bytes."""
    used = message.width * channels * kind.itemsize
    data = np.asarray(message.data, dtype=np.uint8)
    if message.step < used or len(data) < message.step * message.height:
        raise FrameError(
            f"{name} has {len(data)} bytes in rows of {message.step}; expected {message.height} rows of {used}"
        )
    rows = data[: message.step * message.height].reshape(message.height, message.step)[:, :used]
    shape = (message.height, message.width) if channels == 1 else (message.height, message.width, channels)
    return np.ascontiguousarray(rows).view(kind).reshape(shape)


def _compressed_depth(message: Any, depth_scale: float, name: str) -> NDArray[np.float32]:  # noqa: ANN401
    """Depth of a PNG with or without the header of compressed_depth_image_transport.

    Floats are stored as 16-bit values q of inverse depth, z = a / (q - b), with the parameters a and b in the header.
    """
    data = bytes(message.data)
    if data.startswith(images.PNG):
        return images.decode_depth(data, depth_scale, name)
    if not data.startswith(images.PNG, COMPRESSED_DEPTH_HEADER.size):
        raise FrameError(f"{name} is compressed as {message.format!r}; expected PNG, so republish it as raw images")
    _, a, b = COMPRESSED_DEPTH_HEADER.unpack_from(data)
    png = data[COMPRESSED_DEPTH_HEADER.size :]
    if not message.format.startswith("32FC1"):
        return images.decode_depth(png, depth_scale, name)
    quantised = images.decode_depth(png, 1.0, name)
    with np.errstate(divide="ignore"):
        depth = np.float32(a) / (quantised - np.float32(b))
    return images.metres(np.where(quantised > 0, depth, np.float32(0)), 1.0, name)
