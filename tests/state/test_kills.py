"""A run that is killed at any moment, or whose disk is full, and continued gives what an undisturbed run gives."""

import json
import logging
import shutil
import sys
import time

import cv2
import numpy as np
import pytest
from killing import begin, in_child, killed, lost_and_found, proceed, results

from delayed_color import DELAY, find_early
from dudmap.app.pipeline.run_folder import LOCK
from dudmap.app.state.database import StateDatabase
from dudmap.errors import DudmapError

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked")


def listener():
    """List of all sentences that the program logs from now on."""
    said, handler = [], logging.Handler()
    handler.emit = lambda record: said.append(record.getMessage())
    logging.getLogger("dudmap").addHandler(handler)
    return said


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The recording, the results of a run that was not interrupted, and the number of its statements."""
    before, patch = cv2.getNumThreads(), pytest.MonkeyPatch()
    cv2.setNumThreads(1)  # threads do not survive the fork
    find_early(patch, (4, 20, 40))
    sequence, out = lost_and_found(), tmp_path_factory.mktemp("whole")
    statements, said, execute = [], listener(), StateDatabase._execute
    with pytest.MonkeyPatch.context() as during:
        during.setattr(StateDatabase, "_execute", lambda *given: statements.append(given[1]) or execute(*given))
        begin(sequence, out)
    assert not [sentence for sentence in said if "cannot be stored" in sentence]
    found = results(out)
    assert found["corrected"] >= 1
    assert found["lost"] >= 3
    assert found["complete"]
    assert not (out / LOCK).exists()
    assert f"delay = {DELAY}" in (out / "calibration.toml").read_text()
    yield sequence, found, len(statements)
    patch.undo()
    cv2.setNumThreads(before)


def trial(whole, out, moment, seed, duration=0.0):
    """Kill, sometimes kill what continues it too, and continue; whether the first was killed at all."""
    sequence, expected, statements = whole
    rng = np.random.default_rng(seed)
    out.mkdir()
    status = in_child(killed, sequence, out, moment, rng, duration, statements)
    assert status in (0, -9)
    if status == -9 and duration and rng.uniform() < 0.3:
        in_child(killed, sequence, out, "anywhere", rng, duration, statements, proceed)
    if (status == -9 and not (out / "metrics.json").exists()) or (out / "state.db").exists():
        assert in_child(proceed, sequence, out) == 0
    found = results(out)
    assert {key for key in found.keys() | expected.keys() if found.get(key) != expected.get(key)} == set()
    return status == -9


@pytest.mark.parametrize("moment", ["checkpoint", "join", "export"])
def test_a_killed_run_is_continued(whole, tmp_path, moment):
    assert trial(whole, tmp_path / "run", moment, seed=3)


@pytest.mark.slow
def test_fifty_killed_runs_are_continued(whole, tmp_path):
    kinds = ["anywhere"] * 26 + ["checkpoint"] * 10 + ["join"] * 6 + ["export"] * 8
    start, count = time.perf_counter(), 0
    begin(whole[0], tmp_path / "timed")
    duration = time.perf_counter() - start
    for seed, moment in enumerate(np.random.default_rng(0).permutation(kinds)):
        count += trial(whole, tmp_path / str(seed), moment, seed, duration)
        shutil.rmtree(tmp_path / str(seed))
        print(f"{seed + 1} of {len(kinds)}: {moment}, {count} killed", flush=True)
    print(f"{count} of {len(kinds)} runs were killed; all were continued with equal results")
    assert count >= 45


LIMIT = 3_000_000
"""Bytes of the largest file that may be written: the database grows beyond it, the stored frames do not."""


def on_a_full_disk(sequence, out, report):
    """A run whose files cannot grow beyond ``LIMIT``; what it says is written to ``report``."""
    import resource  # POSIX only

    said = listener()
    resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT, resource.RLIM_INFINITY))
    error = ""
    try:
        begin(sequence, out)
    except DudmapError as raised:
        error = str(raised)
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    report.write_text(json.dumps({"said": said, "error": error}))


def test_a_run_goes_on_in_memory_while_the_disk_is_full(whole, tmp_path):
    """It says so once, and what is stored is not damaged."""
    (sequence, expected, _), out = whole, tmp_path / "out"
    assert in_child(on_a_full_disk, sequence, out, tmp_path / "report") == 0
    told = json.loads((tmp_path / "report").read_text())
    warnings = [sentence for sentence in told["said"] if "cannot be stored" in sentence]
    assert len(warnings) == 1
    assert "goes on in memory and tries again" in warnings[0]
    assert told["error"].startswith(f"the run folder {out} is incomplete: ")
    assert json.loads((out / "metrics.json").read_text())["frames"] == len(sequence)
    assert not [path for path in out.iterdir() if ".part" in path.name]
    assert in_child(proceed, sequence, out) == 0  # there is room again
    assert results(out) == expected
