"""Folders of strangers: which images are colour and which depth, by names and content, and how they pair."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from dudmap.app.pipeline.inspection import inspect
from dudmap.errors import DatasetError, FrameError
from dudmap.io.sequences import images, open_sequence
from layout_images import color, exr, millimetres, write_color, write_depth

CAMERA = "60,61,31,23"
NANOSECONDS = ("5000123", "38333456", "71666789")  # without leading zeros, as "%d_%d" writes them


def stamp(k):
    return f"1305031102_{NANOSECONDS[k]}"


LAYOUTS = {
    "one folder, told by suffix": ("{k}.jpg", "{k}.png"),
    "a folder of both, called depth": ("depths_and_images/image_{k}.png", "depths_and_images/depth_{k}.png"),
    "the same, told by suffix": ("depths_and_images/{k}.jpg", "depths_and_images/{k}.png"),
    "a folder of both, called colour": ("rgbd-frames/frame{k:04d}.jpg", "rgbd-frames/depth{k:04d}.png"),
    "a capital and a word that says nothing": ("Frames/{k}.png", "depth/{k}.png"),
    "a letter": ("RGB/{k}.png", "D/{k}.png"),
    "letters in one folder": ("rgb_{k}.png", "d_{k}.png"),
    "nothing but content": ("a/{k}.png", "b/{k}.png"),
    "one below": ("cam0/data/{k}.jpg", "cam1/data/{k}.png"),
    "the word of the other kind": ("rgb/image_{k}.png", "depth/image_{k}.png"),
    "seconds and nanoseconds": ("color_{t}.png", "depth_{t}.png"),
    "a number and other times": ("image/{k:07d}-{u:012d}.jpg", "range/{k:07d}-{v:012d}.png"),
    "a constant last": ("f_{k}_cam1.jpg", "f_{k}_cam1_depth.png"),
    "date and time": ("rgb/2024-01-31-23-59-{s}.jpg", "depth/2024-01-31-23-59-{s}.png"),
    "pictures of the depth beside": ("rgb/{k}.png", "raw/{k}.png", "depth/{k}.png"),
    "a picture beside the folder": ("query/rgb/{k}.jpg", "depth/{k}.png", "query/1.png"),
    "webp": ("color/{k}.webp", "depth/{k}.png"),
    "floats": ("frames/{k}.png", "z/{k}.exr"),
    "files of a Mac": ("RGB/{k}.png", "D/{k}.png", "RGB/._{k}.png"),
}


def write(folder, names):
    for k in range(3):
        values = {"k": k, "t": stamp(k), "u": 33000 * k, "v": 33000 * k + 12000, "s": 10 + k}
        first, second, *others = (folder / name.format(**values) for name in names)
        write_color(first, k)
        second.parent.mkdir(parents=True, exist_ok=True)
        if second.suffix == ".exr":
            second.write_bytes(exr({"Z": (millimetres(k) / 1000).astype(np.float32)}))
        else:
            write_depth(second, k)
        for other in others:
            write_color(other, 2 - k)


@pytest.mark.parametrize("names", LAYOUTS.values(), ids=LAYOUTS)
def test_a_folder_of_a_stranger_is_read_without_an_option(names, tmp_path):
    write(tmp_path / "in", names)
    sequence = open_sequence(tmp_path / "in", CAMERA)
    assert len(sequence) == 3
    for k in range(3):
        np.testing.assert_allclose(sequence[k].depth, millimetres(k) / 1000, atol=1e-4)
        assert np.abs(sequence[k].color[..., 0].astype(int) - color(k)[..., 0]).mean() < 4


def test_seconds_and_nanoseconds_are_times(tmp_path):
    write(tmp_path, LAYOUTS["seconds and nanoseconds"])
    sequence = open_sequence(tmp_path, CAMERA)
    assert sequence.timed
    np.testing.assert_allclose(sequence.timestamps - 1305031102, [0.005000123, 0.038333456, 0.071666789], atol=1e-6)


def test_times_of_both_need_not_be_equal(tmp_path):
    for k in range(3):
        write_color(tmp_path / f"rgb_{1305031102 + k}_{4000000 * (k + 1)}.png", k)
        write_depth(tmp_path / f"d_{1305031102 + k}_{9000000 * (k + 1)}.png", k)
    sequence = open_sequence(tmp_path, CAMERA)
    np.testing.assert_allclose(sequence.timestamps - 1305031102, [0.009, 1.018, 2.027], atol=1e-6)
    np.testing.assert_allclose(sequence.color_timestamps - 1305031102, [0.004, 1.008, 2.012], atol=1e-6)


def test_several_that_may_be_meant_are_named(tmp_path):
    for k in range(3):
        for place in "abcdefg":
            write_color(tmp_path / place / f"{k}.png", k)
        write_depth(tmp_path / "z" / f"{k}.png", k)
    with pytest.raises(
        DatasetError, match=r"holds 7 sets of images that may be the color images: a/N\.png \(3 with 8-"
    ) as found:
        open_sequence(tmp_path, CAMERA)
    assert "e/N.png" in str(found.value)
    assert "f/N.png" not in str(found.value)
    assert "and 2 more; name them with --color PATTERN" in str(found.value)
    assert len(open_sequence(tmp_path, CAMERA, color="c/*.png")) == 3


def test_pictures_of_depth_and_labels_are_no_colour(tmp_path):
    for k in range(3):
        write_depth(tmp_path / "depth" / f"{k}.png", k)
        write_color(tmp_path / "depth_colored" / f"{k}.png", k)
        write_color(tmp_path / "labels" / f"{k}.png", k)
        write_color(tmp_path / "masks" / f"image_{k}.png", k)
    assert not open_sequence(tmp_path, CAMERA).has_color


@pytest.mark.parametrize("name", ["depth/{k}.png", "{k}.png", "seq/range_{t}.png", "a/b/{k}.png"])
def test_depth_without_colour_is_a_recording_of_depth_alone(name, tmp_path):
    for k in range(3):
        write_depth(tmp_path / "in" / name.format(k=k, t=stamp(k)), k)
        write_color(tmp_path / "in" / "masks" / f"{k}.png", k)
    if name.startswith(("seq", "a")):
        for file in (tmp_path / "in" / "masks").iterdir():
            file.unlink()
    sequence = open_sequence(tmp_path / "in", CAMERA)
    assert not sequence.has_color
    assert sequence[1].color is None
    assert sequence.timed == ("{t}" in name)
    np.testing.assert_allclose(sequence[1].depth, millimetres(1) / 1000, atol=1e-4)
    assert sequence.sources["frames"] == "3 depth images without colour"
    (warning,) = inspect(sequence).warnings
    assert warning.startswith("there are no colour images")


def test_depth_beside_images_that_may_be_colour_is_not_alone(tmp_path):
    for k in range(3):
        write_depth(tmp_path / "depth" / f"{k}.png", k)
        write_color(tmp_path / "frames" / f"{k}.png", k)
        gray = cv2.imread(str(tmp_path / f"frames/{k}.png"), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(tmp_path / f"frames/{k}.png"), gray)
    with pytest.raises(DatasetError, match=r"frames/N\.png \(3 with 8-bit intensities\)"):
        open_sequence(tmp_path, CAMERA)
    assert not open_sequence(tmp_path / "depth", CAMERA).has_color  # named as such


def test_a_few_images_that_fit_do_not_stand_for_many_that_do_not(tmp_path):
    for k in range(20):
        write_color(tmp_path / "rgb" / f"{k}.png", k % 3)
        write_color(tmp_path / "depth" / f"{k}.png", k % 3)
    for k in range(3):
        write_depth(tmp_path / "depth_of_others" / f"{k}.png", k)
    with pytest.raises(
        DatasetError, match=r"depth/N\.png \(20 with 8-bit colours\).*expected colour images of 8 bit and"
    ):
        open_sequence(tmp_path, CAMERA)


def test_recordings_below_are_not_mixed(tmp_path):
    for name in ("one", "two"):
        write(tmp_path / name, ("{k}.jpg", "{k}.png"))
    with pytest.raises(DatasetError, match="contains 2 recordings; name one of one, two"):
        open_sequence(tmp_path, CAMERA)
    assert len(open_sequence(tmp_path / "two", CAMERA)) == 3


def test_depth_is_no_colour(tmp_path):
    write_depth(tmp_path / "depth.png", 0)
    with pytest.raises(
        FrameError, match=r"holds one channel of 16 bits or floats, as depth images do.*--color PATTERN"
    ):
        images.read_color(tmp_path / "depth.png")


def turned_jpeg(image, orientation):
    """JPEG whose EXIF segment (EXIF 2.3, 4.5.4) holds an orientation alone."""
    jpeg = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
    tiff = b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    segment = b"Exif\0\0" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", 2 + len(segment)) + segment + jpeg[2:]


def turned_png(image, orientation):
    """PNG whose eXIf chunk (PNG 3, 11.3.4.5) holds an orientation alone."""
    png = cv2.imencode(".png", image)[1].tobytes()
    tiff = b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    chunk = struct.pack(">I", len(tiff)) + b"eXIf" + tiff + struct.pack(">I", zlib.crc32(b"eXIf" + tiff))
    return png[:33] + chunk + png[33:]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_an_orientation_does_not_turn_colour_against_depth(orientation, tmp_path):
    (tmp_path / "color").mkdir()
    for k in range(3):
        (tmp_path / f"color/{k}.jpg").write_bytes(turned_jpeg(color(k), orientation))
        write_depth(tmp_path / f"depth/{k}.png", k)
    sequence = open_sequence(tmp_path, CAMERA)
    assert sequence.calibration is None
    for k in range(3):
        assert np.abs(sequence[k].color.astype(int) - color(k)).max() < 12


def test_an_orientation_does_not_turn_a_mask(tmp_path):
    mask = np.zeros((48, 64), np.uint8)
    mask[:9] = 255
    (tmp_path / "0.png").write_bytes(turned_png(mask, 3))
    np.testing.assert_array_equal(images.read_mask(tmp_path / "0.png"), mask > 127)
