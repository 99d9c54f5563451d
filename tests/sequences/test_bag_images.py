"""Encodings of sensor_msgs images, against the conversions written out in NumPy or OpenCV's encoders."""

import struct
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from bags import millimetres
from dudmap.core.backends.cpu import rvl
from dudmap.errors import FrameError
from dudmap.io.sequences.bag_messages import color_of, depth_of
from recordings import HEIGHT, WIDTH, color_image


def message(pixels, encoding, *, big=False, padding=0):
    rows = np.ascontiguousarray(pixels).reshape(HEIGHT, -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=9)
    return SimpleNamespace(
        height=HEIGHT, width=WIDTH, encoding=encoding, is_bigendian=big, step=rows.shape[1], data=rows.reshape(-1)
    )


def compressed(data, form):
    return SimpleNamespace(format=form, data=np.frombuffer(data, np.uint8))


IMAGE = color_image(5)
ALPHA = np.full((HEIGHT, WIDTH, 1), 200, np.uint8)


@pytest.mark.parametrize("padding", [0, 7])
@pytest.mark.parametrize(
    ("pixels", "encoding"),
    [
        (IMAGE, "rgb8"),
        (IMAGE[..., ::-1], "bgr8"),
        (IMAGE[..., ::-1], "8UC3"),
        (np.concatenate([IMAGE, ALPHA], 2), "rgba8"),
        (np.concatenate([IMAGE[..., ::-1], ALPHA], 2), "bgra8"),
    ],
)
def test_color_encodings(pixels, encoding, padding):
    np.testing.assert_array_equal(color_of(message(pixels, encoding, padding=padding), "it"), IMAGE)


def test_grey_is_spread_over_three_channels():
    grey = IMAGE[..., 0]
    np.testing.assert_array_equal(color_of(message(grey, "mono8"), "it"), np.stack([grey] * 3, 2))


def test_a_bayer_mosaic_keeps_the_primary_colours():
    mosaic = np.zeros((HEIGHT, WIDTH), np.uint8)
    mosaic[::2, ::2] = 200  # red pixels of RGGB
    inner = color_of(message(mosaic, "bayer_rggb8"), "it")[4:-4, 4:-4]
    assert inner[..., 0].min() == 200
    assert inner[..., 1:].max() == 0


@pytest.mark.parametrize("encoding", ["yuv422", "yuv422_yuy2"])
def test_yuv_of_a_uniform_colour(encoding):
    """Y 120, U 90, V 200: R = Y + 1.402 (V - 128) and so on (BT.601, with the studio swing that cameras use)."""
    y, u, v = 120, 90, 200
    quad = [u, y, v, y] if encoding == "yuv422" else [y, u, y, v]
    pixels = np.tile(np.array(quad, np.uint8), (HEIGHT, WIDTH // 2)).reshape(HEIGHT, WIDTH, 2)
    c, d, e = 1.164 * (y - 16), u - 128, v - 128
    expected = [c + 1.596 * e, c - 0.391 * d - 0.813 * e, c + 2.018 * d]
    np.testing.assert_allclose(color_of(message(pixels, encoding), "it")[3, 3], expected, atol=1.5)


def test_compressed_color():
    png = cv2.imencode(".png", IMAGE[..., ::-1])[1].tobytes()
    np.testing.assert_array_equal(color_of(compressed(png, "rgb8; png compressed bgr8"), "it"), IMAGE)
    jpeg = cv2.imencode(".jpg", IMAGE[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
    assert np.abs(color_of(compressed(jpeg, "jpeg"), "it").astype(int) - IMAGE).mean() < 3


@pytest.mark.parametrize(("encoding", "big"), [("16UC1", False), ("16UC1", True), ("mono16", False)])
def test_millimetres(encoding, big):
    values = millimetres(3).astype(">u2" if big else "<u2")
    expected = millimetres(3).astype(np.float32) / np.float32(1000)
    np.testing.assert_array_equal(depth_of(message(values, encoding, big=big), 1000, "it"), expected)


def test_metres_without_readings():
    values = millimetres(0).astype("<f4") / np.float32(1000)
    values[0, :3] = np.nan, np.inf, -1
    depth = depth_of(message(values, "32FC1"), 1000, "it")
    assert not depth[0, :3].any()
    np.testing.assert_array_equal(depth[1:], values[1:])
    assert depth.dtype == np.float32


def test_compressed_depth_with_and_without_header():
    png = cv2.imencode(".png", millimetres(1))[1].tobytes()
    expected = millimetres(1).astype(np.float32) / np.float32(1000)
    with_header = compressed(struct.pack("<iff", 0, 0, 0) + png, "16UC1; compressedDepth")
    np.testing.assert_array_equal(depth_of(with_header, 1000, "it"), expected)
    np.testing.assert_array_equal(depth_of(compressed(png, "16UC1; png compressed "), 1000, "it"), expected)


def test_depth_compressed_by_run_lengths():
    """Columns, rows and RVL after the header, as compressed_depth_image_transport writes it."""
    data = struct.pack("<iff", 1, 0, 0) + rvl.compressed(millimetres(1))
    expected = millimetres(1).astype(np.float32) / np.float32(1000)
    np.testing.assert_array_equal(depth_of(compressed(data, "16UC1; compressedDepth rvl"), 1000, "it"), expected)


def test_compressed_float_depth_is_quantised_inverse_depth():
    """As compressed_depth_image_transport writes it: q = a / z + b, with b = 1 - a / z_max and 0 for no reading."""
    z_max, quantisation = 10.0, 100.0
    a = quantisation * (quantisation + 1)
    b = 1 - a / z_max
    depth = np.linspace(0.5, 6, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
    q = np.round(a / depth + b).astype(np.uint16)
    q[0, 0] = 0
    for form, body in (("png", cv2.imencode(".png", q)[1].tobytes()), ("rvl", rvl.compressed(q))):
        data = struct.pack("<iff", 0, a, b) + body
        found = depth_of(compressed(data, f"32FC1; compressedDepth {form}"), 1000, "it")
        assert found[0, 0] == 0
        np.testing.assert_allclose(found[1:], depth[1:], atol=0.5 * 36 / a * 1.1)  # half a step of q at 6 m


@pytest.mark.parametrize(
    ("bad", "sentence"),
    [
        (lambda: depth_of(message(IMAGE, "rgb8"), 1000, "it"), "it is encoded as rgb8; expected one of 16UC1"),
        (lambda: color_of(message(millimetres(0), "16UC1"), "it"), "it is encoded as 16UC1; expected one of"),
        (lambda: depth_of(compressed(b"x" * 40, "16UC1; compressedDepth rvl"), 1000, "it"), "no complete RVL image"),
        (
            lambda: depth_of(compressed(b"x" * 40, "16UC1; zstd"), 1000, "it"),
            "compressed as .*zstd.*expected PNG or RVL",
        ),
    ],
)
def test_what_cannot_be_decoded_is_named(bad, sentence):
    with pytest.raises(FrameError, match=sentence):
        bad()


def test_too_few_bytes_are_an_error():
    short = message(IMAGE, "rgb8")
    short.data = short.data[:-1]
    with pytest.raises(FrameError, match="has 9215 bytes in rows of 192; expected 48 rows of 192"):
        color_of(short, "it")
