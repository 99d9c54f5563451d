"""Text files of camera poses in the formats of TUM, EuRoC and KITTI."""

import math
import re
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.geometry.association import read_rows
from dudmap.core.geometry.times import SECONDS, UNITS, time_unit
from dudmap.errors import ConfigError, DatasetError
from dudmap.input_files import describe, read_text

NANOSECONDS = UNITS[-1]
LARGEST_ERROR = 0.02
"""Error of a quaternion's length and of a rotation's products: rounding to two digits."""


SAMPLED = 1000


class PoseFormat(NamedTuple):
    """A format: name, columns of a row, and indices of ``timestamp x y z qx qy qz qw``; ``places`` is empty for
    matrices without times."""

    name: str
    columns: str
    places: tuple[int, ...]


FORMATS = {
    "tum": PoseFormat("TUM", "timestamp tx ty tz qx qy qz qw", (0, 1, 2, 3, 4, 5, 6, 7)),
    "euroc": PoseFormat("EuRoC", "timestamp tx ty tz qw qx qy qz", (0, 1, 2, 3, 5, 6, 7, 4)),
    "kitti": PoseFormat("KITTI", "r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz", ()),
}
"""Formats by the names that options and ``Trajectory.load`` take."""
ORDERS = {"xyzxyzw": "tum", "xyzwxyz": "euroc"}


class PoseFile(NamedTuple):
    """Content of a file: format, times (N,) in seconds or None, poses (N, 4, 4), and remarks."""

    format: PoseFormat
    timestamps: NDArray[np.float64] | None
    Ts_world_camera: NDArray[np.float64]
    remarks: tuple[str, ...] = ()


def pose_format(path: Path, option: str = "--format") -> PoseFormat:
    """Format of a file.

    A header that names the columns decides. Otherwise:
    - Lines of 12 or 16 numbers that contain a rotation are KITTI.
    - Numbers separated by blanks are TUM.
    - Numbers separated by commas with times in nanoseconds are EuRoC.

    Args:
        option: Option that gives the format, for messages.

    Raises:
        DatasetError: The file cannot be read, or its format is not clear.
    """
    try:
        lines = [line.strip() for line in read_text(path).splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot read {path}: {describe(error)}") from error
    order = next(filter(None, map(_named_order, lines[:SAMPLED])), None)
    if order in ORDERS:
        return FORMATS[ORDERS[order]]
    lines = [line for line in lines if not line.startswith("#")]
    rows = list(islice((row for row in map(_numbers, lines) if any(row[4:8])), SAMPLED))
    if not rows:
        return FORMATS["tum"]  # whose reader reports the faulty line
    row, commas = rows[0], "," in "".join(lines)
    if len(row) in (12, 16) and _holds_rotation(row):
        return FORMATS["kitti"]
    lengths = [math.hypot(*row[4:8]) for row in rows]
    quaternions = abs(float(np.median(lengths)) - 1) < LARGEST_ERROR and not _holds_rotation(row[1:])
    if order is None and (quaternions or len(row) < 8):
        if not commas:
            return FORMATS["tum"]
        if time_unit([row[0] for row in rows]) == NANOSECONDS:
            return FORMATS["euroc"]
    header = f"a header of columns that end in {' '.join(order)}" if order else "no header that names the columns"
    known = ", ".join(f"{name} for '{known.columns}'" for name, known in FORMATS.items())
    raise DatasetError(
        f"the format of {path} is not clear: {len(row)} numbers a line, separated by {'commas' if commas else 'blanks'}"
        f", and {header}; give {option} {known}"
    )


def read_poses(path: Path, name: str | None = None, *, optional: bool = False, option: str = "--format") -> PoseFile:
    """Poses of a file in the named or recognised format.

    Args:
        name: One of ``FORMATS``; None recognises the format.

    Raises:
        ConfigError: The name is unknown.
        DatasetError: The file is missing, has no clear format, has no pose, or has a row that is not a pose.
    """
    if name is not None and name not in FORMATS:
        raise ConfigError(f"the format of a trajectory is {name!r}; expected one of {', '.join(FORMATS)}")
    known = pose_format(path, option) if name is None else FORMATS[name]
    if not known.places:
        return PoseFile(known, None, np.array([_matrix(path, *row) for row in read_rows(path, known.columns)]))
    rows, latest, wrong = [], -np.inf, []
    for number, fields in read_rows(path, known.columns, short=optional):
        row = _finite(fields[:8])
        pose = len(row) == 8 and 1e-9 < math.hypot(*row[4:]) < 1e9
        if pose and not (optional and row[0] <= latest):
            latest = row[0]
            rows.append(row)
            continue
        numbers = f"eight finite numbers '{known.columns}' with a non-zero quaternion"
        expected = f"a time after {latest:.6f}" if pose else numbers
        wrong.append(f"{path}, line {number}: expected {expected}, found {' '.join(fields)!r}")
        if not optional:
            raise DatasetError(wrong[0])
    if not rows:
        raise DatasetError(wrong[0])
    table = np.array(rows)[:, known.places]
    unit = time_unit(table[:, 0])
    usual = NANOSECONDS if known is FORMATS["euroc"] else SECONDS
    remarks = [] if unit == usual else [f"the times of {path.name} are taken as {unit.name}"]
    if wrong:
        remarks.append(f"{len(wrong)} of {len(wrong) + len(rows)} rows are left out; the first: {wrong[0]}")
    Ts = np.tile(np.eye(4), (len(table), 1, 1))
    Ts[:, :3, 3] = table[:, 1:4]
    Ts[:, :3, :3] = se3.quat_xyzw_to_rotation(table[:, 4:8])
    return PoseFile(known, table[:, 0] / unit.per_second, Ts, tuple(remarks))


def _named_order(line: str) -> str:
    """Last letters of the names of columns two to eight of a header."""
    names = re.sub(r"\[.*?\]|\(.*?\)", "", line.lower()).strip("#, ")
    columns = [name.strip() for name in names.split(",")] if "," in names else names.split()
    letters = "".join(name[-1:] for name in columns[1:8])
    return letters if re.fullmatch("[wxyz]{7}", letters) and "w" in letters else ""


def _matrix(path: Path, number: int, fields: list[str]) -> NDArray[np.float64]:
    row = np.array(_numbers(" ".join(fields)))
    T = np.eye(4)
    if row.size in (12, 16):
        T[:3] = row[:12].reshape(3, 4)
    if row.size not in (12, 16) or not _is_rotation(T[:3, :3]):
        raise DatasetError(
            f"{path}, line {number}: expected 12 finite numbers '{FORMATS['kitti'].columns}' with a rotation, found "
            f"{' '.join(fields)!r}"
        )
    T[:3, :3] = se3.nearest_rotation(T[:3, :3])
    return T


def _numbers(line: str) -> list[float]:
    return _finite(line.replace(",", " ").split())


def _finite(fields: list[str]) -> list[float]:
    try:
        numbers = list(map(float, fields))
    except ValueError:
        return []
    return numbers if all(map(math.isfinite, numbers)) else []


def _holds_rotation(row: list[float]) -> bool:
    return len(row) >= 12 and _is_rotation(np.array(row[:12]).reshape(3, 4)[:, :3])


def _is_rotation(R: NDArray[np.float64]) -> bool:
    small = np.abs(R).max() <= 1 + LARGEST_ERROR  # products of larger numbers may overflow
    return bool(small and np.abs(R @ R.T - np.eye(3)).max() < LARGEST_ERROR and np.linalg.det(R) > 0)
