"""Base class of the sections of the configuration."""

import difflib
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from dudmap.errors import ConfigError


class ConfigSection(BaseModel):
    """Immutable section that rejects unknown keys; docstrings of its fields describe them."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)

    def __init__(self, **values: Any) -> None:  # noqa: ANN401 - parameters have many types
        """Parameters by name.

        Raises:
            ConfigError: A key is unknown or a value invalid.
        """
        section = type(self).__name__.removesuffix("Config").lower()  # empty for the whole configuration
        prefix = f"{section}." if section else ""
        known = [prefix + name for name in type(self).model_fields]
        for name in values:
            check_key(prefix + name, known)
        try:
            super().__init__(**values)
        except ValidationError as error:
            first = error.errors()[0]
            key = prefix + ".".join(str(part) for part in first["loc"]) if first["loc"] else section or "configuration"
            raise ConfigError(f"{key} = {first['input']!r} is not acceptable: {first['msg']}") from None


def check_key(key: str, known: list[str]) -> None:
    """Refuse an unknown key.

    Raises:
        ConfigError: The key is unknown; the message names the nearest known one.
    """
    if key not in known:
        near = difflib.get_close_matches(key, known, n=1, cutoff=0.0)
        raise ConfigError(f"unknown configuration key {key!r}; the nearest known key is {near[0]!r}")
