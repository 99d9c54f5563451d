"""Too little memory is one sentence, and no defect."""

import pytest
from typer.testing import CliRunner

from dudmap.cli import app


@pytest.mark.parametrize("text", ["", "Unable to allocate 1.86 TiB for an array"])
def test_too_little_memory(text, monkeypatch, tmp_path):
    def fail(*arguments, **options):
        raise MemoryError(text)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("dudmap.io.sequences.open_sequence", fail)
    for command in (["info", "a"], ["run", "a"]):
        found = CliRunner().invoke(app, command)
        assert found.exit_code == 1
        assert found.stderr.startswith(
            f"dudmap: there is not enough memory ({text or 'none is left'}); give the process"
        )
    assert list(tmp_path.iterdir()) == []


def test_a_library_that_finds_no_room(monkeypatch, tmp_path):
    def fail(*arguments, **options):
        raise ImportError("libgfortran.so.5: failed to map segment from shared object")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("dudmap.io.sequences.open_sequence", fail)
    found = CliRunner().invoke(app, ["info", "a"])
    assert "there is not enough memory (libgfortran.so.5: failed to map" in found.stderr
