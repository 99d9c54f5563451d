"""Factors of a study (keys with levels or a range), and designs. Errors raise a ``ConfigError``."""

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from dudmap.config import Config, keys
from dudmap.errors import ConfigError

Value = float | int | bool | str | list[Any]
Table = Any
"""A pandas DataFrame or Series, which type checkers cannot follow."""


@dataclass(frozen=True)
class Factor:
    """A configuration key with its levels or its range.

    Attributes:
        levels: As given; empty for a range.
        low, high: Coded -1 and +1: ends of the range, or extreme levels; NaN without numbers.
        scale: Linear in the value or its logarithm.
    """

    key: str
    levels: tuple[Value, ...] = ()
    low: float = float("nan")
    high: float = float("nan")
    scale: Literal["linear", "log"] = "linear"
    whole: bool = False

    @property
    def numeric(self) -> bool:
        """Whether the factor has two ends."""
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
        """Value inside the range in the key's units, rounded for whole numbers."""
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
    """Configuration ``base`` with the values of some keys."""
    return base.override([f"{key}={json.dumps(value)}" for key, value in values.items()])


def make_factor(key: str, given: object, base: Config) -> Factor:
    """Factor of a line of a design file: levels, or a table with ``levels`` or ``range``, and ``scale``."""
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
    """Factors of the table ``factors``; ``all_numeric`` adds ``numeric_factors``."""
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


Coded = NDArray[np.float64]
Point = dict[str, Value]
Kind = Literal[
    "full-factorial", "plackett-burman", "central-composite", "latin-hypercube",
]  # fmt: skip
DESIGNS: tuple[str, ...] = get_args(Kind)


