"""Numbers in image names that pair colour and depth."""

import re
from collections.abc import Iterator
from itertools import chain, pairwise
from pathlib import Path

import numpy as np

from dudmap.core.geometry.association import associate
from dudmap.core.geometry.times import time_unit

NUMBER = r"\d+(?:\.\d+)?"
"""A number in a name, with decimals."""
LARGEST_NUMBER = 10**8
"""Larger numbers are times: 38 days at 30 Hz."""
LARGEST_SECONDS = 10**11
"""Largest time since 1970, seconds; larger numbers have smaller units."""
Keys = tuple[list[float], list[float]]


def last_number(file: Path) -> float:
    """Last number in a file's name."""
    return float(re.findall(NUMBER, file.stem)[-1])


def keys(colors: list[Path], depths: list[Path]) -> Keys:
    """Numbers by which most images pair: ``<seconds>_<fraction>``, the last number, an earlier one, or the rank in the
    order of all."""
    best, most = None, -1
    for found in _kinds_of_keys(colors, depths):
        count = _count(found)
        if count > most:
            best, most = found, count
        if count == min(len(colors), len(depths)):
            break
    assert best is not None
    return best


def count_pairs(colors: list[Path], depths: list[Path]) -> int:
    """Number of image pairs."""
    return _count(keys(colors, depths))


def are_times(found: Keys) -> bool:
    """Whether numbers are times: large or decimal."""
    values = np.concatenate(found)
    return bool(max(found[0]) >= LARGEST_NUMBER or np.any(values != np.floor(values)))


def _count(found: Keys) -> int:
    if not are_times(found):
        return len(set(found[0]) & set(found[1]))
    first, second = (np.sort(numbers) / time_unit(numbers).per_second for numbers in found)
    return len(associate(first, second))


def _kinds_of_keys(colors: list[Path], depths: list[Path]) -> Iterator[Keys]:
    rows = [[re.findall(NUMBER, file.stem) for file in files] for files in (colors, depths)]
    count = min(len(row) for kind in rows for row in kind)
    columns = [[[row[-k] for row in kind] for kind in rows] for k in range(1, count + 1)]
    for fractions, whole in pairwise(columns):
        if all(map(_is_second, chain(*whole))) and all(text.isdigit() for text in chain(*fractions)):
            digits = next((n for n in (3, 6) if max(map(len, chain(*fractions))) <= n), 9)
            first, second = (
                [int(a) + int(b) / 10**digits for a, b in zip(*kind, strict=True)]
                for kind in zip(whole, fractions, strict=True)
            )
            yield first, second
    for column in columns:
        first, second = ([float(text) for text in kind] for kind in column)
        if len(set(first)) == len(first) and len(set(second)) == len(second):
            yield first, second
    names = [[tuple(map(float, row[-count:])) for row in kind] for kind in rows]
    places = {name: float(place) for place, name in enumerate(sorted({*names[0], *names[1]}))}
    yield [places[name] for name in names[0]], [places[name] for name in names[1]]


def _is_second(text: str) -> bool:
    return text.isdigit() and LARGEST_NUMBER <= int(text) < LARGEST_SECONDS
