"""ElasticFusion's .klg logs, written here field by field as its logger does."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from dudmap.core.geometry.camera import Camera
from dudmap.errors import DatasetError, FrameError
from dudmap.io.sequences import open_sequence
from recordings import HEIGHT, WIDTH, color_image, cut, depth_image

NUMBERS = f"60,60,31.5,23.5,{WIDTH},{HEIGHT}"


def write_klg(path, frames=4, *, compressed=True, count=None):
    with path.open("wb") as file:
        file.write(struct.pack("<i", frames if count is None else count))
        for index in range(frames):
            depth, color = depth_image(index).tobytes(), color_image(index).tobytes()
            if compressed:
                depth = zlib.compress(depth)
                jpeg = cv2.imencode(".jpg", color_image(index)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])[1]
                color = jpeg.tobytes()
            file.write(struct.pack("<qii", 33_333 * index, len(depth), len(color)) + depth + color)
    return path


@pytest.mark.parametrize("compressed", [True, False])
def test_frames(tmp_path, compressed):
    sequence = open_sequence(write_klg(tmp_path / "lab.klg", compressed=compressed), NUMBERS)
    assert (sequence.name, sequence.format, len(sequence)) == ("lab", "ElasticFusion .klg", 4)
    assert sequence.camera.shape == (HEIGHT, WIDTH)
    assert sequence.calibration is None
    for index in (3, 0, 1):
        frame = sequence[index]
        np.testing.assert_array_equal(frame.depth, depth_image(index).astype(np.float32) / np.float32(1000))
        assert np.abs(frame.color.astype(int) - color_image(index)).max() <= (20 if compressed else 0)
        assert frame.timestamp == pytest.approx(0.033333 * index)


def test_the_size_of_jpeg_images_is_found(tmp_path):
    sequence = open_sequence(write_klg(tmp_path / "lab.klg"), "60,60,31.5,23.5")
    assert sequence.camera.shape == (HEIGHT, WIDTH)
    camera = Camera(60, 60, 31.5, 23.5, WIDTH, HEIGHT, depth_scale=2000)
    assert open_sequence(tmp_path / "lab.klg", camera)[0].depth.max() == depth_image(0).max() / 2000


def test_intrinsics_are_asked_for(tmp_path):
    with pytest.raises(DatasetError, match=r"holds no intrinsics; give --camera .*528,528,320,240"):
        open_sequence(write_klg(tmp_path / "lab.klg"))


def test_defects_are_one_sentence(tmp_path):
    with pytest.raises(DatasetError, match=r"is cut off: it says 4 frames and holds [123]"):
        open_sequence(cut(write_klg(tmp_path / "a.klg")), NUMBERS)
    with pytest.raises(DatasetError, match="is cut off: it says 9 frames and holds 4"):
        open_sequence(write_klg(tmp_path / "b.klg", count=9), NUMBERS)
    with pytest.raises(DatasetError, match="holds no frames"):
        open_sequence(write_klg(tmp_path / "c.klg", frames=0), NUMBERS)
    with pytest.raises(FrameError, match="expected 2048 of 32x32"):
        open_sequence(write_klg(tmp_path / "d.klg"), "60,60,31.5,23.5,32,32")[0]
