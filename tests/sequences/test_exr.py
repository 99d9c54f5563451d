"""Depth in OpenEXR images, written here after the description of the format."""

import numpy as np
import pytest

from dudmap.errors import FrameError
from dudmap.io.sequences import images
from layout_images import exr

DEPTH = np.linspace(0.5, 4, 37 * 23, dtype=np.float32).reshape(37, 23)


def read(path, data):
    path.write_bytes(data)
    return images.read_depth(path, 1000.0)


@pytest.mark.parametrize("compression", [0, 2, 3])
@pytest.mark.parametrize("kind", [np.float16, np.float32])
def test_depth_of_every_compression_that_is_read(tmp_path, compression, kind):
    depth = read(tmp_path / "0.exr", exr({"R": DEPTH.astype(kind)}, compression, window=(3, -2)))
    np.testing.assert_array_equal(depth, DEPTH.astype(kind).astype(np.float32))


def test_noise_that_is_stored_as_it_is(tmp_path):
    noise = np.random.default_rng(1).integers(0, 2**31, DEPTH.shape, dtype=np.uint32)
    depth = read(tmp_path / "0.exr", exr({"A": noise, "Z": DEPTH}))
    np.testing.assert_array_equal(depth, DEPTH)


def test_depth_is_the_channel_of_that_name(tmp_path):
    channels = {"A": DEPTH + 1, "Depth.Z": DEPTH, "Image.R": DEPTH.astype(np.float16), "X": (2 * DEPTH)}
    np.testing.assert_array_equal(read(tmp_path / "0.exr", exr(channels)), DEPTH)


def test_pixels_without_a_reading(tmp_path):
    depth = DEPTH.copy()
    depth[0, :3] = np.nan, np.inf, -1
    assert not read(tmp_path / "0.exr", exr({"Z": depth}))[0, :3].any()


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (exr({"Z": DEPTH}, 4), r"is not an EXR image of one part in lines, uncompressed or ZIP"),
        (exr({"Z": DEPTH})[:-40], r"0\.exr, it is damaged"),
        (exr({"Z": DEPTH})[:60], r"0\.exr, it is damaged"),
        (exr({"Z": DEPTH}).replace(b"dataWindow", b"DATAwindow"), r"0\.exr, it is damaged"),
    ],
    ids=["PIZ", "cut off", "no channels", "no size"],
)
def test_files_that_are_not_read(tmp_path, data, sentence):
    with pytest.raises(FrameError, match=sentence):
        read(tmp_path / "0.exr", data)


def test_colour_is_not_read_from_them(tmp_path):
    (tmp_path / "0.exr").write_bytes(exr({"R": DEPTH, "G": DEPTH, "B": DEPTH}))
    with pytest.raises(FrameError, match=r"not an image that can be decoded"):
        images.read_color(tmp_path / "0.exr")