class DesignOptions(BaseModel):
    """Table ``design`` of a design file.

    Attributes:
        samples: Points of a Latin hypercube.
        foldover: Append the mirror image of a Plackett-Burman design, which frees effects of two-factor interactions.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Kind = Field("full-factorial", description=f"one of {', '.join(DESIGNS)}")
    samples: int = Field(64, ge=1)
    seed: int = 0
    foldover: bool = True


def points_of(factors: Sequence[Factor], options: DesignOptions) -> list[Point]:
    """All points of a design, each once."""
    kind = options.kind
    if kind == "full-factorial":
        return _full_factorial(factors)
    if kind == "plackett-burman":
        ends = [(f.value(-1), f.value(1)) if f.numeric else (f.levels[0], f.levels[-1]) for f in factors]
        rows = _plackett_burman(factors, options)
        return [{f.key: end[int(x > 0)] for f, end, x in zip(factors, ends, row, strict=True)} for row in rows]
    words = [factor.key for factor in factors if not factor.numeric]
    if words:
        raise ConfigError(f"a {kind} design needs numbers, but {words[0]} has levels that are none")
    rows = (_central_composite if kind == "central-composite" else _latin_hypercube)(factors, options)
    found: list[Point] = [{f.key: f.value(float(x)) for f, x in zip(factors, row, strict=True)} for row in rows]
    return [point for number, point in enumerate(found) if point not in found[:number]]


def count_of(factors: Sequence[Factor], options: DesignOptions) -> int:
    """Points of a design, without creating it."""
    if options.kind == "full-factorial":
        return int(np.prod([max(len(factor.levels), 1) for factor in factors], dtype=object))
    by_kind = {
        "latin-hypercube": options.samples,
        "central-composite": 2 ** len(factors) + 2 * len(factors) + 1,
    }
    return by_kind[options.kind] if options.kind in by_kind else len(points_of(factors, options))


def _full_factorial(factors: Sequence[Factor]) -> list[Point]:
    from pyDOE3 import fullfact

    ranges = [factor.key for factor in factors if not factor.levels]
    if ranges:
        raise ConfigError(f"a full-factorial design needs levels, but {ranges[0]} has a range")
    rows = fullfact([len(factor.levels) for factor in factors]).astype(int)
    return [{f.key: f.levels[n] for f, n in zip(factors, row, strict=True)} for row in rows]


def _plackett_burman(factors: Sequence[Factor], options: DesignOptions) -> Coded:
    from pyDOE3 import pbdesign

    for factor in factors:
        if len(factor.levels) > 2:
            count = len(factor.levels)
            raise ConfigError(f"a plackett-burman design has two levels, but {factor.key} has {count}; give it a range")
    runs = 4 * (len(factors) // 4 + 1)
    while True:  # pyDOE3 knows the sizes 2^n, 12 2^n and 20 2^n
        try:
            rows = np.asarray(pbdesign(runs - 1))[:, : len(factors)]
            break
        except AssertionError:
            runs += 4
    return np.vstack([rows, -rows]) if options.foldover else rows


def _central_composite(factors: Sequence[Factor], options: DesignOptions) -> Coded:
    from pyDOE3 import ccdesign

    if len(factors) < 2:
        raise ConfigError("a central-composite design needs two factors or more")
    return np.asarray(ccdesign(len(factors), center=(0, 1), face="faced"))


def _latin_hypercube(factors: Sequence[Factor], options: DesignOptions) -> Coded:
    from scipy.stats.qmc import LatinHypercube

    return 2 * LatinHypercube(len(factors), rng=np.random.default_rng(options.seed)).random(options.samples) - 1


def numeric_factors(given: object, base: Config, chosen: Collection[str] = ()) -> tuple[Factor, ...]:
    """Every numeric key as a factor, divided and multiplied by a ratio.

    - Ends stay inside the bounds; at an exclusive bound halfway.
    - A whole number changes by 1 at least.
    - Elements of a list change together.
    - Keys of value 0, ``chosen``, or in the table (``ratio``, ``without``) are skipped.
    """
    if not isinstance(given, dict) or set(given) - {"ratio", "without"}:
        raise ConfigError(f"all_numeric is {given!r}; expected, for example, all_numeric = {{ ratio = 1.5 }}")
    ratio, without = given.get("ratio", 1.5), given.get("without", [])
    if not is_number(ratio) or not ratio > 1:
        raise ConfigError(f"ratio of all_numeric is {ratio!r}; expected a number above 1")
    if not isinstance(without, list):
        raise ConfigError(f"without of all_numeric is {without!r}; expected a list of configuration keys")
    for key in without:
        if key not in keys():
            raise ConfigError(f"all_numeric leaves out {key!r}, which is no configuration key")
    out = []
    for key in keys():
        value = attrgetter(key)(base)
        foreign = key.startswith("thesis.") != (base.system == "thesis")
        if key in without or key in chosen or foreign:
            continue
        if isinstance(value, tuple):
            ends = [[_scaled(element, factor) for element in value] for factor in (1 / ratio, ratio)]
            out.append(Factor(key, tuple(ends)))
        elif isinstance(value, int | float) and not isinstance(value, bool) and value != 0:
            low, high = _ends(key, value, ratio)
            whole = isinstance(value, int)
            out.append(Factor(key, (), low, high, "linear" if whole or low <= 0 else "log", whole))
    return tuple(out)


def _ends(key: str, value: float, ratio: float) -> tuple[float, float]:
    low, high = sorted((_scaled(value, 1 / ratio), _scaled(value, ratio)))
    if isinstance(value, int):
        low, high = min(low, value - 1), max(high, value + 1)
    bounds = bounds_of(key)
    low = max(low, bounds.get("ge", low))
    high = min(high, bounds.get("le", high))
    if low <= bounds.get("gt", -np.inf):
        low = (value + bounds["gt"]) / 2
    if high >= bounds.get("lt", np.inf):
        high = (value + bounds["lt"]) / 2
    return float(low), float(high)


def _scaled(value: float, factor: float) -> float:
    return max(round(value * factor), 1) if isinstance(value, int) else float(f"{value * factor:.6g}")


def bounds_of(key: str) -> dict[str, float]:
    """Bounds of a numeric key: ``ge``, ``gt``, ``le``, ``lt``."""
    section, _, name = key.rpartition(".")
    found = type(getattr(Config(), section)).model_fields[name].metadata
    return {kind: getattr(item, kind) for item in found for kind in ("ge", "gt", "le", "lt") if hasattr(item, kind)}
