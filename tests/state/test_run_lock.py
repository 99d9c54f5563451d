"""One process at a time writes into a run folder; who holds it is said, and a dead one does not."""

import json
import os
import signal
import socket
import subprocess
import sys
from dataclasses import replace

import pytest

from dudmap.app.pipeline.environment import versions
from dudmap.app.pipeline.resume import resume
from dudmap.app.pipeline.run import run
from dudmap.app.pipeline.run_folder import LOCK, run_lock
from dudmap.app.pipeline.storing import RunOptions, Storing
from dudmap.app.state.database import StateDatabase
from dudmap.app.state.system import code_fingerprint, recording_fingerprint
from dudmap.config import Config
from dudmap.core.geometry.calibration import Calibration
from dudmap.errors import DudmapError, StateError
from dudmap.io.sequences import open_sequence
from recordings import write_recording

HOLD = """
import sys, time
from pathlib import Path
from dudmap.app.pipeline.run_folder import run_lock
with run_lock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_the_holder_is_named_and_a_killed_one_holds_nothing(tmp_path):
    other = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(DudmapError, match=f"in use by process {other.pid} on {socket.gethostname()} since 20"):
            with run_lock(tmp_path):
                pass
    finally:
        other.send_signal(signal.SIGKILL)
        other.communicate()
    with run_lock(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["pid"] == os.getpid()
        with pytest.raises(DudmapError, match=f"in use by process {os.getpid()} "):
            with run_lock(tmp_path):
                pass
    assert not (tmp_path / LOCK).exists()
    with run_lock(tmp_path):
        pass


def test_neither_a_second_run_nor_a_resume_enters_a_folder_in_use(slam, tmp_path):
    sequence = open_sequence(write_recording(tmp_path / "desk", 4))
    out = tmp_path / "out"
    out.mkdir()
    (out / "trajectory.txt").write_text("of the other")
    with run_lock(out):
        with pytest.raises(DudmapError, match="in use by process"):
            run(sequence, Config(), out, progress=False)
        with pytest.raises(DudmapError, match="in use by process"):
            resume(out)
        assert (out / "trajectory.txt").read_text() == "of the other"
    assert run(sequence, Config(), out, progress=False).metrics["complete"]


def test_the_folder_is_taken_before_the_calibration_which_a_resumed_run_repeats(slam, tmp_path, monkeypatch):
    recording, out = write_recording(tmp_path / "desk", 4), tmp_path / "out"
    sequence = open_sequence(recording)
    found = replace(Calibration.registered(sequence.camera), delay=0.02)

    def killed(*_):
        with pytest.raises(DudmapError, match="in use by process"):
            run(sequence, Config(), out, progress=False)
        raise KeyboardInterrupt

    monkeypatch.setattr("dudmap.app.pipeline.calibration.calibrate_start", killed)
    ordered = {"progress": False, "calibrate": True, "storing": Storing({"path": str(recording)})}
    (tmp_path / "file").touch()
    with pytest.raises(DudmapError, match="cannot write into the run folder"):
        run(sequence, Config(), tmp_path / "file", **ordered)
    with pytest.raises(KeyboardInterrupt):
        run(sequence, Config(), out, max_frames=3, save_masks=True, **ordered)
    monkeypatch.setattr("dudmap.app.pipeline.calibration.calibrate_start", lambda *_: found)
    assert resume(out, progress=False).metrics["frames"] == 3
    assert Calibration.load(out / "calibration.toml").delay == 0.02
    assert len(list((out / "masks").iterdir())) == 3
    assert not (out / "state.db").exists()


def test_why_a_folder_cannot_be_continued(slam, tmp_path):
    recording, out = write_recording(tmp_path / "desk", 4), tmp_path / "out"
    sequence = open_sequence(recording)
    with pytest.raises(StateError, match="there is no run folder"):
        resume(out)
    out.mkdir()
    with pytest.raises(StateError, match="holds no state of a run"):
        resume(out)
    run(sequence, Config(), out, progress=False, storing=Storing({"path": str(recording)}))
    assert not (out / "state.db").exists()
    with pytest.raises(StateError, match=r"is finished \(4 frames\); there is nothing to resume"):
        resume(out)
    ordered = RunOptions(config=Config(), max_frames=4, ahead=2, storing=Storing({"path": str(recording)}))
    options = ordered.model_dump(mode="json")
    about = {"options": options, "recording": recording_fingerprint(sequence),
             "code": "of yesterday", "versions": {"dudmap": "0.0"}, "pass": 0, "next": 0, "frame": ""}  # fmt: skip
    database = StateDatabase(out / "state.db")
    database.write_meta(about)
    with pytest.raises(StateError, match=r"was written by another version of dudmap .*\(dudmap 0\.0, here "):
        resume(out)
    database.write_meta({"versions": versions()})
    with pytest.raises(StateError, match="its code has changed"):
        resume(out)
    database.write_meta({"code": code_fingerprint(), "recording": "of another room"})
    with pytest.raises(StateError, match="the recording desk has changed since the run"):
        resume(out)
    database.write_meta({"recording": recording_fingerprint(sequence), "options": options | {"max_frames": "four"}})
    with pytest.raises(StateError, match="is damaged or not the state of a run"):
        resume(out)
    database.write_meta({"options": options, "next": 3, "frame": "of another frame"})
    with pytest.raises(StateError, match="the recording desk has changed since the run"):
        resume(out)
