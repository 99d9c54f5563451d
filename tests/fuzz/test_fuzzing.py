"""A few hundred random hostile files, those that were found before, and the harness itself."""

import re
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from loaders import LOADERS
from trial import Finding, Subject, TooSlow

import layouts
from dudmap.errors import DatasetError
from dudmap.io.sequences import reader_of, readers

CORPUS = Path(__file__).parent / "corpus"


def slug(name):
    return re.sub(r"\W+", "-", name)


@pytest.mark.parametrize("name", LOADERS)
def test_random_inputs(name, subjects):
    """The same inputs in every run; ``make fuzz`` reads many more."""
    subject = subjects(name)
    subject.warm_up()

    @settings(
        max_examples=12, deadline=None, database=None, derandomize=True,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(st.integers(0, 2**32))
    def read(seed):
        subject.trial(seed)

    read()


def test_every_reader_has_an_input(tmp_path):
    """Every reader takes an input, whose frames the tests of its format compare with the written ones."""
    tested = set()
    for layout in layouts.LAYOUTS:
        tested.add(reader_of(layouts.write(layout, tmp_path / layout.__name__)[0]))
    for name in ("klg", "sens", "record3d", "Azure Kinect", "bag of ROS 1", "RealSense file"):
        folder = tmp_path / f"file {name}"
        folder.mkdir()
        tested.add(reader_of(LOADERS[name].write(folder)))
    assert [reader.__name__ for reader in readers() if reader not in tested] == []


CASES = sorted(path for path in CORPUS.glob("*/*"))


@pytest.mark.parametrize("case", CASES, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_found_cases(case, subjects):
    """Files that made a loader fail before it was mended."""
    name = next(name for name in LOADERS if slug(name) == case.parent.name)
    subject = subjects(name)
    try:
        for file in case.rglob("*"):
            if file.is_file():
                (subject.home / file.relative_to(case)).write_bytes(file.read_bytes())
        subject.read()
    finally:
        subject.restore()


def test_there_are_found_cases():
    assert len(CASES) > 20


class Wrong:
    """Loaders that do what they must not do."""

    @staticmethod
    def fails(path):
        raise ZeroDivisionError

    @staticmethod
    def hangs(path):
        time.sleep(60)

    @staticmethod
    def writes(path):
        (path.parent / "left-behind").write_text("")

    @staticmethod
    def mumbles(path):
        error = DatasetError("")
        error.args = ("two\nlines",)
        raise error


@pytest.mark.parametrize("way", ["fails", "hangs", "writes", "mumbles"])
def test_the_harness_finds_what_it_looks_for(way, tmp_path, monkeypatch):
    import trial

    monkeypatch.setattr(trial, "SECONDS", 0.2)
    monkeypatch.setenv("DUDMAP_CACHE", str(tmp_path))
    subject = Subject("trajectory", tmp_path / "a")
    object.__setattr__(subject, "loader", type(subject.loader)(subject.loader.write, getattr(Wrong, way)))
    with pytest.raises((Finding, AssertionError)):
        subject.read()


def test_too_slow_cannot_be_swallowed():
    assert not issubclass(TooSlow, Exception)
