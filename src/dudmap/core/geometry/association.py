"""Lists of timed files, and their association by time."""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.times import SECONDS, TimeUnit, time_unit
from dudmap.errors import DatasetError
from dudmap.input_files import describe, read_text

LARGEST_GAP = 0.02
"""Largest time difference of a pair, seconds (TUM benchmark)."""


class TimedFile(NamedTuple):
    """One line of a list: time in seconds, place of the file, and the time unit of the list."""

    timestamp: float
    place: str | Path
    unit: TimeUnit = SECONDS

    @property
    def path(self) -> Path:
        """Path, built on access."""
        return Path(self.place)


FIELD = re.compile(r""""[^"]*"|'[^']*'|[^\s,]+""")
PLAIN = re.compile(r"""[^\s,"']+\s+[^\s,"']+""")


def read_rows(path: Path, columns: str, *, short: bool = False) -> list[tuple[int, list[str]]]:
    """Line numbers and fields of a text list.

    ``#`` starts a comment, commas count as blanks, and a first line without a digit is a header.

    Args:
        columns: Names of the fields, separated by blanks, e.g. ``timestamp file``.
        short: Whether to return shorter lines.

    Raises:
        DatasetError: The file cannot be read, or a line does not have these columns.
    """
    lines = _lines(path, columns, short=short)
    return [(number, line.replace(",", " ").split()) for number, line in lines]


def _lines(path: Path, columns: str, *, short: bool = False) -> Iterator[tuple[int, str]]:
    try:
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot read {path}: {describe(error)}") from error
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1)]
    lines = [(number, line) for number, line in lines if line.strip(", ") and not line.startswith("#")]
    rows = lines[1:] if len(lines) > 1 and not re.search(r"\d", lines[0][1]) else lines
    if not rows:
        raise DatasetError(f"{path} lists nothing; expected lines '{columns}'")
    fewest = len(columns.split())
    for number, line in rows:
        if not short and len(line.replace(",", " ").split()) < fewest:
            raise DatasetError(f"{path}, line {number}: expected '{columns}', found {line!r}")
        yield number, line


def read_list(path: Path) -> list[TimedFile]:
    """Files of a list ``timestamp file``, with paths relative to the list's folder and times in any unit of
    ``time_unit``.

    Raises:
        DatasetError: The list is unreadable, or its times are not finite and strictly increasing.
    """
    numbers, stamps, names = [], [], []
    for number, line in _lines(path, "timestamp file"):
        numbers.append(number)
        if PLAIN.fullmatch(line):  # nearly all lists, and ten times as fast
            stamp, name = line.split()
        else:
            first, *rest = FIELD.finditer(line)
            stamp, name = first.group(), _name(path, number, line, rest)
        stamps.append(parse_stamp(path, number, stamp))
        names.append(name)
    check_increasing(path, numbers, stamps)
    return _in_seconds(path, stamps, names)


def read_pairs(path: Path) -> list[tuple[TimedFile, TimedFile]]:
    """(colour, depth) files of an associations list ``t_rgb rgb_file t_depth depth_file``.

    Folder names decide the order. Times are in any unit of ``time_unit``.

    Raises:
        DatasetError: The list is unreadable, or its depth times are not finite and strictly increasing.
    """
    numbers, stamps, names = [], ([], []), ([], [])
    for number, line in _lines(path, "t_rgb rgb_file t_depth depth_file"):
        fields = list(FIELD.finditer(line))
        second = _second_stamp(path, number, line, fields)
        sides = [(fields[0], fields[1:second]), (fields[second], fields[second + 1 :])]
        if "depth" in _name(path, number, line, sides[0][1]) and "depth" not in _name(path, number, line, sides[1][1]):
            sides.reverse()
        numbers.append(number)
        for side, (stamp, rest) in enumerate(sides):
            stamps[side].append(parse_stamp(path, number, stamp.group()))
            names[side].append(_name(path, number, line, rest))
    check_increasing(path, numbers, stamps[1])
    return list(zip(*(_in_seconds(path, stamps[side], names[side]) for side in (0, 1)), strict=True))


def _second_stamp(path: Path, number: int, line: str, fields: list[re.Match[str]]) -> int:
    """Index of the second time in a row of two times and two names."""
    if len(fields) == 4:
        return 2
    places = [place for place in range(2, len(fields) - 1) if re.fullmatch(r"[-+.\deE]+", fields[place].group())]
    if not places:
        raise DatasetError(f"{path}, line {number}: expected 't_rgb rgb_file t_depth depth_file', found {line!r}")
    listed = (place for place in places if (path.parent / _name(path, number, line, fields[1:place])).is_file())
    return next(listed, places[0])


def _name(path: Path, number: int, line: str, fields: list[re.Match[str]]) -> str:
    if not fields:
        raise DatasetError(f"{path}, line {number}: expected the name of a file after its time, found {line!r}")
    name = fields[0].group()
    if len(name) > 1 and name[0] == name[-1] and name[0] in "\"'":
        return name[1:-1]
    whole = line[fields[0].start() : fields[-1].end()]
    return whole if len(fields) > 1 and (path.parent / whole).is_file() else name


def _in_seconds(path: Path, stamps: list[float], names: list[str]) -> list[TimedFile]:
    unit = time_unit(stamps)
    rows, folder = zip(stamps, names, strict=True), str(path.parent)
    return [TimedFile(stamp / unit.per_second, os.path.join(folder, name), unit) for stamp, name in rows]


def parse_stamp(path: Path, number: int, text: str) -> float:
    """A finite time, as written.

    Raises:
        DatasetError: The text is not a finite number.
    """
    try:
        stamp = float(text.strip("\"'"))
    except ValueError:
        stamp = np.nan
    if not np.isfinite(stamp):
        raise DatasetError(f"{path}, line {number}: the timestamp {text!r} is not a finite number")
    return stamp


def check_increasing(path: Path, numbers: list[int], stamps: list[float]) -> None:
    """Check that times increase from line to line.

    Raises:
        DatasetError: It names the first offending line.
    """
    wrong = np.flatnonzero(np.diff(stamps) <= 0)
    if len(wrong):
        k = int(wrong[0])
        raise DatasetError(
            f"{path}, line {numbers[k + 1]}: the timestamp {stamps[k + 1]:.6f} comes after {stamps[k]:.6f}; "
            "timestamps must increase: sort the list and remove duplicates. If they are not times and the images are "
            "numbered in their order, remove the list and give --fps"
        )


def associate(
    first: NDArray[np.float64], second: NDArray[np.float64], largest_gap: float = LARGEST_GAP
) -> list[tuple[int, int]]:
    """One-to-one pairs of nearest times, selected greedily by increasing time difference.

    Indices into the increasing times (N,) and (M,), seconds, in the order of ``second``.
    """
    candidates = []
    starts = np.searchsorted(first, second - largest_gap, side="left")
    stops = np.searchsorted(first, second + largest_gap, side="right")
    for j, (start, stop) in enumerate(zip(starts, stops, strict=True)):
        candidates += [(abs(first[i] - second[j]), i, j) for i in range(start, stop)]
    used_first, used_second, pairs = set(), set(), []
    for _, i, j in sorted(candidates):
        if i not in used_first and j not in used_second:
            used_first.add(i)
            used_second.add(j)
            pairs.append((int(i), int(j)))
    return sorted(pairs, key=lambda pair: pair[1])
