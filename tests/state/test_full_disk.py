"""A disk that is full when a result file is written; test_kills.py has one that fills up during the run."""

import errno
import os

import dudmap.atomic_file
from dudmap.app.pipeline.run import run
from dudmap.config import Config
from dudmap.errors import DudmapError
from dudmap.io.sequences import open_sequence
from recordings import write_recording


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
