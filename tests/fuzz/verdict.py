"""What a loader is, and what it may say."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Loader:
    """``write(folder)`` makes a valid input and returns its path; ``load(path)`` reads everything in it.

    With ``owns`` it may write into the folder, which links and files of others may lie in, and nowhere else.
    """

    write: Callable
    load: Callable
    owns: bool = False


def check_sentence(error):
    """One line of text that a person can read."""
    text = str(error)
    assert text
    assert len(text) < 4000
    assert text.isprintable(), f"not printable: {text!r}"
