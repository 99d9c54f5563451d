"""Input files of an evaluation; faults raise ``DatasetError``, meshes ``MapError``."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.association import parse_stamp, read_list, read_pairs, read_rows
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.pose_files import FORMATS, PoseFile, read_poses
from dudmap.core.geometry.times import time_unit
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import ConfigError, DatasetError, MapError
from dudmap.evaluation.surface import moved
from dudmap.evaluation.trajectory import ate
from dudmap.input_files import DAMAGE, read_json
from dudmap.io.sequences import is_recording, open_sequence, reader_of
from dudmap.io.sequences.tum import BonnSequence, TumSequence, bonn_camera_poses, holds_bonn_markers


class TrajectoryFile(NamedTuple):
    """Path of a trajectory, and its run folder, if any."""

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
    """True trajectory: a file, a recording, or without ``reference`` the run's groundtruth.txt.

    Returns:
        A file, or a recording whose format has its ground truth elsewhere.
    """
    if reference is not None:
        path = reference / "groundtruth.txt" if reference.is_dir() else reference
        if not path.is_file() and is_recording(reference):
            return reference
        if not path.is_file():
            raise DatasetError(f"there is no true trajectory {path}; name a file of poses or a recording's folder")
        return path
    path = None if run is None else run / "groundtruth.txt"
    return path if path is not None and path.is_file() else None


class Loaded(NamedTuple):
    """A trajectory and its format's name."""

    trajectory: Trajectory
    format: str


class Clock(NamedTuple):
    """Times for poses without: a file, a recording, or a rate in 1/s."""

    times: Path | None = None
    fps: float | None = None


BONN = "bonn"


def load_reference(path: Path) -> Trajectory:
    """True camera poses of a path from ``find_reference``.

    A recording's groundtruth.txt is read by its format, because some have markers, robots or other axes.
    """
    return _with_times(path, _read_reference(path, None), None, Clock()).trajectory


def load_trajectories(
    estimate: Path,
    reference: Path | None,
    formats: tuple[str | None, str | None],
    clock: Clock,
) -> tuple[Loaded, Loaded | None]:
    """Estimate, and true camera poses of a path from ``find_reference``.

    Poses without times (KITTI) take the times of ``clock``, the reference's recording, or the other trajectory, if the
    numbers match.

    Args:
        formats: Of ``pose_files.FORMATS`` or ``bonn``; None: recognised.

    Raises:
        ConfigError: An unknown format, or ``clock`` has two sources or is not needed.
        DatasetError: An unreadable file or recording, an unclear format, or no times.
    """
    found = _Read(*_poses(estimate, formats[0], "--format"), None)
    true = None if reference is None else _read_reference(reference, formats[1])
    timed = all(part.file.timestamps is not None for part in (found, true) if part)
    given = [option for option, value in (("--times", clock.times), ("--fps", clock.fps)) if value is not None]
    if given and (timed or len(given) > 1):
        raise ConfigError(
            f"found {' and '.join(given)}; expected one of both, for poses without times (KITTI)"
            + ("; these trajectories have their own times" if timed else "")
        )
    loaded = _with_times(estimate, found, true, clock)
    return loaded, _with_times(reference, true, found, clock) if reference and true else None


class _Read(NamedTuple):
    file: PoseFile
    format: str
    recording: Path | None

    def known_times(self) -> list[NDArray[np.float64]]:
        try:
            frames = None if self.recording is None else open_sequence(self.recording).timestamps
        except DatasetError:  # the frames are only one source of times
            frames = None
        return [times for times in (frames, self.file.timestamps) if times is not None]


def _poses(path: Path, name: str | None, option: str) -> tuple[PoseFile, str]:
    """Poses of a file without invalid rows, and their format; Bonn's marker poses become camera poses."""
    file = read_poses(path, "tum" if name == BONN else name, optional=True, option=option)
    if name != BONN:
        return file, file.format.name
    return file._replace(Ts_world_camera=bonn_camera_poses(file.Ts_world_camera)), f"Bonn, {BonnSequence.truth}"


