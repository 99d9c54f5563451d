"""Limits for the definitions of messages in a bag, of which the package rosbags makes Python code.

Names and constants get into this code as identifiers and literals only. What is limited here is its amount: fixed
arrays become a line per element, and the grammar of IDL is tried in all combinations for each pair of brackets.
"""

import re
from collections.abc import Callable, Mapping
from functools import lru_cache
from importlib import import_module
from typing import Any, cast

LARGEST_DEFINITION = 2**17
"""Largest definition of a message with all that it contains, characters; the parser of rosbags reads
50,000 to 100,000 a second."""
LARGEST_MESSAGE = 2**14
"""Largest number of fields that a message has without its sequences, counting the elements of arrays of messages and
text; a camera_info has 30, and numbers in an array count as one."""
DEEPEST_TYPE = 3
"""Angle brackets within each other in IDL; a sequence of text of a limited length has two."""
STRING = r'"(?:\\"|[^"])*+"'
IDL_TEXT = re.compile(
    rf"""{STRING}?|//[^\n]*|/\*(?:.*?\*/|.*)|@\w++\s*+\([^()"]*+(?:{STRING}[^()"]*+)*+\)""", re.DOTALL
)
"""Text, comments and annotations with their arguments, each also where its end is missing."""


def limit_definitions() -> None:
    """Make rosbags refuse definitions that are too large, and read equal ones only once."""
    reader = cast("Any", import_module("rosbags.highlevel.anyreader"))
    if hasattr(reader.get_typestore, "unlimited"):
        return
    parse_msg, parse_idl, typestore = reader.get_types_from_msg, reader.get_types_from_idl, reader.get_typestore
    reader.get_types_from_msg = lru_cache(maxsize=256)(_of_limited_text(parse_msg, _check_text))
    reader.get_types_from_idl = lru_cache(maxsize=256)(_of_limited_text(parse_idl, _check_idl))
    reader.get_typestore = _limited_stores(typestore)


def _of_limited_text(parse: Callable[..., Any], check: Callable[[str], None]) -> Callable[..., Any]:
    def parsed(text: str, *name: str) -> Any:  # noqa: ANN401
        check(text)
        return parse(text, *name)

    return parsed


def _limited_stores(make: Callable[..., Any]) -> Callable[..., Any]:
    """``make`` with type stores that check what is added to them."""

    def limited(*arguments: Any) -> Any:  # noqa: ANN401
        store = make(*arguments)
        register = store.register

        def checked(types: Mapping[str, Any]) -> None:
            check_types(types)
            register(types)

        store.register = checked
        return store

    cast("Any", limited).unlimited = make
    return limited


def _check_text(text: str) -> None:
    """Check the length of a definition.

    Raises:
        ValueError: It is too long.
    """
    if len(text) > LARGEST_DEFINITION:
        raise ValueError(f"a definition has {len(text)} characters; expected {LARGEST_DEFINITION} or less")


def _check_idl(text: str) -> None:
    """Check a definition in IDL.

    Raises:
        ValueError: It is too long, or nested or computed as no generator writes it.
    """
    _check_text(text)
    plain = IDL_TEXT.sub(lambda found: " " if found[0][0] != '"' or found[0][1:].endswith('"') else '"', text)
    found = re.search(r'[("*]|<<', plain)
    if found:
        raise ValueError(f"a definition has {found[0]!r} outside of texts and comments; expected plain numbers")
    depth = 0
    for bracket in re.findall("[<>]", plain):
        depth += 1 if bracket == "<" else -1
        if depth > DEEPEST_TYPE:
            raise ValueError("a definition nests sequences more deeply than messages can")


def check_types(types: Mapping[str, Any]) -> None:
    """Check how large the messages of parsed definitions become.

    Raises:
        ValueError: A message has too many fields or contains itself.
    """
    sizes: dict[str, int] = {}
    for name in types:
        _size(name, types, sizes, ())


def _size(name: str, types: Mapping[str, Any], sizes: dict[str, int], within: tuple[str, ...]) -> int:
    """Number of fields of a message with those of the messages in it; a sequence counts as one element."""
    if name in within:
        raise ValueError(f"the message {name!r} contains itself")
    if name not in types:
        return 1
    if name not in sizes:
        total = 1 + sum(_field_size(field, types, sizes, (*within, name)) for _, field in types[name][1])
        if total > LARGEST_MESSAGE:
            raise ValueError(f"the message {name!r} has {total} fields; expected {LARGEST_MESSAGE} or less")
        sizes[name] = total
    return sizes[name]


def _field_size(field: Any, types: Mapping[str, Any], sizes: dict[str, int], within: tuple[str, ...]) -> int:  # noqa: ANN401
    from rosbags.interfaces import Nodetype

    kind, content = field
    if kind == Nodetype.NAME:
        return _size(content, types, sizes, within)
    if kind == Nodetype.BASE:
        return 1
    (inner, of), count = content
    numbers = inner == Nodetype.BASE and of[0] not in ("string", "wstring")
    one = 1 if numbers else _field_size((inner, of), types, sizes, within)
    return one * max(count, 1) if kind == Nodetype.ARRAY and not numbers else one
