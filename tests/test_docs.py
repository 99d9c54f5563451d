"""What the documentation shows is so: links, commands, options, parameters, files, and the README's Python."""

import csv
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from dudmap.cli import COMMANDS, application_of
from dudmap.config import Config, keys
from dudmap.gone_keys import GONE
from dudmap.io.sequences import readers

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
EXCERPT = ROOT / "tests" / "fixtures" / "freiburg1_xyz"
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(text, language=""):
    return re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)


def shown_commands():
    """Every line of a code block that calls dudmap, without its comment, by page."""
    for page in PAGES:
        for block in blocks(page.read_text(encoding="utf-8")):
            for line in block.splitlines():
                if line.startswith("dudmap "):
                    yield pytest.param(line.partition("#")[0].strip(), id=f"{page.name}: {line[:60]}")
    for line in re.findall(r"`(dudmap [^`]+)`", (ROOT / "docs" / "README.md").read_text(encoding="utf-8")):
        yield pytest.param(line, id=f"docs/README.md: {line[:60]}")


def program(*arguments, cwd):
    dudmap = "from dudmap.cli import main; main()"
    return subprocess.run(
        [sys.executable, "-c", dudmap, *arguments],
        cwd=cwd, capture_output=True, text=True, check=False, env=os.environ | {"COLUMNS": "120"},
    )  # fmt: skip


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """What the README's second command leaves, on the real excerpt."""
    where = tmp_path_factory.mktemp("docs")
    line = next(line for line in README.splitlines() if "--out my_run --set" in line)
    arguments = shlex.split(line.partition("#")[0].replace("SEQUENCE", str(EXCERPT)))[1:]
    done = program(*arguments, cwd=where)
    assert done.returncode == 0, done.stderr
    return where / "my_run"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), f"{page.name} links {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_link_texts_are_words_and_no_names_of_pages(page):
    assert re.findall(r"\[[a-z/-]+\.md\]\(", page.read_text(encoding="utf-8")) == []


def test_every_page_is_in_the_index():
    index = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    for page in PAGES[3:]:
        assert page.name == "README.md" or f"({page.name})" in index


def read(*patterns):
    """Text of all files of these patterns."""
    return "\n".join(path.read_text(encoding="utf-8") for pattern in patterns for path in sorted(ROOT.glob(pattern)))


TEXT = read("README.md", "CONTRIBUTING.md", "SECURITY.md", "docs/*.md", "ros/*.md")


def test_named_files_exist():
    files = {path.relative_to(ROOT).as_posix() for path in ROOT.rglob("*.*") if ".venv" not in path.parts}
    named = re.findall(r"`([\w./-]+\.(?:py|yml|ipynb|cff))`", TEXT)
    missing = {name for name in named if not any(f"/{file}".endswith(f"/{name}") for file in files)}
    assert missing - ELSEWHERE == set()


def test_named_functions_classes_and_parameters_exist():
    words = set(re.findall(r"\w+", read("src/**/*.py", "tests/**/*.py", "ros/**/*.py")))
    text = re.sub(r"```.*?```", "", TEXT, flags=re.DOTALL)
    named = {name.rstrip("()") for name in re.findall(r"`([A-Za-z_][\w.]*(?:\(\))?)`", text)}
    commits = {name for name in named if re.fullmatch(r"[0-9a-f]{7,8}", name)}
    assert {name for name in named - commits - ELSEWHERE if name.rpartition(".")[2] not in words} == set()


ELSEWHERE = {
    *("_mb", "_px", "color_k1", "overlap_min", "residual_mm_max"),  # endings, and names that are put together
    *("camera_configuration.calibration_parameters.left_cam", "prange", "associate.py"),  # of other programs
    *("fr1", "kitchen_filinha", "tsdf_sample"),  # recordings
}


