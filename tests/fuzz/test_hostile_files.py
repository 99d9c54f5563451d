"""Folders, images and texts that were made to do harm."""

import json
import os
import struct
import zlib

import numpy as np
import pytest
from hostile import refused
from mutations import png

import layouts
from dudmap.errors import DatasetError, FrameError
from dudmap.input_files import parse_json, parse_toml, read_text
from dudmap.io.sequences import images, open_sequence


@pytest.mark.parametrize("what", ["fifo", "/dev/zero", "loop", "folder"])
@pytest.mark.parametrize("name", ["rgb.txt", "depth/100.000000.png", "intrinsics.txt", "groundtruth.txt"])
def test_what_is_no_plain_file(what, name, tmp_path):
    folder, _ = layouts.write(layouts.tum, tmp_path)
    file = folder / name
    file.unlink()
    if what == "fifo":
        os.mkfifo(file)
    elif what == "folder":
        file.mkdir()
    else:
        file.symlink_to(file if what == "loop" else what)

    def read():
        sequence = open_sequence(folder)
        for index in range(len(sequence)):
            sequence[index]
        raise DatasetError("it is read without this file")

    refused(read)


POINTER = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'4d7a' * 16}\nsize 12345\n"


@pytest.mark.parametrize("name", ["depth/*", "rgb/*", "rgb.txt", "intrinsics.txt"])
def test_a_folder_cloned_without_git_lfs(name, tmp_path):
    folder, _ = layouts.write(layouts.tum, tmp_path)
    for file in folder.glob(name):
        file.write_text(POINTER)
    refused(lambda: open_sequence(folder), DatasetError, "is a Git LFS pointer, not the file itself; run git lfs pull")


@pytest.mark.parametrize("suffix", [".bag", ".db3", ".mcap", ".klg", ".sens", ".r3d", ".zip", ".tgz"])
def test_a_recording_cloned_without_git_lfs(suffix, tmp_path):
    (tmp_path / f"a{suffix}").write_text(POINTER)
    for path in (tmp_path / f"a{suffix}", tmp_path):
        refused(lambda path=path: open_sequence(path, "60,60,31.5,23.5"), DatasetError, "is a Git LFS pointer")


@pytest.mark.parametrize("size", [(60000, 60000), (2**31 - 1, 2**31 - 1), (0, 5), (2**27, 1)])
def test_huge_images(size):
    header = struct.pack(">II", *size) + bytes((8, 0, 0, 0, 0))
    data = png([(b"IHDR", header), (b"IDAT", zlib.compress(bytes(2**16))), (b"IEND", b"")])
    refused(lambda: images.decode_color(data, "a.png"), FrameError, "pixels; expected 67 million or less")


def test_a_progressive_image_of_ten_thousand_passes():
    data = layouts.cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8), [layouts.cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1]
    data = data.tobytes()
    start = data.rindex(b"\xff\xda")
    refused(
        lambda: images.decode_color(data[:-2] + data[start:-2] * 10_000 + b"\xff\xd9", "a.jpg"), FrameError, "header"
    )


def test_formats_that_are_not_needed_are_not_decoded():
    for data in (b"#?RADIANCE\n", b"\0\0\0\x0cjP  \r\n\x87\n", b"GIF89a", b"v/1\x01", b"<svg>", b"P7\n"):
        refused(
            lambda data=data: images.decode_color(data + bytes(100), "a"),
            FrameError,
            "not an image that can be decoded",
        )


@pytest.mark.parametrize("extension", ["png", "jpg", "tiff", "bmp", "webp", "pgm", "ppm"])
def test_formats_that_are_needed_are_decoded(extension):
    image = np.arange(20 * 30 * 3, dtype=np.uint8).reshape(20, 30, 3)
    image = image[..., 0].copy() if extension == "pgm" else image
    data = layouts.cv2.imencode(f".{extension}", image)[1].tobytes()
    assert images.decode_color(data, "a").shape == (20, 30, 3)


@pytest.mark.parametrize("depth", [2_000, 200_000])
def test_deep_nesting(depth, tmp_path):
    for text in ("[" * depth, '{"a":' * depth, "[" * depth + "]" * depth):
        with pytest.raises(ValueError, match=r".+"):
            parse_json(text)
    for text in ("a = " + "[" * depth, "a = " + "{a=" * depth, "[a" + ".a" * min(depth, 2000) + "."):
        with pytest.raises(ValueError, match=r".+"):
            parse_toml(text)


def test_names_with_line_breaks(tmp_path):
    folder, _ = layouts.write(layouts.tum, tmp_path / "a\nb\x1b[2J")
    assert len(open_sequence(folder)) == 3
    (folder / "depth.txt").write_text("nonsense")
    refused(lambda: open_sequence(folder), DatasetError, r"a\\nb\\x1b\[2J")


def test_a_list_that_leads_elsewhere_does_not_show_what_is_there(tmp_path):
    folder, _ = layouts.write(layouts.tum, tmp_path / "x")
    (tmp_path / "secret.txt").write_text("a secret")
    (folder / "depth.txt").write_text("".join(f"{100 + 0.1 * k} ../../secret.txt\n" for k in range(3)))
    with pytest.raises(DatasetError) as error:
        open_sequence(folder)
    assert "a secret" not in str(error.value)


def test_a_text_that_is_too_large(tmp_path):
    with (tmp_path / "a.txt").open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(OSError, match="more than 268 MB"):
        read_text(tmp_path / "a.txt")


def test_numbers_beyond_64_bit():
    assert parse_json("[1" + "0" * 400 + "]") == [float("inf")]
    assert parse_json("[12]") == [12]
    assert json.loads("[12]") == [12]


def test_a_matrix_of_another_count_of_numbers(tmp_path):
    folder, _ = layouts.write(layouts.openloris, tmp_path)
    file = folder / "trans_matrix.yaml"
    file.write_text(file.read_text().replace("data: [ ", "data: [ 1, "))
    assert "entry 1 of trans_matrix has no 4x4 matrix" in open_sequence(folder).remarks[0]
    file.write_text("parent_frame: a\n child_frame: b\n matrix: " * 20_000)
    assert "expected YAML of keys" in open_sequence(folder).remarks[0]
