"""ScanNet's .sens files, written here field by field as its C++ header SensorData describes them."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from dudmap.errors import DatasetError, FrameError
from dudmap.io.sequences import open_sequence
from recordings import HEIGHT, WIDTH, cut, depth_image

COLOR_SIZE = (80, 60)


def matrix(fx, fy, cx, cy):
    K = np.eye(4)
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = fx, fy, cx, cy
    return K


def color(index):
    image = np.zeros((COLOR_SIZE[1], COLOR_SIZE[0], 3), np.uint8)
    image[..., 0], image[..., 1] = 200, 10 * index
    return image


def pose(index):
    T = np.eye(4)
    T[0, 3] = 0.1 * index
    return T


def write_sens(path, frames=4, *, version=4, depth_codec=1, times=True, T_depth=None):
    """Colour as PNG (code 1), depth deflated (1) or raw (0), poses of which the second is lost."""
    T_depth = np.eye(4) if T_depth is None else T_depth
    name = b"StructureSensor"
    with path.open("wb") as file:
        file.write(struct.pack("<IQ", version, len(name)) + name)
        for M in (matrix(70, 71, 39.5, 29.5), np.eye(4), matrix(60, 61, 31.5, 23.5), T_depth):
            file.write(struct.pack("<16f", *M.reshape(-1)))
        file.write(struct.pack("<2i", 1, depth_codec))
        file.write(struct.pack("<4I", *COLOR_SIZE, WIDTH, HEIGHT))
        file.write(struct.pack("<fQ", 5000.0, frames))
        for index in range(frames):
            png = cv2.imencode(".png", color(index)[..., ::-1])[1].tobytes()
            depth = depth_image(index).tobytes()
            depth = zlib.compress(depth) if depth_codec == 1 else depth
            T = np.full((4, 4), -np.inf) if index == 1 else pose(index)
            file.write(struct.pack("<16f", *T.reshape(-1)))
            stamps = (1_000_000 * index + 2000, 1_000_000 * index) if times else (0, 0)
            file.write(struct.pack("<4Q", *stamps, len(png), len(depth)) + png + depth)
        file.write(struct.pack("<Q", 0))  # number of IMU frames
    return path


@pytest.mark.parametrize("depth_codec", [0, 1])
def test_frames_cameras_and_poses(tmp_path, depth_codec):
    sequence = open_sequence(write_sens(tmp_path / "scene0000_00.sens", depth_codec=depth_codec))
    assert (sequence.name, sequence.format, len(sequence)) == ("scene0000_00", "ScanNet .sens", 4)
    camera, other = sequence.camera, sequence.calibration.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.shape) == (60, 61, 31.5, 23.5, (HEIGHT, WIDTH))
    assert (other.fx, other.fy, other.cx, other.cy, other.shape) == (70, 71, 39.5, 29.5, COLOR_SIZE[::-1])
    np.testing.assert_array_equal(sequence.calibration.T_color_depth, np.eye(4))
    for index in (2, 0, 3):
        frame = sequence[index]
        np.testing.assert_array_equal(frame.depth, depth_image(index).astype(np.float32) / np.float32(5000))
        np.testing.assert_array_equal(frame.color, color(index))
        assert frame.timestamp == index
        assert frame.color_timestamp == pytest.approx(index + 0.002)
    np.testing.assert_array_equal(sequence.ground_truth.timestamps, [0, 2, 3])  # the lost pose is left out
    np.testing.assert_allclose(sequence.ground_truth.Ts_world_camera[:, 0, 3], [0, 0.2, 0.3], atol=1e-6)


def test_place_of_the_depth_camera(tmp_path):
    T = np.eye(4)
    T[0, 3] = 0.02
    sequence = open_sequence(write_sens(tmp_path / "a.sens", T_depth=T))
    np.testing.assert_allclose(sequence.calibration.T_color_depth, T, atol=1e-7)
    np.testing.assert_allclose(sequence.ground_truth.Ts_world_camera[2, 0, 3], 0.32, atol=1e-6)


def test_frames_without_times_are_a_thirtieth_of_a_second_apart(tmp_path):
    sequence = open_sequence(write_sens(tmp_path / "a.sens", times=False))
    np.testing.assert_allclose(sequence.timestamps, np.arange(4) / 30)
    assert sequence[2].color_timestamp is None


def test_given_intrinsics_replace_those_of_depth(tmp_path):
    sequence = open_sequence(write_sens(tmp_path / "a.sens"), "55,55,30,20")
    assert (sequence.camera.fx, sequence.camera.depth_scale, sequence.calibration.camera.fx) == (55, 5000, 70)


def test_defects_are_one_sentence(tmp_path):
    with pytest.raises(DatasetError, match=r"version 3 of the .sens format; expected 4"):
        open_sequence(write_sens(tmp_path / "a.sens", version=3))
    with pytest.raises(DatasetError, match="holds no frames"):
        open_sequence(write_sens(tmp_path / "b.sens", frames=0))
    with pytest.raises(DatasetError, match="stores colour as number 1 and depth as number 2"):
        open_sequence(write_sens(tmp_path / "c.sens", depth_codec=2))
    with pytest.raises(DatasetError, match="is cut off"):
        open_sequence(cut(write_sens(tmp_path / "d.sens")))


def test_one_damaged_depth_image_is_an_error_of_its_frame(tmp_path):
    path = write_sens(tmp_path / "a.sens", depth_codec=1)
    data = bytearray(path.read_bytes())
    last = zlib.compress(depth_image(3).tobytes())
    at = data.rindex(last)
    data[at : at + 4] = b"\0\0\0\0"
    path.write_bytes(data)
    sequence = open_sequence(path)
    assert sequence[2].depth.any()
    with pytest.raises(FrameError, match=r"frame 3 of .*: the depth image is damaged"):
        sequence[3]