def _read_reference(path: Path, name: str | None) -> _Read:
    beside = reader_of(path.parent) if path.name == "groundtruth.txt" else None
    if path.is_file() and (name is not None or (beside in (None, TumSequence) and not is_recording(path))):
        name = name or (BONN if holds_bonn_markers(path) else None)
        file = _poses(path, name, "--reference-format")
        return _Read(*file, None if beside is None else path.parent)
    recording = path if beside is None else path.parent
    opened = open_sequence(recording)
    truth = opened.ground_truth
    if truth is None:
        why = "; ".join(opened.remarks) or "it has no true poses"
        raise DatasetError(f"the recording {recording} cannot be the reference: {why}; name a file of poses")
    file = PoseFile(FORMATS["tum"], truth.timestamps, truth.Ts_world_camera, truth.remarks)
    return _Read(file, f"{opened.format}{f', {opened.truth}' if opened.truth else ''}", recording)


def _with_times(path: Path, read: _Read, other: _Read | None, clock: Clock) -> Loaded:
    file, count = read.file, len(read.file.Ts_world_camera)
    if file.timestamps is not None:
        return Loaded(_trajectory(path, file.timestamps, file), read.format)
    known = [times for part in (read, other) if part for times in part.known_times()]
    if clock.times is not None:
        times, source = _times(clock.times), f"times of {clock.times}"
        if len(times) != count:
            raise DatasetError(
                f"{clock.times} gives {len(times)} times; expected one for each of {count} poses of {path}"
            )
    elif clock.fps is not None:
        times, source = (known[0][0] if known else 0.0) + np.arange(count) / clock.fps, f"{clock.fps:g} poses a second"
    else:
        times, source = next((times for times in known if len(times) == count), None), "times of the other"
    if times is None:
        counts = " or ".join(str(len(times)) for times in known)
        there = f", and {counts} times of the other trajectory do not fit" if counts else ""
        raise DatasetError(
            f"{path} holds {count} poses without times ({read.format}){there}; give --times FILE with {count} times, "
            "or --fps HZ"
        )
    return Loaded(_trajectory(path, times, file), f"{read.format}, {source}")


def _times(path: Path) -> NDArray[np.float64]:
    if is_recording(path):
        return open_sequence(path).timestamps
    stamps = [parse_stamp(path, number, fields[0]) for number, fields in read_rows(path, "timestamp")]
    return np.array(stamps) / time_unit(stamps).per_second


def _trajectory(path: Path, times: NDArray[np.float64], file: PoseFile) -> Trajectory:
    try:
        return Trajectory(times, file.Ts_world_camera, file.remarks)
    except DatasetError as error:
        raise DatasetError(f"{path}: {error}") from None


class TrueSurface(NamedTuple):
    """True static surface of a recording in the world frame of its ground truth."""

    path: Path
    whole: Mesh
    observed: Mesh | None = None
    observed_path: Path | None = None


def true_surface(folder: Path) -> TrueSurface | None:
    """True surface of a folder: surface.ply with perhaps surface_observed.ply, or the data set's model."""
    path, seen = folder / "surface.ply", folder / "surface_observed.ply"
    if path.is_file():
        observed = load_mesh(seen) if seen.is_file() else None
        return TrueSurface(path, load_mesh(path), observed, None if observed is None else seen)
    model = getattr(open_sequence(folder), "model", None) if folder.is_dir() and is_recording(folder) else None
    return model and TrueSurface(model.path, moved(load_mesh(model.path), model.T_world_model))


def load_mesh(path: Path) -> Mesh:
    """Mesh of a file."""
    if not path.is_file():
        raise MapError(f"there is no mesh {path}; name a mesh file, or a folder that holds {path.name}")
    return Mesh.load(path)


def first_pose_alignment(run: Path, recording: Path) -> NDArray[np.float64] | None:
    """Motion (4, 4) of a run's first pose onto the true one, or None; all positions of a short path hardly determine
    the rotation."""
    estimate, truth = run / "trajectory.txt", _truth_in(recording)
    if truth is None or not estimate.is_file():
        return None
    return ate(Trajectory.load(estimate), truth, "origin").T_reference_estimate


def _truth_in(recording: Path) -> Trajectory | None:
    if (recording / "groundtruth.txt").is_file():
        return load_reference(recording / "groundtruth.txt")
    return open_sequence(recording).ground_truth if recording.is_dir() and is_recording(recording) else None


def tracked_share(poses: int, run: Path | None, reference: Path | None) -> float | None:
    """Share of the recording's frames with a pose, or None; frames by metrics.json or lists."""
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
