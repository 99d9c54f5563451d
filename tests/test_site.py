"""The documentation as a site: it builds without a warning, is complete, and its Python runs."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer

import dudmap
from dudmap.cli import COMMANDS, application_of

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
SHOWN = ["first-mesh.md", "extending.md", "python.md"]


def blocks():
    for page in SHOWN:
        found = re.findall(
            r"^```python\n(.*?)^```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
        )
        assert found, page
        for number, code in enumerate(found, start=1):
            yield pytest.param(code, id=f"{page} {number}")


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
    page = text(site, "python")
    for name in dudmap.__all__:
        assert name == "__version__" or re.search(rf"\.{name}\b", page), name


@pytest.mark.slow
def test_nothing_is_loaded_from_elsewhere(site):
    for page in site.glob("*.html"):
        html = page.read_text(encoding="utf-8")
        assert re.findall(r'<(?:script|img)[^>]*src="https?:|<link[^>]*rel="stylesheet"[^>]*href="https?:', html) == []


@pytest.mark.parametrize("code", blocks())
def test_the_shown_python_runs(code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    exec(compile(code, "<shown>", "exec"), {"__name__": "__main__"})


def test_pictures_are_small():
    sizes = {path.name: path.stat().st_size for path in (DOCS / "images").iterdir()}
    assert sizes["people.webp"] < 1.5e6
    assert sum(size for name, size in sizes.items() if name.startswith("concept-")) < 1e6


@pytest.mark.slow
@pytest.mark.parametrize(("script", "target", "written"), [
    ("pictures.py", ".", ["concept-labels.png", "concept-pose-graph.png", "concept-tsdf.png"]),
    ("moving_picture.py", "people.webp", ["people.webp"]),
])  # fmt: skip
def test_the_pictures_can_be_drawn_again(script, target, written, tmp_path):
    done = subprocess.run([sys.executable, DOCS / script, target], cwd=tmp_path, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == written
