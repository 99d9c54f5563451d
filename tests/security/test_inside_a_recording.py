"""Nothing is written into a recording: one sentence, before anything else happens."""

import pytest
from typer.testing import CliRunner

from dudmap.cli import app
from recordings import write_recording

COMMANDS = {
    "run": ["run", "desk", "--out", "PLACE"],
    "live": ["live", "replay:desk", "--out", "PLACE"],
    "record": ["live", "replay:desk", "--out", "elsewhere", "--record", "PLACE/walk.mcap"],
    "clean": ["clean", "desk", "PLACE"],
    "calibrate": ["calibrate", "desk", "--out", "PLACE/calibration.toml"],
    "info": ["info", "desk", "--sheet", "PLACE/sheet.png"],
}


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("place", ["desk/runs/one", "link/one", "desk/../desk/one", "inner/deeper"])
def test_it_is_refused(slam, tmp_path, monkeypatch, name, place):
    monkeypatch.chdir(tmp_path)
    write_recording(tmp_path / "desk", 4)
    (tmp_path / "link").symlink_to(tmp_path / "desk")
    (tmp_path / "inner").symlink_to(tmp_path / "desk" / "rgb")
    before = sorted(str(path) for path in tmp_path.rglob("*"))
    done = CliRunner().invoke(app, [word.replace("PLACE", place) for word in COMMANDS[name]])
    assert done.exit_code == 1, done.output
    line = done.stderr.strip().splitlines()[-1]
    assert "lies in the recording desk, which is only read" in line
    assert sorted(str(path) for path in tmp_path.rglob("*")) == before


def test_a_folder_beside_the_recording_is_none_of_it(slam, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_recording(tmp_path / "desk", 4)
    assert CliRunner().invoke(app, ["run", "desk", "--out", "desk-run", "--quiet"]).exit_code == 0
