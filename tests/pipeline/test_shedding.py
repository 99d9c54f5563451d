"""Live runs omit work in a known order before frames are dropped, and take it back when there is time again."""

from itertools import pairwise

from dudmap.app.pipeline.run import run
from dudmap.app.pipeline.shedding import CALM, SAID, SPAN, STEPS, Shedding
from dudmap.config import Config
from dudmap.core.shed import Shed
from dudmap.io.cameras.replay import ReplayCamera
from dudmap.io.sequences import open_sequence
from recordings import write_recording

PERIOD = 1 / 30


def fed(shedding, busy, frames, first=0, step=1):
    """Steps after each of some frames that arrive at 30 Hz and take some periods each."""
    steps = []
    for number in range(first, first + frames * step, step):
        shedding.add(number, number * PERIOD, busy * PERIOD)
        steps.append(shedding.omitted)
    return steps


def test_frames_in_time_omit_nothing():
    assert set(fed(Shedding(), 0.99, 200)) == {Shed.NOTHING}


def test_slow_frames_omit_more_and_more_in_order():
    steps = fed(Shedding(), 1.2, 5 * SPAN)
    assert [b for a, b in pairwise(steps) if b != a] == STEPS[1:]
    assert steps[-1] == sum(Shed, Shed.NOTHING)


def test_dropped_frames_do_not_lengthen_the_period():
    """A frame of 1.5 periods that drops every second frame is too slow, though it ends before the next one it gets."""
    assert fed(Shedding(), 1.5, SPAN + 1, step=2)[-1] == Shed.MOVERS


def test_bursts_do_not_change_the_period():
    shedding = Shedding()
    fed(shedding, 0.9, 30)
    for number in range(30, 100):
        shedding.add(number, (number - number % 2) * PERIOD, 0.9 * PERIOD)
        assert shedding.omitted == Shed.NOTHING


def test_one_slow_frame_is_at_most_one_step():
    shedding = Shedding()
    fed(shedding, 0.9, 50)
    shedding.add(50, 50 * PERIOD, 30 * PERIOD)
    assert max(fed(shedding, 0.9, 50, 51)) == Shed.MOVERS


def test_work_is_taken_back_step_by_step_when_there_is_time():
    shedding = Shedding()
    fed(shedding, 1.2, 5 * SPAN)
    steps = fed(shedding, 0.6, 7 * CALM, 5 * SPAN)
    assert steps[CALM - 2] == STEPS[-1]
    assert [b for a, b in pairwise(steps) if b != a] == STEPS[-2::-1]
    shedding = Shedding()
    fed(shedding, 1.2, SPAN + 1)
    assert set(fed(shedding, 0.85, 100, SPAN + 1)) == {Shed.MOVERS}, "neither too slow nor with time to spare"


def test_a_live_run_counts_and_names_omitted_work(slam, tmp_path, caplog, monkeypatch):
    caplog.set_level("INFO", "dudmap.app")
    shown = []
    monkeypatch.setattr("dudmap.app.pipeline.run.Shedding.add", lambda self, *_: setattr(self, "_step", 2))
    monkeypatch.setattr("dudmap.app.pipeline.progress.RunProgress.frame", lambda *given: shown.append(given[-1]))
    sequence = open_sequence(write_recording(tmp_path / "desk", 4))
    metrics = run(ReplayCamera(sequence), Config(), tmp_path / "out", progress=False).metrics
    frames = metrics["frames"]
    assert frames > 1
    assert metrics["shed"] == {"movers": frames - 1, "labels": 0, "fusion": frames - 1, "most": 0}
    assert set(shown) == {SAID[STEPS[2]]}
    assert any(f"of {frames} frames {frames - 1} have no moving objects" in message for message in caplog.messages)
    assert "shed" not in run(sequence, Config(), tmp_path / "unhurried", progress=False).metrics
