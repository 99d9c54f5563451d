"""A disk that is full: the run goes on, says so once, and what is stored is not damaged."""

import errno
import json
import os
import resource
import sys

import cv2
import pytest
from killing import begin, in_child, lost_and_found, proceed, results

import dudmap.atomic_file
from dudmap.config import Config
from dudmap.errors import DudmapError
from dudmap.pipeline.run import run
from dudmap.sequences import open_sequence
from recordings import write_recording

LIMIT = 3_000_000
"""Bytes of the largest file that may be written: the database grows beyond it, the stored frames do not."""


def on_a_full_disk(sequence, out, report):
    """A run whose files cannot grow beyond ``LIMIT``; what it says is written to ``report``."""
    said = []
    from dudmap.pipeline.progress import RunProgress

    RunProgress.note = lambda self, sentence: said.append(sentence)
    resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT, resource.RLIM_INFINITY))
    error = ""
    try:
        begin(sequence, out)
    except DudmapError as raised:
        error = str(raised)
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    report.write_text(json.dumps({"said": said, "error": error}))


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked")
def test_a_run_goes_on_in_memory_while_the_disk_is_full(tmp_path):
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    sequence, out = lost_and_found(), tmp_path / "out"
    assert in_child(on_a_full_disk, sequence, out, tmp_path / "report") == 0
    told = json.loads((tmp_path / "report").read_text())
    warnings = [sentence for sentence in told["said"] if "cannot be stored" in sentence]
    assert len(warnings) == 1
    assert "goes on in memory and tries again" in warnings[0]
    assert told["error"].startswith(f"the run folder {out} is incomplete: ")
    assert json.loads((out / "metrics.json").read_text())["frames"] == len(sequence)
    assert not [path for path in out.iterdir() if ".part" in path.name]
    assert in_child(proceed, sequence, out) == 0  # there is room again
    assert in_child(begin, sequence, tmp_path / "whole") == 0
    assert results(out) == results(tmp_path / "whole")
    cv2.setNumThreads(before)


def test_each_result_file_that_fails_once_is_named_and_the_others_are_whole(slam, tmp_path, monkeypatch):
    sequence = open_sequence(write_recording(tmp_path / "desk", 5))
    run(sequence, Config(), tmp_path / "whole", progress=False, save_masks=True)
    expected = {path.name for path in (tmp_path / "whole").iterdir()}
    real, calls, sentences = dudmap.atomic_file.put_in_place, [], []
    failing = -1

    def put(temporary, path, *, sync=True):
        calls.append(path)
        if len(calls) - 1 == failing:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(temporary, path, sync=sync)

    monkeypatch.setattr("dudmap.atomic_file.put_in_place", put)
    for number in range(40):
        failing, out = number, tmp_path / str(number)
        calls.clear()
        try:
            run(sequence, Config(), out, progress=False, save_masks=True)
        except (DudmapError, OSError) as error:
            sentences.append(str(error))
        if len(calls) <= failing:
            break
        lost = calls[failing].relative_to(out)
        found = {path.name for path in out.iterdir()}
        assert expected - found <= {lost.name}
        assert not [path for path in out.rglob("*") if ".part" in path.name]
    assert number >= 10
    assert all("No space left on device" in sentence for sentence in sentences)
