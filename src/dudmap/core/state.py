"""State that a system keeps between frames, for checkpoints.

Attributes marked as ``Remembered`` in a ``Stateful`` class are the state: plain values, arrays, dataclasses, named
tuples. Their annotations define how they are stored (``app/state/tree.py``). Back ends, threads, caches and derived
values are no state.
"""

from functools import cache
from typing import Annotated, Any, TypeVar, get_origin, get_type_hints

_Type = TypeVar("_Type")
_MARK = "remembered"
Remembered = Annotated[_Type, _MARK]
CACHE = {"state": False}
"""Metadata of a dataclass field that is no state."""


class Stateful:
    """Keeps state between frames."""

    def state(self) -> dict[str, Any]:
        """Remembered attributes by name; waits for attributes that a thread computes."""
        return {name: getattr(self, name) for name in remembered(type(self))}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from the state of an object with the same arguments."""
        for name in remembered(type(self)):
            setattr(self, name, state[name])


@cache
def remembered(cls: type) -> dict[str, Any]:
    """Types of a class's remembered attributes by name."""
    hints = get_type_hints(cls, include_extras=True)
    marked = {name: hint for name, hint in hints.items() if get_origin(hint) is Annotated}
    return {name: hint.__origin__ for name, hint in marked.items() if _MARK in hint.__metadata__}
