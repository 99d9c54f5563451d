"""Wheel and sdist, citation, hooks, workflow. "make package" checks the metadata and installs the wheel."""

import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
import yaml

import dudmap

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "src" / "dudmap"
DATA = {".py", ".typed", ".toml", ".csv", ".css", ".html", ".js", ".txt"}


@pytest.fixture(scope="module")
def dist(tmp_path_factory):
    """Folder with sdist and wheel, the wheel built from the sdist."""
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
    return folder


@pytest.fixture(scope="module")
def unpacked(dist, tmp_path_factory):
    folder = tmp_path_factory.mktemp("unpacked")
    (wheel,) = dist.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


@pytest.mark.slow
def test_the_wheel_holds_the_package_with_its_data_and_nothing_else(unpacked):
    inside = {path.relative_to(unpacked).as_posix() for path in unpacked.rglob("*") if path.is_file()}
    expected = {
        path.relative_to(ROOT / "src").as_posix()
        for path in PACKAGE.rglob("*") if path.is_file() and path.suffix in DATA
    }  # fmt: skip
    assert {name for name in inside if not name.startswith(f"dudmap-{dudmap.__version__}.dist-info/")} == expected
    assert "dudmap/app/viewing/page/three.min.js" in inside
    assert f"dudmap-{dudmap.__version__}.dist-info/licenses/LICENSE" in inside


@pytest.mark.slow
def test_the_sdist_holds_what_its_tests_need_and_no_results(dist):
    (sdist,) = dist.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames()}
    assert {"pyproject.toml", "LICENSE", "Makefile", "tests/test_docs.py", "docs/conf.py", "README.md"} <= inside
    assert not [name for name in inside if name.startswith(("runs/", ".venv/", "dist/", "docs/_build/"))]


def test_the_citation_is_complete_and_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors", "type", "license"} <= set(citation)  # the schema wants these
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == dudmap.__version__
    assert citation["license"] == "MIT"
    for work in (citation, *citation["references"]):
        assert work["title"]
        assert all("name" in author or {"family-names", "given-names"} <= set(author) for author in work["authors"])
    doi = next(work["doi"] for work in citation["references"] if work["type"] == "article")
    assert f"https://doi.org/{doi}" in (ROOT / "README.md").read_text(encoding="utf-8")


def test_hooks_use_the_locked_tools():
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    locked = (ROOT / "requirements" / "dev.txt").read_text(encoding="utf-8")
    for repository in hooks["repos"]:
        assert repository["repo"] == "local"
        for hook in repository["hooks"]:
            tool = re.match(r"\.venv/bin/(\w+)", hook["entry"])
            assert tool is not None
            assert re.search(rf"^{tool[1]}==", locked, flags=re.MULTILINE)


def test_the_workflow_pins_its_actions_and_calls_what_is_documented():
    release, text = (
        (ROOT / ".github" / "workflows" / name).read_text(encoding="utf-8") for name in ("release.yml", "ci.yml")
    )
    assert "run: make package\n" in release
    for used in re.findall(r"uses: (.*)", release + text):
        assert re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40} # v[\d.]+", used)
    commands = [step["run"] for step in yaml.safe_load(text)["jobs"]["test"]["steps"] if "run" in step]
    assert commands == [".ci/run", "make docs", "make package"]
    for target in re.findall(r"^make ([\w-]+)", (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"), re.MULTILINE):
        assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE)
