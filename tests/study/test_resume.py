"""A study that is killed at any moment goes on where it was: no run is lost, none is done twice."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dudmap.errors import DudmapError
from dudmap.lab.study.runs import conduct, table_of
from study.crash_study import dies_always, dies_once, figures, tiny_plan
from study.here import kept

SCRIPT = Path(__file__).with_name("crash_study.py")


def start(folder, runs):
    return subprocess.Popen([sys.executable, str(SCRIPT), str(folder), str(runs)], stderr=subprocess.DEVNULL)


def is_running(pid):
    """Whether a process exists and is no zombie that its adoptive parent has not waited for."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    stat = Path(f"/proc/{pid}/stat")
    return not stat.is_file() or stat.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_a_killed_study_goes_on_where_it_was_and_its_workers_end_with_it(tmp_path):
    process = start(tmp_path, 200)
    while len(kept(tmp_path)) < 5 and process.poll() is None:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    lines = (tmp_path / "runs.jsonl").read_text().splitlines()
    workers = {json.loads(line)["row"]["pid"] for line in lines if line.endswith("}")}
    deadline = time.monotonic() + 60  # on a busy machine a worker that has just begun notices late
    while any(is_running(pid) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not [pid for pid in workers if is_running(pid)]
    before = len(kept(tmp_path))
    assert 5 <= before < 200
    runs = tiny_plan(before + 3).runs()
    seen = []
    rows = conduct(runs, tmp_path, 2, measure=figures, progress=lambda done, total: seen.append(done))
    assert len(seen) == len(runs) - len({run.key for run in runs} & set(kept(tmp_path)[:before]))
    assert [row["ate_rmse_m"] for row in rows] == [run.values["tracker.huber"] for run in runs]
    assert len(kept(tmp_path)) == len(set(kept(tmp_path)))


def test_two_studies_in_one_folder_do_not_mix(tmp_path):
    process = start(tmp_path, 100)
    while not kept(tmp_path) and process.poll() is None:
        time.sleep(0.01)
    with pytest.raises(DudmapError, match="is in use by process"):
        conduct(tiny_plan(2).runs(), tmp_path, measure=figures)
    process.kill()
    process.wait()


def test_the_run_of_a_worker_that_dies_is_done_again(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rows = conduct(tiny_plan(6).runs(), tmp_path / "study", 2, measure=dies_once)
    assert all(row["lost"] == 0 for row in rows)
    assert len(kept(tmp_path / "study")) == 6


def test_a_run_that_always_kills_its_worker_is_named_and_tried_again_by_the_next_start(tmp_path):
    runs = tiny_plan(3).runs()
    errors = table_of(runs, conduct(runs, tmp_path, measure=dies_always))["error"]
    assert errors.isna().tolist() == [True, False, True]
    assert "its process died" in errors[1]
    again = table_of(runs, conduct(runs, tmp_path, measure=figures))
    assert "error" not in again


def test_what_is_done_is_not_done_again(tmp_path):
    seen = []
    for expected in (4, 4):
        conduct(tiny_plan(4).runs(), tmp_path, measure=figures, progress=lambda done, total: seen.append((done, total)))
        assert len(seen) == expected
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
