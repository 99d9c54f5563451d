"""Times of stages that follow each other and that lie within each other."""

import time

import pytest

from dudmap.stage_timer import StageTimer


def test_no_time_counts_twice():
    timer, start = StageTimer({"before": 5.0}), time.perf_counter()
    with timer("outer"):
        time.sleep(0.01)
        with timer("inner"):
            time.sleep(0.02)
            with timer("outer"):
                time.sleep(0.01)
        with timer("inner"):
            time.sleep(0.01)
    with timer("next"):
        time.sleep(0.01)
    total = 1000 * (time.perf_counter() - start)
    times = timer.timings
    assert times.pop("before") == 5.0
    assert sum(times.values()) == pytest.approx(total, abs=2)
    assert times["outer"] >= 20
    assert times["inner"] >= 30
    assert times["next"] >= 10
    assert max(times.values()) < total - 20
