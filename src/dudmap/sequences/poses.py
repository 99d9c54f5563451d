"""Files of camera poses as 4x4 matrices: one per file, one per line, or Redwood's ``.log``."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import DatasetError
from dudmap.geometry import se3
from dudmap.geometry.trajectory import Trajectory
from dudmap.input_files import read_text


def read_matrix(path: Path, rows: int = 4, columns: int = 4) -> NDArray[np.float64]:
    """Matrix (rows, columns) of a text file; commas count as blanks. Numbers need not be finite.

    Raises:
        DatasetError: The file cannot be read or holds other numbers.
    """
    numbers = _numbers(path)
    if numbers.size != rows * columns:
        raise DatasetError(f"{path} holds {numbers.size} numbers; expected a {rows}x{columns} matrix")
    return numbers.reshape(rows, columns)


def read_matrices(path: Path) -> NDArray[np.float64]:
    """Matrices (N, 4, 4) of a text file with 16 numbers each, row by row; line breaks do not matter.

    Raises:
        DatasetError: The file cannot be read or the count of numbers is not a multiple of 16.
    """
    numbers = _numbers(path)
    if numbers.size == 0 or numbers.size % 16:
        raise DatasetError(f"{path} holds {numbers.size} numbers; expected 16 for every pose, row by row")
    return numbers.reshape(-1, 4, 4)


def read_log(path: Path) -> dict[int, NDArray[np.float64]]:
    """Poses by frame number of a ``.log`` file: a line of three integers, then four rows of T_world_camera.

    The format is that of the Redwood data sets and of Open3D's reconstruction system. The first integer is the number
    of the frame.

    Raises:
        DatasetError: The file cannot be read or has not 19 numbers for every pose.
    """
    numbers = _numbers(path)
    if numbers.size == 0 or numbers.size % 19:
        raise DatasetError(f"{path} holds {numbers.size} numbers; expected 3 integers and a 4x4 matrix for every pose")
    table = numbers.reshape(-1, 19)
    return {int(row[0]): row[3:].reshape(4, 4) for row in table}


def rigid_trajectory(poses: Iterable[tuple[float, NDArray[np.float64]]]) -> Trajectory | None:
    """Trajectory of (timestamp, T_world_camera) pairs; frames whose pose is not a rigid motion are left out.

    Data sets mark frames without a pose by infinite numbers or zeros. Rotations are projected onto the nearest one,
    as they were written with few digits. None if there is no pose.
    """
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
