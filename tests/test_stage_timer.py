"""Times of stages that follow each other and that lie within each other."""

import pytest

from dudmap.core.tracking import frame_view
from dudmap.core.tracking.frame_view import StageTimer


def test_no_time_counts_twice(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(frame_view.time, "perf_counter", lambda: now[0])
    timer = StageTimer({"before": 5.0})
    with timer("outer"):
        now[0] += 0.010
        with timer("inner"):
            now[0] += 0.020
            with timer("outer"):
                now[0] += 0.001
        with timer("inner"):
            now[0] += 0.030
        now[0] += 0.002
    now[0] += 1.0
    with timer("next"):
        now[0] += 0.004
    assert timer.timings == pytest.approx({"before": 5.0, "outer": 13.0, "inner": 50.0, "next": 4.0})
