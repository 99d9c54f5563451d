"""Lists of timed files and their association by time."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import DatasetError
from dudmap.input_files import read_text

LARGEST_GAP = 0.02
"""Largest time difference of an associated pair, seconds (that of the TUM benchmark's script)."""


class TimedFile(NamedTuple):
    """One line of a list: seconds and path."""

    timestamp: float
    path: Path


def read_rows(path: Path, columns: str) -> list[tuple[int, list[str]]]:
    """Line numbers and fields of a text list; ``#`` starts a comment, commas count as blanks.

    Args:
        path: The list.
        columns: Names of the fields, blank between them, e.g. ``timestamp file``.

    Raises:
        DatasetError: The file cannot be read or a line does not have these columns.
    """
    try:
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot read {path}: {error}") from error
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.replace(",", " ").split()
        if not fields or fields[0].startswith("#"):
            continue
        if len(fields) < len(columns.split()):
            raise DatasetError(f"{path}, line {number}: expected '{columns}', found {line.strip()!r}")
        rows.append((number, fields))
    if not rows:
        raise DatasetError(f"{path} lists nothing; expected lines '{columns}'")
    return rows


def read_list(path: Path) -> list[TimedFile]:
    """Files of a list ``timestamp file``, paths relative to the list's folder.

    Raises:
        DatasetError: The list is unreadable, or its times are not finite and strictly increasing.
    """
    rows = read_rows(path, "timestamp file")
    stamps = [parse_stamp(path, number, fields[0]) for number, fields in rows]
    check_increasing(path, [number for number, _ in rows], stamps)
    return [TimedFile(stamp, path.parent / fields[1]) for stamp, (_, fields) in zip(stamps, rows, strict=True)]


def read_pairs(path: Path) -> list[tuple[TimedFile, TimedFile]]:
    """(colour, depth) files of an associations list ``t_rgb rgb_file t_depth depth_file``.

    Some tools write depth first; the folder names decide.

    Raises:
        DatasetError: The list is unreadable, or its depth times are not finite and strictly increasing.
    """
    rows = read_rows(path, "t_rgb rgb_file t_depth depth_file")
    pairs = []
    for number, fields in rows:
        first = TimedFile(parse_stamp(path, number, fields[0]), path.parent / fields[1])
        second = TimedFile(parse_stamp(path, number, fields[2]), path.parent / fields[3])
        swapped = "depth" in fields[1] and "depth" not in fields[3]
        pairs.append((second, first) if swapped else (first, second))
    check_increasing(path, [number for number, _ in rows], [depth.timestamp for _, depth in pairs])
    return pairs


def parse_stamp(path: Path, number: int, text: str) -> float:
    """A finite time in seconds.

    Raises:
        DatasetError: The text is no number, NaN or infinite.
    """
    try:
        stamp = float(text)
    except ValueError:
        stamp = np.nan
    if not np.isfinite(stamp):
        raise DatasetError(f"{path}, line {number}: the timestamp {text!r} is not a finite number of seconds")
    return stamp


def check_increasing(path: Path, numbers: list[int], stamps: list[float]) -> None:
    """Check that times increase from line to line.

    Raises:
        DatasetError: They do not; the message names the first offending line.
    """
    wrong = np.flatnonzero(np.diff(stamps) <= 0)
    if len(wrong):
        k = int(wrong[0])
        raise DatasetError(
            f"{path}, line {numbers[k + 1]}: the timestamp {stamps[k + 1]:.6f} comes after {stamps[k]:.6f}; "
            "timestamps must increase: sort the list and remove doubles, or, where these are no times and the images "
            "are numbered in their order, move the list away and give --fps"
        )


def associate(
    first: NDArray[np.float64], second: NDArray[np.float64], largest_gap: float = LARGEST_GAP
) -> list[tuple[int, int]]:
    """One-to-one pairs of nearest times, chosen greedily by increasing time difference.

    Returns indices into the increasing times (N,) and (M,), seconds, in the order of ``second``.
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
