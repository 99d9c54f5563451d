"""Experimental designs: which combinations of levels are run.

Every design comes from a library: factorial, Plackett-Burman (1946), central composite (Box and Wilson 1951) and
Box-Behnken (1960) designs from pyDOE3, Latin hypercubes and Sobol sequences from ``scipy.stats.qmc``, and the designs
of Saltelli (2010) and Morris (1991), from which their indices are computed without a model, from SALib.
"""

from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from dudmap.errors import ConfigError
from dudmap.lab.study.factors import Factor, Value

Coded = NDArray[np.float64]
Point = dict[str, Value]
"""Values of all factors by key."""
Kind = Literal[
    "full-factorial", "fractional-factorial", "plackett-burman", "central-composite", "box-behnken", "latin-hypercube",
    "sobol", "saltelli", "morris",
]  # fmt: skip
DESIGNS: tuple[str, ...] = get_args(Kind)
MORRIS_LEVELS = 4
"""Levels per factor of a Morris design; Morris (1991) and SALib take 4."""


class DesignOptions(BaseModel):
    """Table ``design`` of a design file.

    Attributes:
        kind: Name of the design.
        samples: Number of points of a Latin hypercube or Sobol sequence; base samples N of a Saltelli design, which has
            N (2 K + 2) points for K factors; trajectories N of a Morris design, which has N (K + 1) points.
        resolution: Resolution of a fractional factorial design.
        generators: Generators of a fractional factorial design such as ``a b c abc``, instead of a resolution.
        seed: Seed of a sampled design.
        foldover: Whether a Plackett-Burman design is followed by its mirror image, which makes the effects free of
            interactions of two factors.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Kind = Field("full-factorial", description=f"one of {', '.join(DESIGNS)}")
    samples: int = Field(64, ge=1)
    resolution: int = 4
    generators: str = ""
    seed: int = 0
    foldover: bool = True


def points_of(factors: Sequence[Factor], options: DesignOptions) -> list[Point]:
    """All points of a design, each once; those of Saltelli and Morris need every row for their indices.

    Raises:
        ConfigError: The design does not fit the factors.
    """
    kind = options.kind
    if kind == "full-factorial":
        found = _full_factorial(factors)
    elif kind in ("fractional-factorial", "plackett-burman"):
        ends = [(f.value(-1), f.value(1)) if f.numeric else (f.levels[0], f.levels[-1]) for f in factors]
        rows = (_fractional if kind == "fractional-factorial" else _plackett_burman)(factors, options)
        found = [{f.key: end[int(x > 0)] for f, end, x in zip(factors, ends, row, strict=True)} for row in rows]
    else:
        words = [factor.key for factor in factors if not factor.numeric]
        if words:
            raise ConfigError(f"a {kind} design needs numbers, but {words[0]} has levels that are none")
        rows = (_response_surface if kind in ("central-composite", "box-behnken") else _sampled)(factors, options)
        found = [{f.key: f.value(float(x)) for f, x in zip(factors, row, strict=True)} for row in rows]
    if kind in ("saltelli", "morris"):
        return found
    return [point for number, point in enumerate(found) if point not in found[:number]]


def count_of(factors: Sequence[Factor], options: DesignOptions) -> int:
    """Number of points of a design, without making those of one that can be large."""
    if options.kind == "full-factorial":
        return int(np.prod([max(len(factor.levels), 1) for factor in factors], dtype=object))
    by_kind = {
        "latin-hypercube": options.samples,
        "sobol": options.samples,
        "saltelli": options.samples * (2 * len(factors) + 2),
        "morris": options.samples * (len(factors) + 1),
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


def _fractional(factors: Sequence[Factor], options: DesignOptions) -> Coded:
    from pyDOE3 import fracfact, fracfact_by_res

    given, count = options.generators, len(factors)
    try:
        rows = np.asarray(fracfact(given) if given else fracfact_by_res(count, options.resolution))
    except ValueError as error:
        raise ConfigError(f"no fractional factorial design for {count} factors: {error}") from None
    if rows.shape[1] != count:
        raise ConfigError(f"the generators {given!r} make {rows.shape[1]} columns for {count} factors")
    return rows


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


def _response_surface(factors: Sequence[Factor], options: DesignOptions) -> Coded:
    from pyDOE3 import bbdesign, ccdesign

    count, composite = len(factors), options.kind == "central-composite"
    if count < (2 if composite else 3):
        raise ConfigError(f"a {options.kind} design needs {'two' if composite else 'three'} factors or more")
    return np.asarray(ccdesign(count, center=(0, 1), face="faced") if composite else bbdesign(count, center=1))


def _sampled(factors: Sequence[Factor], options: DesignOptions) -> Coded:
    from SALib.sample import morris, sobol
    from scipy.stats.qmc import LatinHypercube, Sobol

    kind, samples, rng = options.kind, options.samples, np.random.default_rng(options.seed)
    if kind in ("sobol", "saltelli") and samples & (samples - 1):
        raise ConfigError(f"a {kind} design has {samples} samples; expected a power of two")
    if kind == "latin-hypercube":
        return 2 * LatinHypercube(len(factors), rng=rng).random(samples) - 1
    if kind == "sobol":
        return 2 * Sobol(len(factors), rng=rng).random_base2(samples.bit_length() - 1) - 1
    if kind == "saltelli":
        return sobol.sample(problem(factors), samples, calc_second_order=True, seed=options.seed)
    return morris.sample(problem(factors), samples, num_levels=MORRIS_LEVELS, seed=options.seed)


def problem(factors: Sequence[Factor]) -> dict[str, Any]:
    """The factors in coded units, as SALib wants them."""
    names = [factor.name for factor in factors]
    return {"num_vars": len(factors), "names": names, "bounds": [[-1.0, 1.0]] * len(factors)}
