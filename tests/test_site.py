"""The documentation as a site: it builds without a warning, is complete, and its Python runs."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer

import dudmap
from browsers import find_chromium
from dudmap.cli import COMMANDS, application_of

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"


def programs():
    """Name and text of each shown program: a block, or all blocks of python.md."""
    for path in [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]:
        found = re.findall(r"^```python\n(.*?)^```", path.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
        if path.name == "python.md":
            found = ["\n".join(found)]
        yield from ((f"{path.stem} {number}", code) for number, code in enumerate(found, start=1))


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "--fail-on-warning", "--keep-going", "--quiet", DOCS, folder]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def text(site, name):
    html = (site / f"{name}.html").read_text(encoding="utf-8")
    return re.sub(r"<[^>]+>", "", html.replace("&lt;", "<").replace("&gt;", ">"))


@pytest.mark.slow
def test_every_page_is_built(site):
    for page in DOCS.glob("*.md"):
        assert page.name == "README.md" or (site / f"{page.stem}.html").is_file()


@pytest.mark.slow
def test_every_command_with_its_options_is_on_the_site(site):
    page = text(site, "commands")
    for name in COMMANDS:
        command = typer.main.get_command(application_of(name))
        for inner in getattr(command, "commands", {"": command}).values():
            assert f"dudmap {name}" in page
            for parameter in inner.params:
                assert parameter.param_type_name == "argument" or all(option in page for option in parameter.opts)


@pytest.mark.slow
def test_every_public_name_is_on_the_site(site):
    page = text(site, "api")
    for name in dudmap.__all__:
        assert name == "__version__" or re.search(rf"\.{name}\b", page), name


@pytest.mark.slow
def test_nothing_is_loaded_from_elsewhere(site):
    for page in site.glob("*.html"):
        html = page.read_text(encoding="utf-8")
        assert re.findall(r'<(?:script|img)[^>]*src="https?:|<link[^>]*rel="stylesheet"[^>]*href="https?:', html) == []


@pytest.mark.parametrize("code", [pytest.param(code, id=name) for name, code in programs() if name[:6] != "README"])
def test_the_shown_python_runs(code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    for file in (Path("run/trajectory.txt"), Path("recording/groundtruth.txt")):  # which evaluation.md reads
        file.parent.mkdir()
        file.write_text("".join(f"{0.1 * k} {k} {k * k} 0 0 0 0 1\n" for k in range(5)), encoding="utf-8")
    exec(compile(code, "<shown>", "exec"), {"__name__": "__main__"})


@pytest.mark.slow
@pytest.mark.parametrize(
    "checker",
    [["pyright", "--project", "strict.json", "--pythonpath", sys.executable],
     ["mypy", "--strict", "--follow-imports=silent", "--python-executable", sys.executable, "shown"]],
    ids=["pyright", "mypy"],
)  # fmt: skip
def test_the_shown_python_is_typed(checker, tmp_path):
    """All blocks and examples."""
    (tmp_path / "shown").mkdir()
    examples = [(path.stem, path.read_text(encoding="utf-8")) for path in (ROOT / "examples").glob("*.py")]
    for name, code in [*programs(), *examples]:
        (tmp_path / "shown" / f"{name.replace(' ', '_').replace('-', '_')}.py").write_text(code, encoding="utf-8")
    strict = {"include": ["shown"], "extraPaths": [str(ROOT / "src")], "typeCheckingMode": "strict"}
    (tmp_path / "strict.json").write_text(json.dumps(strict), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", *checker], cwd=tmp_path, env=os.environ | {"MYPYPATH": str(ROOT / "src")},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr


def test_pictures_are_small():
    sizes = {path.name: path.stat().st_size for path in (DOCS / "images").iterdir()}
    assert sizes["people.webp"] < 1.5e6
    assert sum(size for name, size in sizes.items() if name.startswith("concept-")) < 1e6


@pytest.mark.slow
@pytest.mark.parametrize(("script", "target", "written"), [
    ("pictures.py", ".", ["concept-labels.png", "concept-pose-graph.png", "concept-tsdf.png"]),
    ("moving_picture.py", "people.webp", ["people.webp"]),
    pytest.param(
        "page_pictures.py", ".", ["demo.jpg", "figures", "synthetic.jpg"],
        marks=pytest.mark.skipif(not find_chromium(), reason="no Chromium"),
    ),
])  # fmt: skip
def test_the_pictures_can_be_drawn_again(script, target, written, tmp_path):
    done = subprocess.run([sys.executable, DOCS / script, target], cwd=tmp_path, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == written