def test_every_command_example_variable_and_picture_is_on_a_page():
    variables = set(re.findall(r"DUDMAP_[A-Z]+", read("src/**/*.py")))
    examples = {path.name for path in (ROOT / "examples").iterdir()}
    assert {name for name in {*variables, *examples} if name not in TEXT} == set()
    assert {name for name in COMMANDS if f"dudmap {name}" not in TEXT} == set()
    pictures = [path for kind in ("jpg", "png", "webp", "svg") for path in (ROOT / "docs").rglob(f"*.{kind}")]
    assert [path.name for path in pictures if f"{path.name})" not in TEXT and "_build" not in path.parts] == []


def test_every_format_is_in_the_table_of_formats():
    text = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    assert [reader.format for reader in readers() if f"| {reader.format}" not in text] == []


@pytest.mark.parametrize("line", shown_commands())
def test_shown_commands_exist_with_their_options(line):
    words = shlex.split(line.replace("[", " ").replace("]", " ").replace("|", " "))[1:]
    assert words[0] in COMMANDS
    command = typer.main.get_command(application_of(words[0]))
    nested = getattr(command, "commands", {})
    if nested:
        command = nested[words[1] if len(words) > 1 and words[1] in nested else next(iter(nested))]
    known = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
    assert {word for word in words if word.startswith("--")} <= known | {"--help"}


def test_shown_parameters_exist():
    for page in PAGES:
        for key in re.findall(r"`([a-z]+\.[a-z_]+) ?=|--set ([a-z]+\.[a-z_]+)=", page.read_text(encoding="utf-8")):
            known = {*keys(), *(GONE if page.name == "CHANGELOG.md" else ())}
            assert (key[0] or key[1]) in known, f"{page.name} names {key}"


def test_every_parameter_is_listed_with_its_part():
    page = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([a-z]+)` \| .* \| (.*) \|$", page, flags=re.MULTILINE)
    listed = {f"{part}.{key}" for part, names in rows for key in re.findall(r"`([a-z0-9_]+)`", names)}
    assert listed == {key for key in keys() if "." in key}
    assert {part for part, _ in rows} == {key.partition(".")[0] for key in keys()} - {"system"}


def test_the_printed_configuration_is_the_default(tmp_path):
    printed = program("config", cwd=tmp_path)
    (tmp_path / "my.toml").write_text(printed.stdout, encoding="utf-8")
    assert Config.load(tmp_path / "my.toml") == Config()


def test_the_readme_python_runs(tmp_path, monkeypatch, capsys):
    (code,) = blocks(README, "python")
    path = re.search(r'open_sequence\("([^"]+)"\)', code)
    assert path is not None
    code = code.replace(path[1], str(EXCERPT))
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "<README>", "exec"), {"__name__": "__main__"})
    assert capsys.readouterr().out.count("tracked") == 12
    assert (tmp_path / "trajectory.txt").is_file()
    assert (tmp_path / "mesh.ply").is_file()


def test_the_readme_evaluation_runs(run_folder):
    done = program("evaluate", "my_run", "--reference", str(EXCERPT), cwd=run_folder.parent)
    assert done.returncode == 0, done.stderr


def test_every_written_file_and_figure_is_described(run_folder):
    page = (ROOT / "docs" / "files.md").read_text(encoding="utf-8")
    described = set(re.findall(r"`([A-Za-z_0-9.<>/]+)`", page))
    metrics = json.loads((run_folder / "metrics.json").read_text(encoding="utf-8"))
    for name in [path.name for path in run_folder.iterdir() if path.is_file()] + list(metrics):
        assert name in described or name.startswith(("evaluation", "trajectory")), f"docs/files.md lacks {name}"
    with (run_folder / "timings.csv").open(encoding="utf-8") as file:
        columns = next(csv.reader(file))
    assert columns[:6] == ["timestamp", "state", "fused", "dynamic_share", "reading", "total"]
    assert set(columns[6:]) <= described, "docs/files.md lacks a stage"


def test_continuous_integration_is_make_test():
    commands = [line for line in (ROOT / ".ci/run").read_text().splitlines() if "make" in line]
    assert commands == ["exec make test"]
    for target in re.findall(r"^make (\w+)", README, flags=re.MULTILINE):
        assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)
