"""Every fault of the stream on a tiny recording, and the checks that recognise them."""

import json
from dataclasses import replace

import numpy as np
import pytest

from dudmap.app.pipeline.run import run
from dudmap.config import Config
from dudmap.core.frames.observation import Observation
from dudmap.core.frames.stream_check import AGREEING, StreamCheck, sudden_factor
from dudmap.core.geometry.camera import Camera
from dudmap.core.mapper import Mapper
from dudmap.errors import ConfigError
from dudmap.lab import synthetic
from dudmap.lab.benchmark.stream_faults import fault_row, measure_stream_faults, table_head
from dudmap.lab.synthetic.stream_faults import FAULTS, FaultyStream

SMALL = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)
FRAMES = 23
CONFIG = Config().override(["volume.voxel_size=0.02"])
REJECTED = {
    "duplicated": "duplicate",
    "out of order": "order",
    "bursts": "burst",
    "sensor gone": "unreadable",
    "clock forwards": "clock",
    "clock backwards": "order",
    "clock slightly back": "order",
    "wrong stamp": "clock",
    "depth missing": "unreadable",
    "colour missing": "unreadable",
    "resolution": "resolution",
    "depth / 5": "unit",
}
"""Kind under which the frames of a fault are counted, where not all of them can be used."""


@pytest.fixture(scope="module")
def recording():
    return synthetic.sequence("room", movers=(), frames=FRAMES, camera=SMALL, noise="kinect", seed=1)


@pytest.fixture(scope="module")
def runs(recording):
    """Run of every fault."""
    return {run.fault: (run, clean) for run, clean in measure_stream_faults(recording, CONFIG)}


@pytest.mark.parametrize("fault", FAULTS)
def test_no_fault_leads_to_a_wrong_pose_that_is_called_tracked(runs, fault):
    run, clean = runs[fault]
    assert not run.outcome(clean).startswith("FAILED"), fault_row(run, clean)
    if fault in REJECTED:
        assert run.rejected.get(REJECTED[fault], 0) > 0
    else:
        assert run.rejected == {}


def test_black_images_are_not_fused_later_either(recording, monkeypatch):
    fused, integrate = [], Mapper.integrate

    def recorded(mapper, view, *arguments):
        fused.append(view.blind)
        integrate(mapper, view, *arguments)

    monkeypatch.setattr(Mapper, "integrate", recorded)
    list(measure_stream_faults(recording, CONFIG, ["black"]))
    assert fused
    assert not any(fused)


def test_table_has_one_line_per_fault(runs):
    text = table_head("room", FRAMES) + "\n" + "\n".join(fault_row(*runs[fault]) for fault in FAULTS)
    assert len(text.splitlines()) == len(FAULTS) + 4


def test_run_survives_faults_and_counts_them(recording, tmp_path):
    report = run(FaultyStream(recording, "resolution"), CONFIG, tmp_path, progress=False, max_frames=20)
    assert len(report.trajectory)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["frames_rejected"] == {"resolution": metrics["unreadable"]}
    assert metrics["unreadable"] == 5


def test_unknown_fault_is_refused(recording):
    with pytest.raises(ConfigError, match="unknown fault"):
        FaultyStream(recording, "gremlins")


# -- checks ------------------------------------------------------------------------------------------------------------


def observation(stamp, seed=None, scale=1.0):
    rng = np.random.default_rng(abs(hash(stamp)) if seed is None else seed)
    depth = (scale * (1.5 + 0.001 * rng.normal(size=(60, 80)))).astype(np.float32)
    color = rng.integers(0, 256, (60, 80, 3), dtype=np.uint8)
    return Observation(stamp, SMALL, depth, np.zeros((60, 80), np.float32), color)


def name_of(verdict):
    return "".join(one.name for one in verdict.failed)


def kinds(check, stamps):
    return [name_of(check.judge(observation(stamp))) for stamp in stamps]


def test_stamps_must_increase():
    check = StreamCheck(5.0)
    assert kinds(check, [0, 0.1, 0.1, 0.2, 0.15, 0.3]) == ["", "", "duplicate", "", "order", ""]
    assert kinds(check, [0.3002, 0.4]) == ["", ""]  # too early to know what is usual
    assert kinds(check, [0.5, 0.6, 0.6002, 0.7, np.nan, 0.8]) == ["", "", "burst", "", "clock", ""]


def test_clock_that_is_set_back_is_followed():
    check = StreamCheck(5.0)
    kinds(check, np.arange(10) / 10)
    back = 0.1 * np.arange(AGREEING + 1) - 100
    assert kinds(check, back) == ["order"] * (AGREEING - 1) + ["", ""]
    assert check.restamped(observation(back[-1])).timestamp == pytest.approx(0.9 + 0.2)


def test_one_wrong_stamp_changes_nothing_but_a_clock_set_forwards_is_believed():
    check = StreamCheck(5.0)
    kinds(check, np.arange(10) / 10)
    assert kinds(check, [5000.0, 1.0, 1.1]) == ["clock", "", ""]
    assert kinds(check, 9000 + 0.1 * np.arange(AGREEING)) == ["clock"] * (AGREEING - 1) + [""]
    assert check.clock_offset == 0


def test_repeated_images_are_recognised():
    check = StreamCheck(5.0)
    frozen = observation(0.0)
    assert check.judge(frozen).accepted
    repeats = []
    for stamp, depth, rgb in ((0.1, 0.0, 0.0), (0.2, 0.0, 0.2), (0.3, 0.3, 0.2), (0.4, 0.4, 0.4)):
        assert check.judge(replace(observation(depth), rgb=observation(rgb).rgb, timestamp=stamp)).accepted
        repeats.append(check.repeats)
    assert repeats == ["frame", "depth", "color", ""]


def test_change_of_the_unit_is_recognised_until_it_is_taken_back():
    check = StreamCheck(5.0)
    stamps = np.arange(9) / 10
    scales = [1, 1, 0.2, 0.2, 0.2, 1, 1, 3, 1]
    found = [check.judge(observation(t, scale=s)) for t, s in zip(stamps, scales, strict=True)]
    assert [name_of(verdict) for verdict in found] == ["", "", "unit", "unit", "unit", "", "", "unit", ""]
    assert "0.2" in found[2].reason


def test_motion_is_no_change_of_the_unit():
    before = np.full((60, 80), 1.0, np.float32)
    assert sudden_factor(before, 1.8 * before, reach=1.0) == 1.0  # the camera may have turned to another wall
    mixed = before.copy()
    mixed[:, 25:] = 2.5  # something left
    assert sudden_factor(before, mixed, reach=0.1) == 1.0
    assert sudden_factor(before, 5 * before, reach=0.1) == pytest.approx(5)
