"""Measured figures of the docs name the commit they were measured on, and those of older code are marked as such."""

import re
import subprocess
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = sorted((ROOT / "docs").glob("*.md"))
CODE = ["src/dudmap/core", "src/dudmap/lab", "src/dudmap/io/exporting"]  # what can alter a figure
FIGURE = re.compile(r"(?<=\|) *\**(?:<= )?\d[\d.,; /%*()-]*(?: (?:ms|s|mm|cm|deg|lost|KB))?[\d.,; /%*()-]*(?=\|)")
COMMIT = re.compile(r"`([0-9a-f]{7,8})`")


@cache
def git(*arguments):
    """What git says; None without git, or without the whole history."""
    try:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def citations():
    """Commits that figures are of, but for those of what was tried once and dropped."""
    for page in PAGES:
        if page.stem == "design-notes":
            continue
        for commit in sorted(set(COMMIT.findall(page.read_text(encoding="utf-8")))):
            yield pytest.param(commit, id=f"{page.stem}-{commit}")


def tables():
    """Every table of figures and the section that introduces it."""
    for page in PAGES:
        for section in re.split(r"^#+ ", page.read_text(encoding="utf-8"), flags=re.MULTILINE):
            head = section.partition("\n")[0]
            rows = [line for line in section.splitlines() if line.startswith("|")]
            if any(len(FIGURE.findall(row)) > 1 for row in rows):
                yield pytest.param(section, id=f"{page.stem}-{head}")


@pytest.mark.parametrize("section", tables())
def test_a_table_of_figures_names_its_commit(section):
    assert COMMIT.search(section), "name the commit the table was measured on"


@pytest.mark.parametrize("commit", citations())
def test_figures_are_of_the_code_as_it_is(commit):
    """Figures of older code are expected failures, whose reason says how many changes they have missed."""
    if git("rev-parse", "--is-shallow-repository") != "false":
        pytest.skip("needs git and the whole history")
    assert git("merge-base", "--is-ancestor", commit, "HEAD") is not None, "no commit of this history"
    missed = len(git("rev-list", f"{commit}..HEAD", "--", *CODE).splitlines())
    if missed:
        pytest.xfail(f"{missed} later changes of the code that can alter it")
