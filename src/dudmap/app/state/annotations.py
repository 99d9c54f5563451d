"""Interpret annotations of attributes: storage and allowed values."""

import types
from collections.abc import Callable, Iterable
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

PLAIN = bool, int, float, str
NUMBERS = {
    bool: (bool, np.bool_),
    int: (int, np.integer, np.bool_),
    float: (int, float, np.integer, np.floating),
}
RECORD = dict[str, Any]


@cache
def content_type(hint: Any) -> tuple[Any, tuple[Any, ...]]:  # noqa: ANN401
    """Class and arguments of an annotation; ``object`` for plain values; of a union, the member that is neither None
    nor plain.

    Raises:
        TypeError: There are several such members, or the annotation is ``Any``.
    """
    kind, parts = get_origin(hint) or hint, get_args(hint)
    if kind is Annotated:
        return content_type(parts[0])
    if kind in (Union, types.UnionType):
        members = {content_type(part) for part in parts} - {(object, ())}
        if len(members) > 1:
            raise TypeError(f"the annotation {hint} is ambiguous")
        return members.pop() if members else (object, ())
    if kind is Any:
        raise TypeError("an annotation allows for anything")
    if kind is Callable:
        return kind, parts[-1:]  # the annotation of the result
    return (object, ()) if kind in (*PLAIN, types.NoneType, Literal) else (kind, parts)


@cache
def fields_of(cls: type) -> dict[str, Any]:
    """Annotations of the fields of a dataclass or named tuple, without caches; empty for others."""
    if issubclass(cls, tuple):
        names: Iterable[str] = getattr(cls, "_fields", ())
    else:
        names = [one.name for one in fields(cls) if one.metadata.get("state", True)] if is_dataclass(cls) else ()
    hints = get_type_hints(cls) if names else {}
    return {name: hints[name] for name in names}


def is_frozen(cls: type) -> bool:
    """Whether the fields of a dataclass or named tuple are immutable."""
    return issubclass(cls, tuple) or getattr(cls, "__dataclass_params__").frozen  # noqa: B009 - not in the stubs


def item_hints(kind: Any, parts: tuple[Any, ...], count: int) -> list[Any]:  # noqa: ANN401
    """Annotation of each item of a tuple or another sequence.

    Raises:
        ValueError: The annotation has another number of items.
    """
    if kind is not tuple or parts[-1:] == (...,):
        return [parts[0]] * count
    if len(parts) != count:
        raise ValueError(f"found {count} values; expected {len(parts)}")
    return list(parts)


def fits(value: Any, hint: Any) -> bool:  # noqa: ANN401
    """Whether a value fits an annotation, without items of containers."""
    kind, parts = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, types.UnionType):
        return any(fits(value, part) for part in parts)
    if kind is Annotated:
        return fits(value, parts[0])
    if kind is Literal:
        return value in parts
    if kind in NUMBERS:
        return isinstance(value, NUMBERS[kind])
    if kind is np.ndarray and isinstance(value, np.ndarray) and len(parts) == 2:
        scalar = (get_args(parts[1]) or (Any,))[0]
        of_any_width = scalar if scalar is np.bool_ or not isinstance(scalar, type) else scalar.__mro__[1]
        return not isinstance(of_any_width, type) or np.issubdtype(value.dtype, of_any_width)
    return callable(value) if kind is Callable else isinstance(kind, type) and isinstance(value, kind)
