"""The table of elements of the thesis, docs/thesis-elements.csv: each place and each test exists."""

import csv
import re
from pathlib import Path

import pytest

import dudmap

TABLE = Path(__file__).parents[2] / "docs" / "thesis-elements.csv"
SOURCE, TESTS = Path(dudmap.__file__).parent, Path(__file__).parents[1]
VERDICTS = ("full", "differs", "project", "hardware")


def rows():
    with TABLE.open(encoding="utf-8", newline="") as file:
        return [tuple(row) for row in csv.reader(file)][1:]


def resolved(root, place):
    """Whether a file or folder exists and defines the function, method, parameter or test that follows the colon."""
    file, _, name = place.partition(":")
    path = root / file
    if not name or not path.is_file():
        return path.exists() and not name
    return re.search(rf"^\s*(def {name}\(|{name}: )", path.read_text(encoding="utf-8"), flags=re.MULTILINE) is not None


def test_the_audit_has_all_elements():
    assert len(rows()) >= 55
    assert len({element for element, *_ in rows()}) == len(rows())


@pytest.mark.parametrize(("element", "place", "test", "verdict"), rows(), ids=lambda text: text[:40])
def test_place_and_test_of_an_element_exist(element, place, test, verdict):
    assert resolved(SOURCE, place), place
    assert resolved(TESTS, test), test
    assert verdict.partition(":")[0] in VERDICTS
