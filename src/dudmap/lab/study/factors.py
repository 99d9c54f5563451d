"""Factors of a study: configuration keys with levels or a range."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config, keys
from dudmap.errors import ConfigError

Value = float | int | bool | str | list[Any]
"""Value of a configuration key."""
Table = Any
"""A pandas DataFrame or Series. Type checkers cannot follow which of its many types an expression of pandas has."""


@dataclass(frozen=True)
class Factor:
    """One factor: a configuration key with its levels, or with a range.

    A coded value is -1 at the low end of the range and +1 at the high end.

    Attributes:
        key: Configuration key, such as ``volume.voxel_size``.
        levels: The levels in the order given; empty for a range.
        low: Low end of the range, or the smallest level; NaN if the levels are no numbers.
        high: High end of the range, or the largest level; NaN if the levels are no numbers.
        scale: Whether the coded value is linear in the value or in its logarithm.
        whole: Whether the key takes whole numbers only.
    """

    key: str
    levels: tuple[Value, ...] = ()
    low: float = float("nan")
    high: float = float("nan")
    scale: Literal["linear", "log"] = "linear"
    whole: bool = False

    @property
    def numeric(self) -> bool:
        """Whether the factor has a low and a high end."""
        return bool(np.isfinite(self.low))

    @property
    def name(self) -> str:
        """The key without its section."""
        return self.key.rpartition(".")[2]

    def coded(self, values: Any) -> NDArray[np.float64]:  # noqa: ANN401 - a number or an array
        """Coded values of values in the units of the key."""
        low, high, values = self._transformed(self.low), self._transformed(self.high), self._transformed(values)
        return (values - (low + high) / 2) / ((high - low) / 2)

    def value(self, coded: float) -> float | int:
        """Value in the units of the key, inside the range; a whole number where the key needs one."""
        low, high = self._transformed(self.low), self._transformed(self.high)
        number = float((low + high) / 2 + coded * (high - low) / 2)
        number = float(np.exp(number)) if self.scale == "log" else number
        number = min(max(number, self.low), self.high)
        return round(number) if self.whole else float(f"{number:.12g}")

    def _transformed(self, value: Any) -> NDArray[np.float64]:  # noqa: ANN401
        return np.log(np.asarray(value, float)) if self.scale == "log" else np.asarray(value, float)


def is_number(value: object) -> bool:
    """Whether a value of a TOML file is a number."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def configured(base: Config, values: Mapping[str, Value]) -> Config:
    """Configuration ``base`` with the values of some keys.

    Raises:
        ConfigError: A key is unknown or a value invalid.
    """
    return base.override([f"{key}={json.dumps(value)}" for key, value in values.items()])


def make_factor(key: str, given: object, base: Config) -> Factor:
    """Factor of one line of a design file.

    Args:
        key: Configuration key.
        given: A list of levels, or a table with ``levels`` or ``range`` and, optionally, ``scale``.
        base: Configuration of the other keys, with which every level must be valid.

    Raises:
        ConfigError: The key is unknown, the table malformed, or a level outside the range of the parameter.
    """
    table = {"levels": given} if isinstance(given, list) else given
    if not isinstance(table, dict) or len({"levels", "range"} & set(table)) != 1:
        raise ConfigError(f"factor {key} is {given!r}; expected a list of levels, or range = [low, high]")
    scale, values = table.get("scale", "linear"), table.get("levels", table.get("range"))
    if set(table) - {"levels", "range", "scale"} or scale not in ("linear", "log"):
        raise ConfigError(f"factor {key} is {given!r}; known are levels, range and scale = linear or log")
    if not isinstance(values, list) or len(values) < 2 or any(value in values[:n] for n, value in enumerate(values)):
        raise ConfigError(f"factor {key} has {values!r}; expected two or more different values")
    if key not in keys():
        configured(base, {key: values[0]})  # names the nearest known key
    numeric, is_range = all(map(is_number, values)), "range" in table
    if is_range and (not numeric or len(values) != 2 or values[0] >= values[1]):
        raise ConfigError(f"factor {key} has range {values!r}; expected two growing numbers")
    low, high = (float(min(values)), float(max(values))) if numeric else (float("nan"), float("nan"))
    if scale == "log" and not low > 0:
        raise ConfigError(f"factor {key} has the scale log and the values {values!r}; expected numbers above 0")
    whole = numeric and type(attrgetter(key)(base)) is int
    if whole and any(value != round(value) for value in values):
        raise ConfigError(f"factor {key} has {values!r}; it takes whole numbers only")
    for value in values:
        configured(base, {key: value})
    return Factor(key, () if is_range else tuple(values), low, high, scale, whole)


def make_factors(table: Mapping[str, object], base: Config) -> tuple[Factor, ...]:
    """Factors of the table ``factors`` of a design file, whose keys are quoted or nested.

    ``all_numeric`` adds every numeric key (``numeric_factors``).

    Raises:
        ConfigError: There is none, or one is invalid.
    """
    from dudmap.lab.study.screening import numeric_factors

    flat: dict[str, object] = {}
    for key, given in table.items():
        nested = isinstance(given, dict) and key != "all_numeric" and not {"levels", "range"} & set(given)
        flat |= {f"{key}.{name}": inner for name, inner in given.items()} if nested else {key: given}  # type: ignore[union-attr]
    everything = flat.pop("all_numeric", None)
    chosen = tuple(make_factor(key, given, base) for key, given in flat.items())
    if "all_numeric" in table:
        chosen += numeric_factors(everything, base, flat)
    if not chosen:
        raise ConfigError('the design has no factors; expected, for example, [factors] "tracker.huber" = [0.005, 0.01]')
    return chosen


def coded_points(factors: Sequence[Factor], points: Table) -> NDArray[np.float64]:
    """(N, K) coded values of a table of N points with K numeric factors."""
    return np.column_stack([factor.coded(points[factor.key]) for factor in factors])
