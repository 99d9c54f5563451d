"""Data files of this package."""

import tomllib
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any, TypeVar

from dudmap.errors import ConfigError

Thing = TypeVar("Thing")


@cache
def tables(path: str) -> dict[str, Any]:
    """Tables of a TOML file, with tuples for lists; do not change them."""
    return _fixed(tomllib.loads(files("dudmap.lab").joinpath(path).read_text(encoding="utf-8")))


def _fixed(value: Any) -> Any:  # noqa: ANN401 - any value of a TOML file
    if isinstance(value, dict):
        return {key: _fixed(one) for key, one in value.items()}
    return tuple(map(_fixed, value)) if isinstance(value, list) else value


def find(name: str, known: Mapping[str, Thing], what: str) -> Thing:
    """Find a thing by name.

    Raises:
        ConfigError: The name is unknown.
    """
    if name not in known:
        raise ConfigError(f"unknown {what} {name!r}; known {what}s: {', '.join(known)}")
    return known[name]
