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
    for ms, stage in ((20, "track"), (0, "label"), (10, "track")):
        with timer(stage):
            gpu.lasting(ms)
    assert timer.timings == {"preprocess": 3.0}
    times = timer.times()
    assert times == {"preprocess": 3, "track": 30, "label": 0}
    main.finish(main.record())
    assert timer.times() == times


def test_no_time_counts_twice(gpu):
    timer = StageTimer(clock=DeviceClock(NAME))
    with timer("outer"):
        gpu.lasting(10)
        with timer("inner"):
            gpu.lasting(30)
            with timer("outer"):
                gpu.lasting(10)
        with timer("inner"):
            gpu.lasting(5)
    with timer("next"):
        gpu.lasting(1)
    assert timer.times() == {"outer": 20, "inner": 35, "next": 1}


def test_a_stage_that_an_exception_ends_is_not_counted(gpu):
    timer = StageTimer(clock=DeviceClock(NAME))
    with pytest.raises(ValueError, match="stop"), timer("outer"), timer("inner"):
        raise ValueError("stop")
    with timer("next"):
        pass
    assert list(timer.times()) == ["next"]
    assert timer.times()["next"] >= 0


def test_the_program_measures_where_the_device_is_lost(gpu):
    clock = DeviceClock(NAME)
    start = clock.mark()
    time.sleep(0.01)
    with faults.told_to(lambda sentence: None):
        faults.lose(RuntimeError("lost"), NAME)
    assert clock.elapsed(start, clock.mark()) >= 10


def test_the_cpu_is_measured_by_the_program():
    assert make_clock("cpu") is None
    assert make_clock("warp-cpu") is None
    timer = StageTimer()
    with timer("track"):
        time.sleep(0.01)
    assert timer.timings["track"] >= 10
    assert timer.times() is timer.timings


def test_marks_are_no_part_of_the_state(gpu):
    timer = StageTimer({"preprocess": 3.0}, DeviceClock(NAME))
    with timer("track"):
        np.zeros(1)
    assert wiring.attributes(timer) == {"timings": {"preprocess": 3.0}, "_within": 0.0}
