"""Input files of an evaluation: trajectory, mesh and reference of a run folder, a recording, or named directly."""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import DatasetError, MapError
from dudmap.evaluation.trajectory import ate
from dudmap.geometry.association import read_list, read_pairs
from dudmap.geometry.mesh import Mesh
from dudmap.geometry.trajectory import Trajectory


class TrajectoryFile(NamedTuple):
    """Path of a trajectory, and the run folder it belongs to (None if the file was named directly)."""

    path: Path
    run: Path | None


def find_trajectory(estimate: Path) -> TrajectoryFile:
    """Trajectory of a run folder, or the file itself.

    Raises:
        DatasetError: The folder holds no trajectory.txt.
    """
    if not estimate.is_dir():
        return TrajectoryFile(estimate, None)
    path = estimate / "trajectory.txt"
    if not path.is_file():
        raise DatasetError(f"{estimate} is no run folder: it holds no trajectory.txt")
    return TrajectoryFile(path, estimate)


def find_reference(reference: Path | None, run: Path | None) -> Path | None:
    """True trajectory: a file, the groundtruth.txt of a folder, or without ``reference`` that of the run folder.

    Raises:
        DatasetError: ``reference`` is given and there is no such file.
    """
    if reference is not None:
        path = reference / "groundtruth.txt" if reference.is_dir() else reference
        if not path.is_file():
            raise DatasetError(f"there is no true trajectory {path}; name a file in TUM format or a recording's folder")
        return path
    path = None if run is None else run / "groundtruth.txt"
    return path if path is not None and path.is_file() else None


def load_mesh(path: Path) -> Mesh:
    """Mesh of a file.

    Raises:
        MapError: The file is missing or not a mesh.
    """
    if not path.is_file():
        raise MapError(f"there is no mesh {path}; name a mesh file, or a folder that holds {path.name}")
    return Mesh.load(path)


def first_pose_alignment(run: Path, recording: Path) -> NDArray[np.float64] | None:
    """Rigid motion (4, 4) of a run's first pose onto the true one; None unless both folders hold a trajectory.

    The world frame of a run is its first camera. An alignment of all positions would rotate the map: on a short path
    they hardly determine the rotation.
    """
    estimate, reference = run / "trajectory.txt", recording / "groundtruth.txt"
    if not (estimate.is_file() and reference.is_file()):
        return None
    return ate(Trajectory.load(estimate), Trajectory.load(reference), "origin").T_reference_estimate


def tracked_share(poses: int, run: Path | None, reference: Path | None) -> float | None:
    """Share of the recording's frames that have a pose; None where the number of frames is unknown.

    The number of frames is that of the run's metrics.json, or else of the image lists beside the true trajectory.

    Raises:
        DatasetError: metrics.json or the list cannot be read.
    """
    frames = _num_frames(run, reference)
    return round(poses / frames, 6) if frames else None


def _num_frames(run: Path | None, reference: Path | None) -> int | None:
    if run is not None and (run / "metrics.json").is_file():
        try:
            return int(json.loads((run / "metrics.json").read_text(encoding="utf-8"))["frames"])
        except (ValueError, KeyError, TypeError) as error:
            raise DatasetError(f"{run / 'metrics.json'} does not tell the number of frames: {error}") from error
    if reference is None:
        return None
    recording = reference.parent
    if (recording / "associations.txt").is_file():
        return len(read_pairs(recording / "associations.txt"))
    return len(read_list(recording / "depth.txt")) if (recording / "depth.txt").is_file() else None
