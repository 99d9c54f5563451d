"""``dudmap live`` as a program."""

import json
import signal
import subprocess
import sys
import time

import pytest
from typer.testing import CliRunner

from dudmap.cli import app
from dudmap.io.sequences import open_sequence
from recordings import write_recording


def live(*arguments):
    return CliRunner().invoke(app, ["live", *map(str, arguments)])


def test_a_replay_is_processed_and_recorded(slam, tmp_path):
    folder, file = write_recording(tmp_path / "desk", 4), tmp_path / "walk.mcap"
    done = live(f"replay:{folder}", "--record", file, "--out", tmp_path / "out", "--json")
    assert done.exit_code == 0, done.output
    metrics = json.loads(done.stdout)
    assert metrics["frames"] + metrics["dropped"] == 4
    assert (metrics["sequence"], metrics["camera"]["fx"]) == ("desk", 60)
    assert len(open_sequence(file)) == 4


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["webcam"], "dudmap: there is no camera 'webcam'; expected one of realsense"),
        (["replay"], "expected replay:PATH"),
        (["replay:/nowhere"], "there is no folder or file /nowhere"),
        (["--map", "/nowhere"], "/nowhere"),
    ],
)
def test_what_is_wrong_is_one_sentence(slam, arguments, sentence):
    done = live(*arguments)
    assert done.exit_code == 1
    assert sentence in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_ctrl_c_writes_the_results_of_a_real_run(tmp_path):
    """The whole program on a synthetic room: interrupted when the first frames are through."""
    dudmap = [sys.executable, "-c", "from dudmap.cli import main; main()"]
    room = tmp_path / "room"
    subprocess.run(
        [*dudmap, "synth", room, "--max-frames", "450", "--size", "160x120"], check=True, capture_output=True
    )
    out, file = tmp_path / "out", tmp_path / "walk.mcap"
    run = subprocess.Popen(
        [*dudmap, "live", f"replay:{room}", "--out", out, "--record", file],
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 300
    while not _grown(tmp_path / "walk.recording/walk.recording.mcap") and time.monotonic() < deadline:
        time.sleep(0.2)
    time.sleep(1)
    run.send_signal(signal.SIGINT)
    _, said = run.communicate(timeout=120)
    assert run.returncode == 0, said
    assert "stopped by Ctrl-C after" in said
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["tracked"] >= 5
    assert metrics["complete"]
    assert (out / "mesh.ply").is_file()
    assert len(open_sequence(file)) >= metrics["frames"]


def _grown(path):
    return path.is_file() and path.stat().st_size > 0
