"""Recordings of Azure Kinect, written here as k4arecorder does: RFC 9559, and Microsoft's page on the file format."""

import json
import struct

import cv2
import numpy as np
import pytest

from dudmap.core.geometry import se3
from dudmap.errors import DatasetError, FrameError
from dudmap.io.sequences import open_sequence

pytest.importorskip("av")
FRAMES, WIDTH, HEIGHT = 9, 320, 288
"""The mode NFOV_2X2BINNED of the depth camera; colour has 1280x720 pixels."""


def element(number, *content):
    data = b"".join(
        part if isinstance(part, bytes) else part.encode() if isinstance(part, str) else part.to_bytes(8, "big")
        for part in content
    )
    return number.to_bytes((number.bit_length() + 7) // 8, "big") + (len(data) | 1 << 56).to_bytes(8, "big") + data


def track(number, name, fourcc, width, height, bits):
    header = struct.pack("<IiiHH4sIiiII", 40, width, height, 1, bits, fourcc, width * height * bits // 8, 0, 0, 0, 0)
    return element(
        0xAE, element(0xD7, number), element(0x73C5, number), element(0x83, 1), element(0x536E, name),
        element(0x86, "V_MS/VFW/FOURCC"), element(0x63A2, header),
        element(0xE0, element(0xB0, width), element(0xBA, height)),
    )  # fmt: skip


def block(number, data):
    return element(0xA3, bytes([0x80 | number, 0, 0, 0x80]) + data)


def camera(location, size, parameters, rotation, translation):
    return {
        "Intrinsics": {
            "ModelParameterCount": 14, "ModelParameters": parameters,
            "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
        },
        "Location": f"CALIBRATION_CameraLocation{location}", "Rt": {"Rotation": rotation, "Translation": translation},
        "SensorWidth": size[0], "SensorHeight": size[1],
    }  # fmt: skip


ROTATION = se3.exp_rotation(np.array([0.1, 0, 0]))
LENS = [0.4, -0.2, 0.05, 0.7, -0.15, 0.02]
CALIBRATION = {
    "CalibrationInformation": {
        "Cameras": [
            camera("D0", (1024, 1024), [0.5, 0.51, 0.49, 0.492, *[0] * 10], np.eye(3).ravel().tolist(), [0, 0, 0]),
            camera(
                "PV0", (4096, 3072), [0.51, 0.52, 0.47, 0.63, *LENS, 0, 0, -0.0003, 0.0005],
                ROTATION.ravel().tolist(), [-0.032, -0.002, 0.004],
            ),
        ]
    }
}  # fmt: skip


def color(k):
    y, x = np.mgrid[:720, :1280]
    return np.stack([x / 8, y / 4, np.full_like(x, 20 * k)], axis=-1).astype(np.uint8)


def depth(k):
    return (np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) % 500 + 1000 + 100 * k).astype(np.uint16)


def write_mkv(path, calibration=CALIBRATION, name="DEPTH", mode=(b"MJPG", 24), spoilt=(), frames=FRAMES):
    clusters = []
    for k in range(frames):
        y, cb = np.full((720, 1280), 60 + 20 * k, np.uint8), np.full((360, 1280), 128, np.uint8)
        data = np.concatenate([y, cb]).tobytes()
        if mode[0] == b"MJPG":
            data = cv2.imencode(".jpg", color(k)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
        data = data[:-9] if k in spoilt else data
        both = ((50 + 33_333 * k, block(2, depth(k).astype(">u2").tobytes())), (33_333 * k + 51, block(1, data)))
        clusters += [element(0x1F43B675, element(0xE7, time), content) for time, content in both]
    text = json.dumps(calibration).encode() + b"\0"
    attached = element(
        0x61A7, element(0x466E, "calibration.json"), element(0x4660, "application/octet-stream"), element(0x465C, text),
        element(0x46AE, 7),
    )  # fmt: skip
    path.write_bytes(
        element(0x1A45DFA3, element(0x4282, "matroska"), element(0x4287, 4), element(0x4285, 2))
        + element(
            0x18538067,
            element(0x1549A966, element(0x2AD7B1, 1000), element(0x4D80, "libmatroska"), element(0x5741, "k4arecord")),
            element(
                0x1654AE6B, track(1, "COLOR", mode[0], 1280, 720, mode[1]), track(2, name, b"b16g", WIDTH, HEIGHT, 16)
            ),
            element(0x1941A469, attached) if calibration else b"",
            *clusters,
        )
    )
    return path


def test_frames_and_both_cameras(tmp_path):
    sequence = open_sequence(write_mkv(tmp_path / "walk.mkv"))
    assert (sequence.name, sequence.format, len(sequence)) == ("walk", "Azure Kinect .mkv", FRAMES)
    np.testing.assert_allclose(sequence.timestamps, 50e-6 + 0.033333 * np.arange(FRAMES), atol=1e-9)
    # parts of the 512x512 pixels of which 96, 90 is the first; corners of pixels count, not their centres
    K = [0.49 * 512, 0.492 * 512, 0.5 * 512 - 96 - 0.5, 0.51 * 512 - 90 - 0.5]
    np.testing.assert_allclose([getattr(sequence.camera, key) for key in ("fx", "fy", "cx", "cy")], K)
    other = sequence.calibration.camera
    # parts of 1280x960 pixels of which the first 120 rows are cut off
    K = np.array([[0.47 * 1280, 0, 0.51 * 1280 - 0.5], [0, 0.63 * 960, 0.52 * 960 - 120 - 0.5], [0, 0, 1]])
    np.testing.assert_allclose(other.K, K)
    np.testing.assert_allclose(sequence.calibration.T_color_depth[:3, :3], ROTATION, atol=1e-12)
    np.testing.assert_allclose(sequence.calibration.T_color_depth[:3, 3], [-0.032, -0.002, 0.004])
    for k in (0, 1, 2, 7, 3, 3):  # in order, ahead, back and again
        frame = sequence[k]
        np.testing.assert_array_equal(frame.depth, depth(k).astype(np.float32) / np.float32(1000))
        coefficients = np.array([0.4, -0.2, 0.0005, -0.0003, 0.05, 0.7, -0.15, 0.02])
        assert np.abs(frame.color.astype(int) - cv2.undistort(color(k), K, coefficients)).mean() < 2
        assert frame.timestamp == pytest.approx(sequence.timestamps[k])
        assert frame.color_timestamp == pytest.approx(frame.timestamp + 1e-6)
    assert open_sequence(tmp_path / "walk.mkv", "250,250,160,144").camera.fx == 250


def test_uncompressed_colour(tmp_path):
    frame = open_sequence(write_mkv(tmp_path / "a.mkv", mode=(b"NV12", 12)))[3]
    middle = frame.color[300:400, 600:700].astype(int)
    assert np.abs(middle - round((120 - 16) * 255 / 219)).max() <= 1  # BT.601, limited range


def test_defects_are_one_sentence(tmp_path):
    path = tmp_path / "a.mkv"
    with pytest.raises(DatasetError, match=r"a video with the tracks \['COLOR', 'VIDEO'\]; expected COLOR and DEPTH"):
        open_sequence(write_mkv(path, name="VIDEO"))
    with pytest.raises(DatasetError, match=r"lacks the attachment calibration\.json"):
        open_sequence(write_mkv(path, calibration=None))
    with pytest.raises(DatasetError, match="damaged or not as its format says: it lacks 'CalibrationInformation'"):
        open_sequence(write_mkv(path, calibration={"a": 1}))
    sequence = open_sequence(write_mkv(path, spoilt=(2,)))
    with pytest.raises(FrameError, match=r"frame 2 of .* is cut off"):
        sequence[2]
    assert sequence[3].depth.any()
    path.write_bytes(b"#EXTM3U\nhttp://example.org/a.ts\n")
    with pytest.raises(DatasetError, match="cannot read the recording"):
        open_sequence(path)
