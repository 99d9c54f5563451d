"""Times of the stages by events, where the device works later than the program."""

import time

import numpy as np
import pytest

from dudmap.gpu.device import make_backend, make_clock

wp = pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")
make_backend("warp-cpu")

from streamed import NAME, Gpu

from dudmap.gpu import faults
from dudmap.gpu.clock import DeviceClock
from dudmap.gpu.streams import main_queue
from dudmap.stage_timer import StageTimer
from dudmap.state import wiring


@pytest.fixture
def gpu(monkeypatch):
    yield Gpu(monkeypatch, 0)
    faults.forget()


def test_a_stage_lasts_as_long_as_its_own_work(gpu):
    """The device does all of it when the times are asked for; the program only gives it."""
    timer, main = StageTimer({"preprocess": 3.0}, DeviceClock(NAME)), main_queue(NAME)
    for seconds, stage in ((0.02, "track"), (0.0, "label"), (0.01, "track")):
        with timer(stage):
            gpu.main.give(lambda seconds=seconds: time.sleep(seconds))
    assert timer.timings == {"preprocess": 3.0}
    times = timer.times()
    assert times["preprocess"] == 3
    assert 30 <= times["track"] < 100
    assert 0 <= times["label"] < 10
    main.finish(main.record())
    assert timer.times() == times


def test_the_program_measures_where_the_device_is_lost(gpu):
    clock = DeviceClock(NAME)
    start = clock.mark()
    time.sleep(0.01)
    with faults.told_to(lambda sentence: None):
        faults.lose(RuntimeError("lost"), NAME)
    assert 10 <= clock.elapsed(start, clock.mark()) < 100


def test_the_cpu_is_measured_by_the_program():
    assert make_clock("cpu") is None
    assert make_clock("warp-cpu") is None
    timer = StageTimer()
    with timer("track"):
        time.sleep(0.01)
    assert 10 <= timer.timings["track"] < 100
    assert timer.times() is timer.timings


def test_marks_are_no_part_of_the_state(gpu):
    timer = StageTimer({"preprocess": 3.0}, DeviceClock(NAME))
    with timer("track"):
        np.zeros(1)
    assert wiring.attributes(timer) == {"timings": {"preprocess": 3.0}}
