"""A recording as a live camera."""

import threading
import time

import numpy as np

from dudmap.errors import FrameError
from dudmap.io.cameras import open_camera
from dudmap.io.cameras.replay import ReplayCamera
from dudmap.io.sequences import open_sequence
from recordings import cut, depth_image, write_recording


def test_frames_arrive_at_the_rate_of_the_sensor(tmp_path):
    camera = open_camera(f"replay:{write_recording(tmp_path / 'desk', 5)}")
    assert (camera.name, camera.length, camera.calibration, camera.ground_truth) == ("desk", 5, None, None)
    assert camera.camera.fx == 60
    assert len(camera.preview(3)) == 3
    time.sleep(0.15)  # the preview does not start the clock
    start = time.perf_counter()
    frames = list(iter(camera.read, None))
    assert time.perf_counter() - start >= 0.4
    assert [frame.number for frame in frames] == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(np.diff([frame.time for frame in frames]), 0.1, atol=1e-6)
    np.testing.assert_array_equal(frames[3].frame.depth, depth_image(3).astype(np.float32) / np.float32(5000))


def test_a_slow_disk_loses_the_frames_between(tmp_path):
    sequence = open_sequence(write_recording(tmp_path / "desk", 8))
    read = sequence.__class__.__getitem__

    class Slow(type(sequence)):
        def __getitem__(self, index):
            time.sleep(0.25)
            return read(self, index)

    sequence.__class__ = Slow
    numbers = [frame.number for frame in iter(ReplayCamera(sequence).read, None)]
    assert numbers[0] == 0
    assert numbers[-1] == 7
    assert len(numbers) < 6


def test_a_frame_that_cannot_be_read_is_delivered_as_its_error(tmp_path):
    folder = write_recording(tmp_path / "desk", 3)
    cut(folder / "depth/1.png")
    camera = open_camera(f"replay:{folder}")
    assert len(camera.preview(3)) == 2
    kinds = [isinstance(frame.frame, FrameError) for frame in iter(camera.read, None)]
    assert kinds == [False, True, False]


def test_closing_ends_a_wait(tmp_path):
    folder = write_recording(tmp_path / "desk", 2)
    text = (folder / "depth.txt").read_text().replace("100.100000", "109.000000")
    (folder / "depth.txt").write_text(text)
    text = (folder / "rgb.txt").read_text().replace("100.104000", "109.000000")
    (folder / "rgb.txt").write_text(text)
    camera = open_camera(f"replay:{folder}")
    assert camera.read().number == 0
    threading.Timer(0.1, camera.close).start()
    start = time.perf_counter()
    assert camera.read() is None
    assert time.perf_counter() - start < 5
