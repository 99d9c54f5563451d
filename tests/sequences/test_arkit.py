"""What recordings of iPhones have beyond the tests of all formats: videos, confidence, two sets of cameras."""

import shutil
import struct

import cv2
import numpy as np
import pytest

from device_layouts import arkit_scenes, polycam, stray_scanner
from dudmap.errors import DatasetError, FrameError
from dudmap.io.sequences import open_sequence
from dudmap.io.sequences.video import Video
from layout_images import color
from layouts import write


def red(frame):
    """Mean difference of the red channel from frame 0; frames in order differ by 10."""
    return np.mean(frame.color[..., 0].astype(float) - color(0, 128, 96)[..., 0])


def test_frames_of_a_video_in_any_order(tmp_path):
    sequence = open_sequence(write(stray_scanner, tmp_path / "a")[0])
    for index in (2, 2, 0, 1, 0, 2):
        assert red(sequence[index]) == pytest.approx(10 * index, abs=4)


def write_video(path, frames, pause):
    """MP4 file; with ``pause`` its 100th frame lasts twice as long, by more entries in its box stts (ISO 14496-12)."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 60, (64, 48))
    for k in range(frames):
        writer.write(np.roll(color(k % 7), 5 * k, axis=1))
    writer.release()
    data = path.read_bytes()
    at = data.index(b"stts") - 4
    count, step = struct.unpack_from(">II", data, at + 16)
    assert (count, data.index(b"moov") > data.index(b"mdat")) == (frames, True), "no offset changes then"
    if pause:
        table = struct.pack(">I4sIIIIIIII", 40, b"stts", 0, 3, 99, step, 1, 2 * step, frames - 100, step)
        new = bytearray(data[:at] + table + data[at + 24 :])
        for box in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):
            place = data.index(box) - 4
            struct.pack_into(">I", new, place, struct.unpack_from(">I", data, place)[0] + 16)
        path.write_bytes(new)
    return Video(path)


@pytest.mark.parametrize("pause", [False, True])
def test_far_frames_of_a_video_are_those_of_decoding_all(tmp_path, pause):
    everything = write_video(tmp_path / "a.mp4", 200, pause)
    frames = [everything[k] for k in range(200)]
    video = Video(tmp_path / "a.mp4")
    for k in (150, 20, 199, 0, 100, 101, 99):
        np.testing.assert_array_equal(video[k], frames[k])
    assert video._constant is not pause
    with pytest.raises(FrameError, match="has no frame 200"):
        video[200]


def test_a_video_that_ends_too_early_costs_only_the_frames_it_lacks(tmp_path):
    folder, _ = write(stray_scanner, tmp_path / "a")
    shutil.copy(folder / "depth/000002.png", folder / "depth/000003.png")
    with (folder / "odometry.csv").open("a") as file:
        file.write("9052.3, 000003, 0, 0, 0, 0, 0, 0, 1\n")
    sequence = open_sequence(folder)
    assert len(sequence) == 4
    with pytest.raises(FrameError, match=r"rgb\.mp4 has no frame 3; it ends after 3 frames"):
        sequence[3]
    assert red(sequence[1]) == pytest.approx(10, abs=4)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"#EXTM3U\n#EXTINF:1,\nhttp://example.org/a.ts\n", "is not an MP4 video"),
        (b"\0\0\0\x18ftypmp42", "cannot be decoded"),
    ],
)
def test_a_file_that_is_no_video(tmp_path, content, sentence):
    """A playlist would make the decoder open what it names."""
    folder, _ = write(stray_scanner, tmp_path / "a")
    (folder / "rgb.mp4").write_bytes(content)
    with pytest.raises(DatasetError, match=sentence):
        open_sequence(folder)


def test_an_odometry_file_of_something_else(tmp_path):
    folder, _ = write(stray_scanner, tmp_path / "a")
    (folder / "odometry.csv").write_text("x, y, z, qx, qy, qz, qw\n0, 0, 0, 0, 0, 0, 1\n")
    with pytest.raises(DatasetError, match=r"does not start with the header 'timestamp, frame, x, \.\.\.'"):
        open_sequence(folder)


def test_all_readings_are_kept_where_no_confidence_is_given(tmp_path):
    """The 3dod part of ARKitScenes comes without it."""
    folder, _ = write(arkit_scenes, tmp_path / "a")
    shutil.rmtree(folder / "confidence")
    assert open_sequence(folder)[0].depth[0, 0] == pytest.approx(0.9)


def test_a_confidence_of_another_size_is_an_error_of_its_frame(tmp_path):
    folder, _ = write(arkit_scenes, tmp_path / "a")
    cv2.imwrite(str(sorted(folder.glob("confidence/*"))[1]), np.ones((24, 32), np.uint8))
    sequence = open_sequence(folder)
    with pytest.raises(FrameError, match=r"is 32x24 pixels, but the depth image .* is 64x48"):
        sequence[1]
    assert sequence[0].depth.any()


def test_polycam_without_corrected_cameras_has_no_truth(tmp_path):
    folder, _ = write(polycam, tmp_path / "a")
    for kind in ("images", "cameras"):
        shutil.rmtree(folder / f"keyframes/corrected_{kind}")
    sequence = open_sequence(folder)
    assert sequence.calibration.camera.fx == 129
    assert sequence.ground_truth is None
    assert len(open_sequence(folder / "keyframes")) == 3
