"""Input files of an evaluation: trajectory, mesh and reference of a run folder, a recording, or named directly.

What is missing or malformed is a ``DatasetError``, and a ``MapError`` if it is a mesh.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.association import read_list, read_pairs
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError, MapError
from dudmap.evaluation.trajectory import ate
from dudmap.input_files import DAMAGE, read_json
from dudmap.io.sequences import is_recording, open_sequence, reader_of
from dudmap.io.sequences.tum import TumSequence


class TrajectoryFile(NamedTuple):
    """Path of a trajectory, and the run folder it belongs to (None if the file was named directly)."""

    path: Path
    run: Path | None


def find_trajectory(estimate: Path) -> TrajectoryFile:
    """Trajectory of a run folder, or the file itself."""
    if not estimate.is_dir():
        return TrajectoryFile(estimate, None)
    path = estimate / "trajectory.txt"
    if not path.is_file():
        raise DatasetError(f"{estimate} is no run folder: it holds no trajectory.txt")
    return TrajectoryFile(path, estimate)


def find_reference(reference: Path | None, run: Path | None) -> Path | None:
    """True trajectory: a file, a recording, or without ``reference`` the groundtruth.txt of the run folder.

    Returns:
        A file, or the folder or archive of a recording whose format knows its truth by other files.
    """
    if reference is not None:
        path = reference / "groundtruth.txt" if reference.is_dir() else reference
        if not path.is_file() and is_recording(reference):
            return reference
        if not path.is_file():
            raise DatasetError(f"there is no true trajectory {path}; name a file in TUM format or a recording's folder")
        return path
    path = None if run is None else run / "groundtruth.txt"
    return path if path is not None and path.is_file() else None


def load_reference(path: Path) -> Trajectory:
    """True camera poses of a path that ``find_reference`` returned.

    The groundtruth.txt of a recording is read as its format wants it: some data sets store the poses of markers, of a
    robot, or with other axes.
    """
    inside = path.name == "groundtruth.txt" and reader_of(path.parent) not in (None, TumSequence)
    if path.is_file() and not inside and not is_recording(path):
        return Trajectory.load(path, optional=path.name == "groundtruth.txt")
    recording = path.parent if inside else path
    opened = open_sequence(recording)
    truth = opened.ground_truth
    if truth is None:
        why = "; ".join(opened.remarks) or "it has no true poses"
        raise DatasetError(f"the recording {recording} cannot be the reference: {why}; name a file in TUM format")
    return truth


def load_mesh(path: Path) -> Mesh:
    """Mesh of a file."""
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
    return ate(Trajectory.load(estimate), load_reference(reference), "origin").T_reference_estimate


def tracked_share(poses: int, run: Path | None, reference: Path | None) -> float | None:
    """Share of the recording's frames that have a pose; None where the number of frames is unknown.

    The number of frames is that of the run's metrics.json, or else of the image lists beside the true trajectory.
    """
    frames = _num_frames(run, reference)
    return round(poses / frames, 6) if frames else None


def _num_frames(run: Path | None, reference: Path | None) -> int | None:
    if run is not None and (run / "metrics.json").is_file():
        try:
            return int(read_json(run / "metrics.json")["frames"])
        except DAMAGE as error:
            raise DatasetError(f"{run / 'metrics.json'} does not tell the number of frames: {error}") from error
    if reference is None:
        return None
    if reference.is_dir():
        return len(open_sequence(reference))
    recording = reference.parent
    if (recording / "associations.txt").is_file():
        return len(read_pairs(recording / "associations.txt"))
    return len(read_list(recording / "depth.txt")) if (recording / "depth.txt").is_file() else None
