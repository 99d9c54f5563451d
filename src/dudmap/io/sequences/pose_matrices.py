"""Files of camera poses as 4x4 matrices.

Damaged files raise a ``DatasetError``.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError
from dudmap.input_files import read_text

OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
"""Between the camera axes of OpenGL (y up, z backward) and dudmap (y down, z forward)."""


def read_matrix(path: Path, rows: int = 4, columns: int = 4) -> NDArray[np.float64]:
    """Matrix (rows, columns) of a text file; numbers need not be finite."""
    numbers = _numbers(path)
    if numbers.size != rows * columns:
        raise DatasetError(f"{path} holds {numbers.size} numbers; expected a {rows}x{columns} matrix")
    return numbers.reshape(rows, columns)


def read_matrices(path: Path) -> NDArray[np.float64]:
    """Matrices (N, 4, 4) of a text file: 16 numbers a pose, row by row, or 12 a line (no row 0 0 0 1)."""
    numbers = _numbers(path)
    counts = [(n, len(line.replace(",", " ").split())) for n, line in enumerate(read_text(path).splitlines(), start=1)]
    counts = [(line, count) for line, count in counts if count]
    usual = counts[0][1] if counts and counts[0][1] in (4, 12, 16) else 16
    wrong = next(((line, count) for line, count in counts if count != usual), None)
    if wrong is not None or not counts or (usual == 4 and len(counts) % 4):
        line, count = wrong or (counts[-1] if counts else (1, 0))
        raise DatasetError(
            f"{path}, line {line}: {count} numbers; expected the 16 of a 4x4 matrix for every pose, in one line or "
            "four, or 12 in one line"
        )
    if usual != 12:
        return numbers.reshape(-1, 4, 4)
    return read_upper_rows(path)


def read_upper_rows(path: Path) -> NDArray[np.float64]:
    """Matrices (N, 4, 4) of a text file with their first three rows, four numbers each."""
    numbers = _numbers(path)
    if numbers.size == 0 or numbers.size % 12:
        raise DatasetError(f"{path} holds {numbers.size} numbers; expected three rows of four for every pose")
    poses = np.tile(np.eye(4), (numbers.size // 12, 1, 1))
    poses[:, :3] = numbers.reshape(-1, 3, 4)
    return poses


def read_log(path: Path) -> dict[int, NDArray[np.float64]]:
    """Poses by frame number of a ``.log`` file (Redwood, Open3D): three integers, the first the number, then
    T_world_camera by rows."""
    numbers = _numbers(path)
    if numbers.size == 0 or numbers.size % 19:
        raise DatasetError(f"{path} holds {numbers.size} numbers; expected 3 integers and a 4x4 matrix for every pose")
    table = numbers.reshape(-1, 19)
    return {int(row[0]): row[3:].reshape(4, 4) for row in table}


def rigid_trajectory(poses: Iterable[tuple[float, NDArray[np.float64]]]) -> Trajectory | None:
    """Trajectory of (timestamp, T_world_camera) pairs; poses that are not rigid are omitted, rotations projected. None
    without poses."""
    kept = []
    for stamp, T in poses:
        R = T[:3, :3]
        if np.all(np.isfinite(T)) and np.abs(R @ R.T - np.eye(3)).max() < 1e-2 and np.linalg.det(R) > 0:
            rigid = np.eye(4)
            rigid[:3, :3], rigid[:3, 3] = se3.nearest_rotation(R), T[:3, 3]
            kept.append((stamp, rigid))
    return Trajectory.from_poses(kept) if kept else None


def _numbers(path: Path) -> NDArray[np.float64]:
    try:
        fields = read_text(path).replace(",", " ").split()
        return np.array([float(field) for field in fields])
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot read {path}: {error}") from error
    except ValueError as error:
        raise DatasetError(f"{path} holds something that is no number: {error}") from error
