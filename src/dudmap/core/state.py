"""What is remembered from frame to frame: the state of a system, of which a checkpoint is made.

An object that lives as long as the system is a ``Stateful``: it marks the attributes that it remembers as
``Remembered`` in the body of its class, and nothing else of it is part of the state. Back ends, threads, caches and
what the constructor derives from the configuration are not. What these attributes hold are plain values, arrays, and
dataclasses and named tuples of them: their annotations say how they are stored and read (``app/state/tree.py``).
"""

from functools import cache
from typing import Annotated, Any, TypeVar, get_origin, get_type_hints

_Type = TypeVar("_Type")
_MARK = "remembered"
Remembered = Annotated[_Type, _MARK]
"""Annotation of an attribute that is part of the state."""
CACHE = {"state": False}
"""Metadata of a field of a dataclass that follows from the others: it is no part of the state."""


class Stateful:
    """Remembers something from frame to frame."""

    def state(self) -> dict[str, Any]:
        """The remembered attributes by name; those that a thread is computing are waited for."""
        return {name: getattr(self, name) for name in remembered(type(self))}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from the state of another object that was made with the same arguments."""
        for name in remembered(type(self)):
            setattr(self, name, state[name])


@cache
def remembered(cls: type) -> dict[str, Any]:
    """Type by name of the attributes that objects of a class remember."""
    hints = get_type_hints(cls, include_extras=True)
    marked = {name: hint for name, hint in hints.items() if get_origin(hint) is Annotated}
    return {name: hint.__origin__ for name, hint in marked.items() if _MARK in hint.__metadata__}
