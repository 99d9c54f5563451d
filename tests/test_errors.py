"""Errors people can act on: the documentation of every class, one printable line, a check of the installation."""

import inspect
import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dudmap import errors
from dudmap.app import doctor
from dudmap.cli import app
from dudmap.io.sequences import open_sequence
from fake_slam import FakeVolume
from recordings import write_recording

ROOT = Path(__file__).parents[1]
PLAIN = ("--quiet", "--no-report", "--calibration", "given")
CLASSES = [kind for _, kind in inspect.getmembers(errors, inspect.isclass) if issubclass(kind, errors.DudmapError)]


@pytest.mark.parametrize("kind", CLASSES)
def test_every_class_has_a_paragraph_that_says_what_to_do(kind):
    text = (ROOT / "docs" / "errors.md").read_text(encoding="utf-8")
    section = re.search(rf"^## `{kind.__name__}`\n(.*?)(?=^## |\Z)", text, flags=re.MULTILINE | re.DOTALL)
    assert section is not None, f"docs/errors.md lacks {kind.__name__}"
    assert "**Remedy:**" in section[1]


def test_the_page_names_no_class_that_does_not_exist():
    text = (ROOT / "docs" / "errors.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^## `(\w+)`", text, flags=re.MULTILINE)) == {kind.__name__ for kind in CLASSES}


def test_a_message_is_one_printable_line():
    error = errors.DatasetError("cannot read a\nb\x1b[2J\ud800\xa0\u202e" + "x" * 10_000_000)
    assert str(error).isprintable()
    assert str(error).startswith(r"cannot read a\nb\x1b[2J\ud800\xa0\u202exxx")
    assert len(str(error)) < 3000


def test_doctor_says_what_to_do(monkeypatch):
    monkeypatch.setattr(doctor, "installed", lambda name: None if name == "trimesh" else "0.1")
    done = CliRunner().invoke(app, ["doctor", "--json"])
    assert done.exit_code == 1
    tree = json.loads(done.stdout)
    assert tree["works"] is False
    by_name = {check["name"]: check for check in tree["checks"]}
    assert by_name["trimesh"]["mend"].startswith("pip install 'trimesh>=")
    assert "or newer is needed" in by_name["numpy"]["found"]
    assert by_name["extra view"]["mend"].endswith('pip install ".[view]" in the folder of the sources of dudmap')
    assert all(check["mend"] for check in tree["checks"] if check["state"] == "bad")


def test_doctor_of_this_installation():
    done = CliRunner().invoke(app, ["doctor"])
    assert done.exit_code == 0
    assert "dudmap works here" in done.stdout
    names = {check.name for check in doctor.checks()}
    assert {"versions", "processor", "threads", "GPU", "kernel cache", "archive cache", "viewer port"} <= names


def test_doctor_finds_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    assert "cannot be written" in doctor.not_writable(tmp_path / "file")
    assert doctor.not_writable(tmp_path / "new" / "folder") == ""


# -- log and crash -----------------------------------------------------------------------------------------------------


def events(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_the_log_has_a_line_per_event(slam, tmp_path):
    slam.script = {2: "lost", 3: "lost"}
    recording = write_recording(tmp_path / "desk", 5)
    (recording / "depth/4.png").write_bytes(b"no image")
    log = tmp_path / "log.jsonl"
    done = CliRunner().invoke(app, ["run", str(recording), "--out", str(tmp_path / "run"), "--log", str(log), *PLAIN])
    assert done.exit_code == 0, done.stderr
    rows = events(log)
    assert rows[0]["event"] == "start"
    assert rows[-1]["event"] == "finish"
    assert [row["event"] for row in rows[1:-1]] == ["tracked", "tracked", "lost", "lost", "unreadable"]
    assert [row["first"] for row in rows if row["event"] == "lost"] == [True, False]
    assert all(row["time"] > 1e9 for row in rows)
    assert rows[1]["position"] == pytest.approx(rows[1]["position"])


def test_a_log_that_cannot_be_written_is_one_sentence(slam, tmp_path):
    recording = write_recording(tmp_path / "desk", 3)
    done = CliRunner().invoke(app, ["run", str(recording), "--log", str(tmp_path / "no" / "log"), *PLAIN])
    assert done.exit_code == 1
    assert "cannot write the log" in done.stderr


def test_a_defect_leaves_a_report_and_what_was_computed(slam, tmp_path, monkeypatch):
    recording, out = write_recording(tmp_path / "desk", 5), tmp_path / "run"
    process = slam.process

    def defective(self, frame, *masks):
        if frame.timestamp > 100.25:
            raise ZeroDivisionError("injected")
        return process(self, frame, *masks)

    monkeypatch.setattr(slam, "process", defective)
    monkeypatch.setattr("sys.argv", ["dudmap", "run", "--token", "secret-word", "--token=secret-word"])
    done = CliRunner().invoke(app, ["run", str(recording), "--out", str(out), *PLAIN])
    assert done.exit_code == 1
    assert len(done.stderr.strip().splitlines()) == 1
    assert "defect of dudmap, not of your data or settings (ZeroDivisionError: injected)" in done.stderr
    (report,) = out.glob("crash-*.txt")
    text = report.read_text()
    for part in ("ZeroDivisionError: injected", "defective", '"numpy"', '"event": "tracked", "frame": 2'):
        assert part in text
    assert "secret-word" not in text
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["stopped_by"] == "ZeroDivisionError('injected')"
    assert metrics["tracked"] == 3
    assert len((out / "trajectory.txt").read_text().splitlines()) == 4
    again = CliRunner().invoke(
        app,
        [
            "run",
            str(recording),
            "--out",
            str(out),
            "--max-frames",
            "2",
            "--quiet",
            "--no-report",
            "--calibration",
            "given",
        ],
    )
    assert again.exit_code == 0, again.stderr
    assert not list(out.glob("crash-*.txt")), "a new run removes the report of the old one"


def test_a_map_that_the_defect_spoilt_does_not_hide_it(slam, tmp_path, monkeypatch):
    recording, out = write_recording(tmp_path / "desk", 5), tmp_path / "run"
    slam.script = {3: ZeroDivisionError("injected")}
    monkeypatch.setattr(FakeVolume, "extract_mesh", lambda self: [][1])
    done = CliRunner().invoke(app, ["run", str(recording), "--out", str(out), *PLAIN])
    assert "ZeroDivisionError: injected" in done.stderr
    assert len((out / "trajectory.txt").read_text().splitlines()) == 4
    assert json.loads((out / "metrics.json").read_text())["not_written"] == ["list index out of range"]


def test_frames_can_be_iterated_and_counted_from_the_end(tmp_path):
    sequence = open_sequence(write_recording(tmp_path / "desk", 3))
    assert [frame.timestamp for frame in sequence] == [100, 100.1, 100.2]
    assert sequence[-1].timestamp == 100.2
    with pytest.raises(IndexError):
        sequence[3]


def test_a_defect_outside_of_a_run_leaves_a_report_where_one_stands(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(doctor, "checks", lambda: [][1])
    done = CliRunner().invoke(app, ["doctor"])
    assert done.exit_code == 1
    (report,) = tmp_path.glob("crash-*.txt")
    assert report.name in done.stderr
    assert "IndexError" in report.read_text()
