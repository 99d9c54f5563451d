"""Record3D's .r3d archives, written here as the application does."""

import json
import zipfile

import cv2
import numpy as np
import pytest

from dudmap.errors import DatasetError, FrameError, MissingExtraError
from dudmap.io.sequences import open_sequence

COLOR_SIZE, DEPTH_SIZE = (96, 128), (24, 32)
"""Width and height of a portrait recording."""


def depth(index):
    return np.linspace(0.5, 4, 24 * 32, dtype=np.float32).reshape(32, 24) + np.float32(0.1 * index)


def color(index):
    return np.full((128, 96, 3), (200, 10 * index, 30), np.uint8)


def write_r3d(path, frames=12, *, metadata=None, pack=None):
    pack = pack or pytest.importorskip("lzfse").compress
    tree = {
        "w": COLOR_SIZE[0], "h": COLOR_SIZE[1], "dw": DEPTH_SIZE[0], "dh": DEPTH_SIZE[1], "fps": 60,
        "K": [80.0, 0, 0, 0, 81.0, 0, 47.5, 63.5, 1],
        "frameTimestamps": [100 + index / 60 for index in range(frames)],
        "poses": [[0, 0, 0, 1, 0, 0, 0]] * frames,
    }  # fmt: skip
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps(tree | (metadata or {})))
        for index in range(frames):
            values = depth(index)
            values[0, 0] = np.nan
            jpeg = cv2.imencode(".jpg", color(index)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])[1]
            archive.writestr(f"rgbd/{index}.jpg", jpeg.tobytes())
            archive.writestr(f"rgbd/{index}.depth", pack(values.tobytes()))
            confidence = np.repeat([2, 1, 0], [28, 2, 2]).astype(np.uint8)[:, None].repeat(24, axis=1)
            archive.writestr(f"rgbd/{index}.conf", pack(confidence.tobytes()))
    return path


def test_frames_and_both_cameras(tmp_path):
    sequence = open_sequence(write_r3d(tmp_path / "room.r3d"))
    assert (sequence.name, sequence.format, len(sequence)) == ("room", "Record3D .r3d", 12)
    other = sequence.calibration.camera
    assert (other.fx, other.fy, other.cx, other.cy, other.shape) == (80, 81, 47.5, 63.5, (128, 96))
    camera = sequence.camera
    assert (camera.fx, camera.fy, camera.shape) == (20, 20.25, (32, 24))
    assert (camera.cx, camera.cy) == (48 / 4 - 0.5, 64 / 4 - 0.5)  # the same ray, pixel centres at whole numbers
    np.testing.assert_allclose(sequence.timestamps, 100 + np.arange(12) / 60)
    for index in (10, 2):  # in the order of numbers, not of names
        frame = sequence[index]
        assert frame.depth[0, 0] == 0
        np.testing.assert_array_equal(frame.depth[1:30], depth(index)[1:30])
        assert not frame.depth[30:].any(), "confidence 0"
        assert np.abs(frame.color.astype(int) - color(index)).max() <= 3
    assert sequence.ground_truth is None


def test_times_come_from_the_rate_where_none_are_given(tmp_path):
    sequence = open_sequence(write_r3d(tmp_path / "a.r3d", metadata={"frameTimestamps": None}))
    np.testing.assert_allclose(sequence.timestamps, np.arange(12) / 60)


def test_defects_are_one_sentence(tmp_path):
    with pytest.raises(DatasetError, match="cannot understand the metadata"):
        open_sequence(write_r3d(tmp_path / "a.r3d", metadata={"K": [1, 2]}))
    with pytest.raises(DatasetError, match="holds no depth images"):
        open_sequence(write_r3d(tmp_path / "b.r3d", frames=0))
    (tmp_path / "c.r3d").write_bytes(b"no archive")
    with pytest.raises(DatasetError, match=r"not a whole .r3d file"):
        open_sequence(tmp_path / "c.r3d")
    with pytest.raises(
        FrameError, match=r"rgbd/1.depth of .* (cannot be decompressed|has \d+ bytes)|cannot read frame 1 of .* damaged"
    ):
        open_sequence(write_r3d(tmp_path / "d.r3d", pack=lambda data: data[:100]))[1]


def test_lzfse_missing_is_one_sentence(tmp_path, monkeypatch):
    path = write_r3d(tmp_path / "a.r3d", pack=bytes)
    monkeypatch.setitem(__import__("sys").modules, "lzfse", None)
    with pytest.raises(MissingExtraError, match=r'needs the extra record3d .*pip install "\.\[record3d\]"'):
        open_sequence(path)
