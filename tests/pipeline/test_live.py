"""Live runs: frames are dropped where there is no time, all are recorded, Ctrl-C writes the results."""

import csv
import json
import logging
import time

import numpy as np
import pytest

from dudmap.app.pipeline import frame_source
from dudmap.app.pipeline.run import run
from dudmap.config import Config
from dudmap.errors import CameraError, DudmapError, FrameError
from dudmap.io.cameras import CameraFrame, LiveCamera
from dudmap.io.cameras.replay import ReplayCamera
from dudmap.io.sequences import open_sequence
from fake_slam import FakeSlam
from recordings import color_image, write_recording


@pytest.fixture
def sequence(tmp_path):
    return open_sequence(write_recording(tmp_path / "desk", 8))


def slowed(slam, monkeypatch, seconds):
    fast = FakeSlam.process

    def slow(self, frame):
        time.sleep(seconds)
        return fast(self, frame)

    monkeypatch.setattr(slam, "process", slow)
    monkeypatch.setattr(frame_source, "MAX_DELAY", frame_source.MAX_WAIT)


def test_a_run_in_time_drops_nothing(slam, sequence, tmp_path, capsys):
    report = run(ReplayCamera(sequence), Config(), tmp_path / "out", progress=False)
    assert (report.metrics["frames"], report.metrics["dropped"]) == (8, 0)
    assert report.metrics["complete"]
    assert len(report.trajectory) == 8
    assert (tmp_path / "out/mesh.ply").is_file()
    assert "dropped" not in capsys.readouterr().err


def test_all_frames_are_recorded_while_some_are_dropped(slam, sequence, tmp_path, caplog, monkeypatch):
    caplog.set_level(logging.INFO, "dudmap.app")
    slowed(slam, monkeypatch, 0.5)
    file = tmp_path / "walk.mcap"
    report = run(ReplayCamera(sequence), Config(), tmp_path / "out", record=file, progress=False)
    assert report.metrics["dropped"] >= 3
    assert report.metrics["frames"] + report.metrics["dropped"] == 8
    with (tmp_path / "out/timings.csv").open() as opened:
        rows = list(csv.DictReader(opened))
    assert sum(int(row["dropped"]) for row in rows) == report.metrics["dropped"]
    assert all(float(row["latency"]) >= float(row["total"]) for row in rows)
    said = caplog.messages
    assert f"live: {report.metrics['dropped']} of 8 frames were dropped" in said
    again = open_sequence(file)
    assert f"recorded {len(again)} frames to {file}" in said
    assert len(again) >= 7, "a busy machine may be late with one"
    assert again.camera.fx == sequence.camera.fx
    for frame in again:
        index = round(10 * (frame.timestamp - 100))
        np.testing.assert_array_equal(frame.depth, sequence[index].depth)
        np.testing.assert_array_equal(frame.color, color_image(index))


def test_the_recording_is_complete_though_the_run_folder_cannot_be_written(slam, sequence, tmp_path, monkeypatch):
    def full(*_, **__):
        raise DudmapError("no space left")

    monkeypatch.setattr("dudmap.app.pipeline.run.write_run_folder", full)
    file = tmp_path / "walk.mcap"
    with pytest.raises(DudmapError, match="no space left"):
        run(ReplayCamera(sequence), Config(), tmp_path / "out", record=file, progress=False)
    assert len(open_sequence(file)) >= 7, "a busy machine may be late with one"


def test_ctrl_c_ends_a_run_and_writes_the_results(slam, sequence, tmp_path, caplog, monkeypatch):
    caplog.set_level(logging.INFO, "dudmap.app")
    monkeypatch.setattr(slam, "script", {4: KeyboardInterrupt()})
    report = run(ReplayCamera(sequence), Config(), tmp_path / "out", record=tmp_path / "walk.mcap", progress=False)
    assert report.metrics["frames"] == 4
    assert report.metrics["complete"]
    assert json.loads((tmp_path / "out/metrics.json").read_text())["frames"] == 4
    assert "stopped by Ctrl-C after 4 frames" in caplog.messages
    assert len(open_sequence(tmp_path / "walk.mcap")) >= 4


def test_a_number_of_frames_ends_a_run(slam, sequence, tmp_path):
    start = time.perf_counter()
    report = run(ReplayCamera(sequence), Config(), tmp_path / "out", max_frames=3, progress=False)
    assert report.metrics["frames"] == 3
    assert time.perf_counter() - start < 5


class FragileCamera(LiveCamera):
    """Delivers the frames of a recording numbered from 100 on, with gaps, and breaks."""

    def __init__(self, sequence, numbers, error=None):
        self.name, self.camera, self.closed = "fragile", sequence.camera, False
        self._sequence, self._numbers, self._error = sequence, list(numbers), error

    def preview(self, count):
        return [self._sequence[0]]

    def read(self):
        time.sleep(0.15)  # long against a processed frame, so that the consumer drops none
        if not self._numbers:
            if self._error:
                raise self._error
            return None
        number = self._numbers.pop(0)
        frame = FrameError("frame 102 is damaged") if number == 102 else self._sequence[number - 100]
        return CameraFrame(number, frame, time.perf_counter())

    def close(self):
        self.closed = True


def test_frames_that_the_driver_lost_are_counted(slam, sequence, tmp_path):
    camera = FragileCamera(sequence, [100, 101, 104, 105])
    metrics = run(camera, Config(), tmp_path / "out", progress=False).metrics
    assert (metrics["frames"], metrics["dropped"]) == (4, 2)
    assert camera.closed


def test_a_depth_image_that_comes_twice_is_taken_once(slam, sequence, tmp_path):
    camera = FragileCamera(sequence, [100, 101, 101, 103])
    metrics = run(camera, Config(), tmp_path / "out", record=tmp_path / "walk.mcap", progress=False).metrics
    assert (metrics["frames"], metrics["dropped"]) == (3, 1)
    assert len(open_sequence(tmp_path / "walk.mcap")) == 3


def test_a_frame_that_cannot_be_read_is_skipped(slam, sequence, tmp_path, caplog):
    camera = FragileCamera(sequence, [100, 101, 102, 103])
    metrics = run(camera, Config(), tmp_path / "out", progress=False).metrics
    assert (metrics["tracked"], metrics["unreadable"]) == (3, 1)
    assert "skipped: frame 102 is damaged" in caplog.text


def test_a_camera_that_breaks_leaves_its_results(slam, sequence, tmp_path):
    camera = FragileCamera(sequence, [100, 101], CameraError("it was unplugged"))
    with pytest.raises(CameraError, match=r"it was unplugged; the trajectory and the map up to there are in .*out"):
        run(camera, Config(), tmp_path / "out", progress=False)
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert (metrics["frames"], metrics["complete"]) == (2, False)
    assert camera.closed


def test_no_frame_at_all_is_one_sentence(slam, sequence, tmp_path):
    with pytest.raises(CameraError, match="no frame of the camera fragile was processed"):
        run(FragileCamera(sequence, []), Config(), tmp_path / "out", progress=False)


def test_recording_over_a_file_is_refused_before_the_start(slam, sequence, tmp_path):
    (tmp_path / "walk.mcap").write_bytes(b"old")
    with pytest.raises(DudmapError, match="exists; name another file"):
        run(ReplayCamera(sequence), Config(), tmp_path / "out", record=tmp_path / "walk.mcap", progress=False)
