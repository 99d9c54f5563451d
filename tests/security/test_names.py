"""Names of files and folders are data for the terminal, for markup, for pages and for encodings."""

import io
import json
import os
import sys

import pytest
from typer.testing import CliRunner

from dudmap.app.terminal import plain_console, say
from dudmap.cli import app
from dudmap.errors import printable
from recordings import write_recording
from viewing.test_report import Page

NAMES = {
    "terminal": "seq\x1b]0;PWNED\a\x1b[31mred\x1b[0m", "markup": "[red]x[/bold]", "line": "a\nb",
    "bidi": "a\u202egnp.exe", "others": ":smile:a$x_^{$<img src=x>{x}{0}",
}  # fmt: skip
if sys.platform == "linux":
    NAMES["bytes"] = os.fsdecode(b"caf\xe9")


@pytest.mark.skipif(os.name != "posix", reason="names that Windows has not")
@pytest.mark.parametrize("kind", NAMES)
def test_a_recording_and_a_run_folder_of_any_name(kind, slam, tmp_path, monkeypatch):
    name = NAMES[kind]
    (tmp_path / name).parent.mkdir(exist_ok=True)
    recording = write_recording(tmp_path / "plain", 4).rename(tmp_path / name)
    last = printable(recording.name)
    monkeypatch.chdir(tmp_path)
    for command in (["info", str(recording)], ["run", str(recording), "--calibration", "given", "--out", f"{name}-out"],
                    ["report", f"{name}-out"], ["info", f"{name}-missing"]):  # fmt: skip
        found = CliRunner().invoke(app, command)
        assert found.exit_code == ("missing" in command[-1]), found.output
        text = found.output + found.stderr
        assert all(c.isprintable() or c == "\n" for c in text), command
        assert "defect" not in text
        if command[0] != "report":
            assert last in text.replace("\n", "")
    out = tmp_path / f"{name}-out"
    assert json.loads((out / "metrics.json").read_text())["sequence"] == last
    assert last in Page((out / "report.html").read_text(encoding="utf-8")).texts


def test_texts_are_shown_as_they_are(capsys):
    say("a\x1b[2J[red]\nb :smile:", err=True)
    assert capsys.readouterr().err == "a\\x1b[2J[red]\nb :smile:\n"
    from rich.table import Table

    out = io.StringIO()
    console = plain_console(file=out, width=60)
    table = Table(title="[b]t\x07")
    table.add_column("[i]c")
    table.add_row("[/]\x1b[1m:smile:")
    console.print(table)
    console.print("[link=http://x]a")
    for shown in ("[b]t\\x07", "[i]c", "[/]\\x1b[1m:smile:", "[link=http://x]a"):
        assert shown in out.getvalue()
    assert "\x1b" not in out.getvalue()
