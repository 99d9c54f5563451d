"""Live frames: a few wait, the rest is dropped and counted; a clock made of numbers instead of waiting."""

import csv
import json
import threading
import time

import numpy as np
import pytest

from dudmap.app.pipeline import frame_source
from dudmap.app.pipeline.frame_source import CATCH_UP, MAX_DELAY, FrameQueue, FrameRead, SourceFrame, arriving
from dudmap.app.pipeline.run import run
from dudmap.config import Config
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera
from dudmap.errors import DatasetError, FrameError
from dudmap.io.cameras.replay import ReplayCamera
from dudmap.io.sequences import open_sequence
from fake_slam import FakeSlam
from recordings import cut, write_recording


class FakeSequence:
    """Frames at given times, each of which takes a while to read."""

    name, camera, calibration, ground_truth = "stand-in", Camera(60, 60, 31.5, 23.5, 64, 48), None, None

    def __init__(self, timestamps, reading_s=0.0, error=None):
        self.timestamps, self.reading_s, self.error = np.asarray(timestamps, float), reading_s, error

    def __len__(self):
        return len(self.timestamps)

    def __getitem__(self, index):
        if self.error:
            raise self.error
        time.sleep(self.reading_s)
        depth, color = np.ones((48, 64), np.float32), np.zeros((48, 64, 3), np.uint8)
        return Frame(float(self.timestamps[index]), depth, color)

    def mask(self, index):
        return None


def in_real_time(timestamps, idle=lambda: False, **options):
    return arriving(ReplayCamera(FakeSequence(timestamps, **options)), idle=idle)


def replayed(timestamps, reading_s):
    """Numbers and times of the frames that a sensor with so slow a reader offers."""
    camera = ReplayCamera(FakeSequence(timestamps, reading_s))
    offered = list(iter(camera.read, None))
    return [frame.number for frame in offered], [frame.time - offered[0].time for frame in offered]


def test_a_reader_that_is_late_for_a_moment_leaves_none_out():
    assert replayed(3 + 0.15 * np.arange(6), 0.155)[0] == [0, 1, 2, 3, 4, 5]


def test_a_reader_that_is_too_slow_leaves_frames_out():
    indices, times = replayed(3 + 0.1 * np.arange(10), 0.24)
    assert indices == [0, 2, 4, 7, 9]  # free again at 0.24, 0.48, 0.72, 0.96
    np.testing.assert_allclose(times, 0.1 * np.array(indices), atol=1e-9)


def put(queue, number, arrival):
    queue.put(SourceFrame(number, FrameRead(FrameError("no images"), None, 0.0), arrival=arrival))


def take(queue) -> SourceFrame:
    frame = queue.take()
    assert frame is not None
    return frame


@pytest.fixture
def clock(monkeypatch):
    """The time that the queue reads, seconds."""
    now = [0.0]
    monkeypatch.setattr(frame_source.time, "perf_counter", lambda: now[0])
    return now


def test_only_frames_of_the_last_moment_wait(clock):
    queue = FrameQueue()
    clock[0] = MAX_DELAY / CATCH_UP
    for number, arrived in enumerate([0.0, 0.2, 0.26, 0.29, 0.32]):
        put(queue, number, arrived)
    assert take(queue).number == 2, "that at 0.2 is too old"
    put(queue, 5, 9.0)
    queue.close()
    assert take(queue).number == 5
    assert queue.take() is None
    assert queue.take() is None


def consumed(clock, delays, start=1.1 * MAX_DELAY / CATCH_UP):
    """Numbers of the frames of a camera of 30 Hz that a consumer takes, and their ages; each delays the next ``take``.

    The queue is ``start`` seconds old when the first frame arrives.
    """
    queue, numbers, ages, arrived, now = FrameQueue(), [], [], 0, start
    for delay in (0.0, *delays):
        now = max(now + delay, start + arrived / 30 if queue.is_empty else 0)
        while (arrival := start + arrived / 30) <= now:
            clock[0] = arrival
            put(queue, arrived, arrival)
            arrived += 1
        clock[0] = now
        frame = take(queue)
        numbers.append(frame.number)
        ages.append(now - frame.arrival)
    return np.array(numbers), np.array(ages)


def test_one_long_frame_drops_none(clock):
    numbers, ages = consumed(clock, [0.02] * 30 + [0.6] + [0.02] * 90)
    assert np.array_equal(numbers, np.arange(122))
    assert ages.max() > 0.5
    assert ages[-1] < 0.02, "the consumer has caught up"


def test_slow_frames_of_the_start_drop_none(clock):
    assert np.array_equal(consumed(clock, [0.05] * 30, start=0.0)[0], np.arange(31))


def test_frames_do_not_wait_longer_than_the_longest_frame(clock):
    numbers, ages = consumed(clock, [0.3] * 20 + [3.0, 0.06])
    assert ages[:-2].max() <= 0.34
    assert ages[-1] <= MAX_DELAY + 0.06
    assert len(numbers) == 23


