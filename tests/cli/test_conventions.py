"""What all commands have in common: --json, exit codes, quiet off a terminal, NO_COLOR, shell completion."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from dudmap.cli import COMMANDS, app, application_of
from dudmap.cli.options import GROUPS, arranged
from dudmap.cli.output import answer
from exported_runs import make_run
from long_commands import FAKED
from run_folders import write_run

SILENT = {"view"}
"""Commands that report nothing: a server until ctrl-C."""


def leaves(name, command):
    """Every command below one, with its words."""
    nested = getattr(command, "commands", None)
    if not nested:
        return {name: command}
    return {words: leaf for key, part in nested.items() for words, leaf in leaves(f"{name} {key}", part).items()}


ALL = {
    words: command
    for name in COMMANDS
    for words, command in leaves(name, arranged(typer.main.get_command(application_of(name)))).items()
}


def call(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def where(tmp_path_factory):
    folder = tmp_path_factory.mktemp("conventions")
    make_run(folder, frames=4)
    write_run(folder / "seen")
    return folder


# -- --json ------------------------------------------------------------------------------------------------------------


def test_every_reporting_command_has_json():
    lacking = {
        words
        for words, command in ALL.items()
        if not any("--json" in parameter.opts for parameter in command.params)
    }  # fmt: skip
    assert lacking == SILENT


CALLS = {
    "run": ["run", "recording", "--out", "a"],
    "demo": ["demo", "--max-frames", 2, "--out", "b"],
    "live": ["live", "replay:recording", "--out", "c"],
    "report": ["report", "seen"],
    "export": ["export", "run", "--out", "map.glb"],
    "benchmark texture": ["benchmark", "texture", "run", "--sequence", "recording", "--texture-size", 64],
    "render": ["render", "run", "--orbit", "--max-frames", 2, "--size", "32x24", "--out", "orbit.avi"],
    "clean": ["clean", "recording", "cleaned", "--run", "run"],
    "info": ["info", "recording"],
    "synth": ["synth", "made", "--scene", "plane", "--max-frames", 1, "--size", "32x24"],
    "evaluate trajectory": ["evaluate", "run", "--reference", "recording"],
    "evaluate mesh": ["evaluate", "mesh", "run/mesh.ply", "run/mesh.ply", "--samples", 100, "--no-error-mesh"],
    "evaluate masks": ["evaluate", "masks", "run", "recording"],
    "evaluate timings": ["evaluate", "timings", "seen"],
    "doctor": ["doctor"],
    "config": ["config", "--system", "thesis"],
}
"""Quick calls; the answers of the other commands have their own test below, or go through the same function."""


@pytest.mark.parametrize("words", CALLS)
def test_json_is_one_object_on_stdout(slam, where, monkeypatch, words):
    monkeypatch.chdir(where)
    monkeypatch.setattr("dudmap.cli.demo.MostDynamicFrame.finish", lambda *_: None)  # with a map that is faked
    done = call(*CALLS[words], "--json")
    assert done.exit_code == 0, done.output
    assert len(done.stdout.strip().splitlines()) == 1
    assert isinstance(json.loads(done.stdout, parse_constant=pytest.fail), dict)


@pytest.mark.parametrize("words", [words for words, faked in FAKED.items() if faked])
def test_json_of_long_commands(tmp_path, monkeypatch, words):
    arguments, replaced = FAKED[words]
    monkeypatch.chdir(tmp_path)
    for target, function in replaced.items():
        monkeypatch.setattr(target, function)
    done = call(*arguments, "--json")
    assert done.exit_code == 0, done.output
    assert isinstance(json.loads(done.stdout, parse_constant=pytest.fail), dict)


def test_every_reporting_command_was_called():
    suites = {words for words, command in ALL.items() if getattr(command.callback, "__name__", "") == "suite_command"}
    assert len(suites) >= 3
    assert set(CALLS) | set(FAKED) == set(ALL) - SILENT - suites


def test_json_of_suites(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("dudmap.lab.benchmark.report.measure_all", lambda *_: [])
    done = call("benchmark", "synthetic", "--quick", "--json", "--out", "out")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["rows"] == []


def test_what_json_cannot_hold_is_null(capsys):
    tree = {"a": float("nan"), "b": np.array([1.0, np.inf]), "c": Path("x") / "y", "d": (np.float32(1), np.int64(2))}
    answer(tree, "text", as_json=True)
    plain = {"a": None, "b": [1.0, None], "c": str(Path("x/y")), "d": [1.0, 2]}
    assert json.loads(capsys.readouterr().out) == plain
    answer(tree, "text", as_json=False)
    assert capsys.readouterr().out == "text\n"


# -- exit codes --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("words", [words for words in ALL if words != "demo"])
def test_wrong_usage_of_every_command_is_exit_code_2(words):
    done = call(*words.split(), "--no-such-option")
    assert done.exit_code == 2
    assert done.stdout == ""


MISSING = {
    "run": ["run", "nowhere"], "view": ["view", "nowhere"], "report": ["report", "nowhere"],
    "merge": ["merge", "nowhere", "there"], "diff": ["diff", "nowhere", "there"],
    "export": ["export", "nowhere", "--out", "a.ply"],
    "render": ["render", "nowhere", "--orbit", "--out", "a.mp4"], "clean": ["clean", "nowhere", "out"],
    "live": ["live", "none"], "info": ["info", "nowhere"], "calibrate": ["calibrate", "nowhere"],
    "demo": ["demo", "--set", "no.such=1"], "synth": ["synth", "out", "--scene", "moon"],
    "evaluate": ["evaluate", "nowhere"], "evaluate mesh": ["evaluate", "mesh", "nowhere", "there"],
    "evaluate masks": ["evaluate", "masks", "nowhere", "there"], "config": ["config", "--system", "none"],
    "benchmark": ["benchmark", "synthetic", "--systems", "none-such"], "study": ["study", "nowhere.toml"],
    "gate": ["benchmark", "gate", "--figures", "nowhere.toml"],
}  # fmt: skip


@pytest.mark.parametrize("arguments", MISSING.values(), ids=MISSING)
def test_an_error_is_exit_code_1_and_one_sentence_on_stderr(tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    done = call(*arguments)
    assert done.exit_code == 1, done.output
    assert done.stdout == ""
    assert done.stderr.startswith("dudmap: ")
    assert len(done.stderr.strip().splitlines()) == 1


def test_ctrl_c_is_exit_code_130(monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("dudmap.config.Config.from_tree", interrupt)
    done = call("config")
    assert done.exit_code == 130
    assert done.stderr == "dudmap: interrupted\n"


def test_exit_codes_are_documented():
    page = (Path(__file__).parents[2] / "docs" / "command-line.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| (\d+) \|", page, flags=re.MULTILINE) == ["0", "1", "2", "3", "130"]
    for name in ("NO_COLOR", "--install-completion", "--json", "DUDMAP_THREADS"):
        assert name in page


# -- terminals and pipes -----------------------------------------------------------------------------------------------

PROGRAM = [sys.executable, "-c", "from dudmap.cli import main; main()"]


@pytest.mark.parametrize("words", ["synth", "clean"])
def test_pipes_get_no_progress_bar_and_no_codes(where, tmp_path, words):
    arguments = [str(argument) for argument in CALLS[words]]
    renamed = {"made": tmp_path / "made", "cleaned": tmp_path / "cleaned", "orbit.avi": tmp_path / "orbit.avi"}
    done = subprocess.run(
        [*PROGRAM, *(str(renamed.get(argument, argument)) for argument in arguments)],
        cwd=where, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stderr == ""
    assert not re.search(r"[\r\x1b]", done.stdout)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals of this kind")
@pytest.mark.parametrize("no_color", [True, False])
def test_no_color_is_honoured_on_a_terminal(where, no_color):
    import pty

    master, slave = pty.openpty()
    environment = {key: value for key, value in os.environ.items() if key not in ("NO_COLOR", "FORCE_COLOR")}
    environment |= {"TERM": "xterm-256color"} | ({"NO_COLOR": "1"} if no_color else {})
    with subprocess.Popen([*PROGRAM, "run", "--help"], stdout=slave, stderr=slave, cwd=where, env=environment) as done:
        os.close(slave)
        text = b""
        while True:
            try:
                part = os.read(master, 65536)
            except OSError:  # Linux says so at the end
                break
            if not part:
                break
            text += part
        done.wait()
    os.close(master)
    assert b"--max-frames" in re.sub(rb"\x1b\[[0-9;]*m", b"", text)
    colored = re.search(rb"\x1b\[(?:\d+;)*(?:3[0-7]|9[0-7]|38;[0-9;]+)m", text)
    assert bool(colored) != no_color


# -- completion --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("dudmap ca", {"calibrate"}),
        ("dudmap evaluate ma", {"masks"}),
        ("dudmap run --syste", {"--system"}),
        ("dudmap run --system th", {"thesis"}),
        ("dudmap run --set tracker.hub", {"tracker.huber="}),
        ("dudmap config --system ", {"dudmap", "thesis"}),
        ("dudmap live real", {"realsense"}),
    ],
)
def test_the_shell_completes(line, expected):
    words = line.split(" ")
    environment = os.environ | {
        "_DUDMAP_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)
    }  # fmt: skip
    program = "import sys; sys.argv = ['dudmap']; from dudmap.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment, check=False)
    assert set(done.stdout.split()) == expected, done.stderr


def test_completion_can_be_installed():
    script = "import sys; sys.argv = ['dudmap', '--show-completion', 'bash']; from dudmap.cli import main; main()"
    environment = os.environ | {"_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}  # there may be no shell above
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment, check=False)
    assert "complete -o default" in done.stdout, done.stderr


# -- help and options --------------------------------------------------------------------------------------------------


def test_an_option_of_several_commands_means_one_thing():
    found = {}
    for words, command in ALL.items():
        for option in command.params:
            if option.param_type_name == "option":
                value = (option.metavar or "").split("|")[-1]
                found.setdefault(option.opts[0], {})[words] = (
                    f"{option.opts[0]} {value}".strip(),
                    option.rich_help_panel,
                )
    shared = [set(meanings.values()) for meanings in found.values() if len(meanings) > 1]
    assert [meanings for meanings in shared if len(meanings) > 1] == []


@pytest.mark.parametrize("words", ALL)
def test_help_is_grouped_and_uncut_in_80_columns(words):
    text = CliRunner(env={"COLUMNS": "80", "TERMINAL_WIDTH": "80"}).invoke(app, [*words.split(), "--help"]).output
    assert max(map(len, text.splitlines())) <= 80
    assert "\N{HORIZONTAL ELLIPSIS}" not in text
    titles = re.findall(
        r"^\N{BOX DRAWINGS LIGHT ARC DOWN AND RIGHT}\N{BOX DRAWINGS LIGHT HORIZONTAL} ([A-Za-z ]+) ",
        text,
        flags=re.MULTILINE,
    )
    assert titles == [name for name in ("Arguments", "Options", *GROUPS) if name in titles]
    assert titles[-1] == "Advanced"
    for option in (name for part in ALL[words].params if part.param_type_name == "option" for name in part.opts):
        assert re.search(rf"(?<!-){re.escape(option)}\b", text), option
