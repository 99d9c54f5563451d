"""State that a system keeps between frames, and from which a checkpoint is made.

Long-lived objects are ``Stateful``: attributes marked as ``Remembered`` in the class body are the state. Back ends,
threads, caches and values derived from the configuration are not. Remembered attributes are plain values, arrays, and
dataclasses and named tuples of them. Their annotations define how they are stored and read (``app/state/tree.py``).
"""

from functools import cache
from typing import Annotated, Any, TypeVar, get_origin, get_type_hints

_Type = TypeVar("_Type")
_MARK = "remembered"
Remembered = Annotated[_Type, _MARK]
CACHE = {"state": False}
"""Metadata of a dataclass field that is derived from other fields and not part of the state."""


class Stateful:
    """Keeps state between frames."""

    def state(self) -> dict[str, Any]:
        """The remembered attributes by name; waits for attributes that a thread computes."""
        return {name: getattr(self, name) for name in remembered(type(self))}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from the state of another object with the same arguments."""
        for name in remembered(type(self)):
            setattr(self, name, state[name])


@cache
def remembered(cls: type) -> dict[str, Any]:
    """Type by name of the remembered attributes of a class."""
    hints = get_type_hints(cls, include_extras=True)
    marked = {name: hint for name, hint in hints.items() if get_origin(hint) is Annotated}
    return {name: hint.__origin__ for name, hint in marked.items() if _MARK in hint.__metadata__}
