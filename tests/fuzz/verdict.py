"""What a loader is, and what it may say."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Loader:
    """``write(folder)`` makes a valid input and returns its path; ``load(path)`` reads everything in it."""

    write: Callable
    load: Callable


def check_sentence(error):
    """One line of text that a person can read."""
    text = str(error)
    assert text
    assert len(text) < 4000
    assert text.isprintable(), f"not printable: {text!r}"
