"""What somebody sees of a first run: that kernels are compiled, that the program works, and how long all of it took."""

import io
import logging
import time

import numba
from rich.console import Console

from dudmap import Config
from dudmap.app.doctor import COMPILING
from dudmap.app.pipeline.progress import RunProgress, summary
from dudmap.app.pipeline.run import run
from dudmap.app.terminal import counted
from dudmap.core import kernel_cache
from dudmap.core.geometry.calibration import Calibration
from dudmap.io.sequences import open_sequence
from recordings import write_recording


def test_compilation_is_announced_only_while_the_cache_is_empty(tmp_path, monkeypatch, caplog):
    caplog.set_level(logging.INFO, "dudmap")
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    assert kernel_cache.count() == 0
    RunProgress(3, bar=False).announce_compilation()
    assert caplog.messages == [COMPILING]
    (kernel_cache.folder() / "kernel.nbi").touch()
    RunProgress(3, bar=False).announce_compilation()
    assert caplog.messages == [COMPILING]


def test_a_bar_moves_while_nothing_is_finished():
    console = Console(file=io.StringIO(), force_terminal=True)
    with counted("calibrating", quiet=False, console=console):
        before = len(console.file.getvalue())
        time.sleep(0.5)
        assert len(console.file.getvalue()) > before


def test_the_time_of_a_run_counts_its_calibration(slam, tmp_path, monkeypatch):
    sequence = open_sequence(write_recording(tmp_path / "desk", 4))

    def calibrate(*_):
        time.sleep(1.0)
        return Calibration.registered(sequence.camera)

    monkeypatch.setattr("dudmap.app.pipeline.calibration.calibrate_start", calibrate)
    done = run(sequence, Config(), tmp_path / "out", progress=False, calibrate=True)
    assert done.metrics["wall_s"] > 1.0


def test_the_table_says_why_tracked_frames_were_not_fused():
    metrics = dict.fromkeys(("repeated", "lost", "unreadable", "skipped_similar", "blind"), 0)
    metrics |= {"sequence": "kitchen", "frames": 160, "tracked": 160, "fused": 156, "uncertain": 4}
    console = Console(file=io.StringIO(), width=80)
    console.print(summary(metrics))
    text = console.file.getvalue()
    assert "tracked, not fused" in text
    assert "4 (4 uncertain pose or labels)" in text
