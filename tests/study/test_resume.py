"""A study that is killed at any moment goes on where it was: no run is lost, none is done twice."""

import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from dudmap.lab.study.conduct import ATTEMPTS, StudyFolder, conduct, table_of
from dudmap.lab.study.worker import LocalExecutor
from study.crash_study import die_always, die_once, sleep_row, tiny_plan
from study.here import journal

SCRIPT = Path(__file__).with_name("crash_study.py")
WORKERS = 2


def start(folder, runs, kind):
    return subprocess.Popen([sys.executable, str(SCRIPT), str(folder), str(runs), kind])


def kill_in_the_middle(folder, runs, kind, rng):
    """Kill the study, not its workers, at a random moment after the first run was begun."""
    process = start(folder, runs, kind)
    while not journal(folder) and process.poll() is None:
        time.sleep(0.01)
    done = rng.uniform(0, 0.9) * runs
    while process.poll() is None:
        if Counter(line["event"] for line in journal(folder))["finished"] >= done:
            time.sleep(rng.uniform(0, 0.05))
            break
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    return process.wait() == -signal.SIGKILL


def is_running(pid):
    """Whether a process exists and is no zombie that its adoptive parent has not waited for."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    stat = Path(f"/proc/{pid}/stat")
    return not stat.is_file() or stat.read_text().rpartition(")")[2].split()[0] != "Z"


def check_complete(folder, runs, kills):
    store = StudyFolder(folder)
    keys = [run.key for run in tiny_plan(runs).runs()]
    events = Counter((line["event"], line["run"]) for line in journal(folder))
    assert all(store.result(key) is not None for key in keys)
    assert sorted(path.name for path in (folder / "runs").iterdir()) == sorted(keys)  # nothing half done is left
    assert all(events["finished", key] <= 1 for key in keys)
    begun = sum(events["begun", key] for key in keys)
    assert len(keys) <= begun <= len(keys) + WORKERS * kills


def one_trial(folder, runs, kind, seed):
    killed = kill_in_the_middle(folder, runs, kind, random.Random(seed))
    assert start(folder, runs, kind).wait() == 0
    check_complete(folder, runs, kills=1)
    return killed


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_a_killed_study_goes_on_where_it_was(tmp_path):
    assert one_trial(tmp_path, 20, "fake", seed=0)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_twenty_killed_studies_of_real_runs_go_on_where_they_were(tmp_path):
    killed = [one_trial(tmp_path / str(seed), 6, "real", 100 + seed) for seed in range(20)]
    assert sum(killed) >= 15


def test_two_studies_in_one_folder_share_the_runs(tmp_path):
    both = [start(tmp_path, 20, "fake") for _ in range(2)]
    assert [process.wait() for process in both] == [0, 0]
    check_complete(tmp_path, 20, kills=0)


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_workers_end_with_a_killed_study(tmp_path):
    process = start(tmp_path, 1000, "fake")
    while len(journal(tmp_path)) < 4:
        time.sleep(0.01)
    process.kill()
    process.wait()
    workers = {line["pid"] for line in journal(tmp_path)}
    deadline = time.monotonic() + 60  # on a busy machine a worker that has just begun notices late
    while any(is_running(pid) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not [pid for pid in workers if is_running(pid)]
    count = len(journal(tmp_path))
    assert count < 1000  # they ended before the work was done
    time.sleep(0.5)
    assert len(journal(tmp_path)) == count


def test_a_dead_worker_costs_its_current_run_only(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    executor = LocalExecutor(2, threads=1, kernels=False)
    state = conduct(tiny_plan(6).runs(), tmp_path / "study", executor, do=die_once)
    executor.close()
    assert (state.deaths, state.done, state.total) == (1, 6, 6)
    events = Counter(line["event"] for line in journal(tmp_path / "study"))
    assert events == {"begun": 7, "finished": 6, "died": 1}


def test_a_run_that_always_kills_its_worker_is_given_up_and_named(tmp_path):
    executor = LocalExecutor(1, threads=1, kernels=False)
    runs = tiny_plan(3).runs()
    state = conduct(runs, tmp_path, executor, do=die_always)
    executor.close()
    assert (state.deaths, state.done) == (ATTEMPTS, 2)
    errors = table_of(runs, tmp_path)["error"]
    assert errors.isna().tolist() == [True, False, True]
    assert errors[1] == "no result: its worker died"


def test_what_is_done_is_not_done_again(tmp_path):
    for expected in (4, 0):
        executor = LocalExecutor(1, threads=1, kernels=False)
        seen = []
        conduct(tiny_plan(4).runs(), tmp_path, executor, do=sleep_row, report=seen.append)
        executor.close()
        assert len(seen) == expected


def test_a_claimed_run_belongs_to_one_process(tmp_path):
    store = StudyFolder(tmp_path)
    store.create()
    with store.claim("a") as mine:
        assert mine
        other = (
            f"from dudmap.lab.study import worker\nwith worker.StudyFolder({str(tmp_path)!r}).claim('a') as m: print(m)"
        )
        done = subprocess.run(
            [sys.executable, "-c", other], capture_output=True, text=True, check=True, env=dict(os.environ)
        )
        assert done.stdout.strip() == "False"
    with store.claim("a") as mine:
        assert mine