def test_a_consumer_that_only_keeps_up_drops_single_frames_after_a_long_one(clock):
    numbers, ages = consumed(clock, [0.6] + [1 / 30] * 600)
    assert ages[100] > 0.3
    assert ages[-1] <= 0.1 + 1e-9
    assert set(np.diff(numbers[1:])) == {1, 2}
    assert np.diff(np.flatnonzero(np.diff(numbers[1:]) == 2)).min() >= 15


def test_a_consumer_that_is_too_slow_gets_recent_frames(clock):
    numbers, ages = consumed(clock, [0.06] * 200)
    assert ages.max() <= 0.1 + 0.06
    assert numbers[-1] > 350


def test_a_consumer_waits_for_the_next():
    queue, taken = FrameQueue(), []
    thread = threading.Thread(target=lambda: taken.append(queue.take()))
    thread.start()
    put(queue, 7, 0.0)
    thread.join(timeout=5)
    assert [frame.number for frame in taken] == [7]


def test_a_frame_that_takes_twice_as_long_drops_none():
    numbers = []
    for arrival in in_real_time(0.05 * np.arange(8)):
        numbers.append(arrival.number)
        time.sleep(0.1 if arrival.number == 3 else 0)
    assert numbers == list(range(8))


def test_a_slow_consumer_skips_frames_and_gets_the_last_one(monkeypatch):
    monkeypatch.setattr(frame_source, "MAX_DELAY", frame_source.MAX_WAIT)
    arrivals = []
    for arrival in in_real_time(0.01 * np.arange(30)):
        arrivals.append(arrival)
        if arrival.number < 20:
            time.sleep(0.035)
    indices = [arrival.number for arrival in arrivals]
    assert indices[0] == 0
    assert indices[-1] == 29
    assert all(np.diff(indices) >= 1)
    assert len(indices) < 25
    assert isinstance(arrivals[0], SourceFrame)


def test_other_work_is_done_while_no_frame_waits(monkeypatch):
    monkeypatch.setattr(frame_source, "MAX_WAIT", 60.0)  # no frame is dropped where other processes hold the cores
    done, left = [], [True] * 3

    def idle():
        done.append(arrived[-1] if arrived else None)
        return bool(left and left.pop())

    arrived = []
    for arrival in in_real_time(np.array([0.0, 0.2, 0.26, 0.3]), idle):
        arrived.append(arrival.number)
        time.sleep(0.2 if arrival.number == 1 else 0)  # then frames 2 and 3 wait
    assert arrived == [0, 1, 2, 3]
    assert not left
    assert 1 not in done


def test_stopping_early_stops_the_sensor():
    before = threading.active_count()
    frames = in_real_time(np.array([0.0, 60.0]))
    assert next(frames).number == 0
    frames.close()
    assert threading.active_count() == before


def test_an_error_of_the_reader_reaches_the_consumer():
    with pytest.raises(DatasetError, match="the disk is gone"):
        list(in_real_time(np.arange(3.0), error=DatasetError("the disk is gone")))


@pytest.fixture
def recording(tmp_path):
    """Eight frames at 20 Hz."""
    folder = write_recording(tmp_path / "desk", 8)
    for name in ("rgb.txt", "depth.txt"):
        lines = (folder / name).read_text().splitlines()
        stamped = [f"{100 + 0.05 * k:.6f} {line.split()[1]}" for k, line in enumerate(lines[1:])]
        (folder / name).write_text("\n".join([lines[0], *stamped]) + "\n")
    return folder


def test_a_live_run_counts_what_it_dropped(slam, recording, tmp_path, caplog, monkeypatch):
    fast = FakeSlam.process

    def slow(self, frame):
        time.sleep(0.2)
        return fast(self, frame)

    monkeypatch.setattr(slam, "process", slow)
    monkeypatch.setattr(frame_source, "MAX_DELAY", frame_source.MAX_WAIT)
    out = tmp_path / "out"
    report = run(open_sequence(recording), Config(), out, live=True, progress=False)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics == json.loads(json.dumps(report.metrics))
    assert metrics["dropped"] >= 2
    assert metrics["frames"] + metrics["dropped"] == 8
    assert metrics["latency_ms_median"] > 100
    with (out / "timings.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert sum(int(row["dropped"]) for row in rows) == metrics["dropped"]
    assert rows[0]["timestamp"] == "100.000000"
    assert rows[-1]["timestamp"] == "100.350000"
    assert all(float(row["latency"]) >= float(row["total"]) for row in rows)
    assert f"live: {metrics['dropped']} of 8 frames were dropped" in caplog.text


def test_a_live_run_in_time_drops_nothing(slam, recording, tmp_path, capsys):
    cut(recording / "depth/3.png")
    start = time.perf_counter()
    metrics = run(open_sequence(recording), Config(), tmp_path / "out", live=True, progress=False).metrics
    assert time.perf_counter() - start >= 0.35, "frames do not arrive before their time"
    assert (metrics["tracked"], metrics["unreadable"], metrics["dropped"]) == (7, 1, 0)
    assert "dropped" not in capsys.readouterr().err


def test_a_run_that_waits_says_nothing_of_dropped_frames(slam, recording, tmp_path):
    assert "dropped" not in run(open_sequence(recording), Config(), tmp_path / "out", progress=False).metrics
