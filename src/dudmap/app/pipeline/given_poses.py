"""Given poses: read, tested against the images, looked up by time."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from dudmap.app.pipeline.pose_conventions import check_convention, converted, named
from dudmap.core.geometry import se3
from dudmap.core.geometry.pose_files import FORMATS, read_poses
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import ConfigError, DatasetError
from dudmap.input_files import damaged, read_text

if TYPE_CHECKING:
    from dudmap.io.sequences import Sequence

RECORDING = "recording"
SAME_TIME = 1e-4
"""Stamps that differ by less are equal, seconds: files have four digits."""
LARGEST_GAP = 0.05
"""Largest time from a frame to interpolated poses, seconds."""
POSES = "given_poses.txt"


@dataclass(frozen=True, eq=False)
class GivenPoses:
    """Poses at the times of frames.

    Attributes:
        trajectory: The poses; frames without one are not in it.
        role: ``given`` (the result) or ``refined`` (start of registration).
    """

    trajectory: Trajectory
    role: Literal["given", "refined"]

    def at(self, timestamp: float) -> NDArray[np.float64] | None:
        """Pose (4, 4) at a time in seconds, or None."""
        return _at(self.trajectory, timestamp)

    def corrections(self, found: Trajectory) -> dict[str, float]:
        """Median and largest difference of refined to given poses, millimetres and degrees."""
        pairs = [(T, self.at(stamp)) for stamp, T in zip(found.timestamps, found.Ts_world_camera, strict=True)]
        motions = [se3.inverse(given) @ T for T, given in pairs if given is not None]
        if not motions:
            return {}
        mm = [1000 * float(np.linalg.norm(T[:3, 3])) for T in motions]
        deg = [float(np.degrees(se3.rotation_angle(T))) for T in motions]
        figures = {"median_mm": np.median(mm), "max_mm": max(mm), "median_deg": np.median(deg), "max_deg": max(deg)}
        return {name: round(float(value), 3) for name, value in figures.items()}


def given_poses(name: str, sequence: "Sequence", convention: str | None = None, *, refine: bool = False) -> GivenPoses:
    """The poses of the frames of a recording.

    Args:
        name: ``recording``, a file of poses, or a folder with one file per frame.
        convention: Format (``pose_files.FORMATS``) and convention (``pose_conventions.WORDS``), separated by commas;
            None recognises the format. Default: camera-to-world, x right, y down, z forward, metres.
        refine: Whether registration starts from the poses.

    Raises:
        ConfigError: The convention is unknown.
        DatasetError: The poses cannot be read, do not belong to the frames, or contradict the images.
    """
    words = [] if convention is None else [word.strip() for word in convention.split(",")]
    formats = [word for word in words if word in FORMATS]
    read_as = named([word for word in words if word not in FORMATS])
    if name == RECORDING:
        if sequence.ground_truth is None:
            raise DatasetError(f"the recording {sequence.name} brings no poses; name a file of poses (--poses FILE)")
        source = sequence.ground_truth
    else:
        source = _read(Path(name), sequence, formats[0] if formats else None)
    source = converted(source, read_as)
    pairs = [(stamp, T) for stamp in sequence.timestamps if (T := _at(source, stamp)) is not None]
    if not pairs:
        raise DatasetError(
            f"none of the {len(source)} poses of {name} is within {1000 * LARGEST_GAP:.0f} ms of a frame: their times "
            f"run from {source.timestamps[0]:.6f} to {source.timestamps[-1]:.6f} s, the frames' from "
            f"{sequence.timestamps[0]:.6f} to {sequence.timestamps[-1]:.6f} s"
        )
    poses = Trajectory.from_poses(pairs)
    check_convention(poses, sequence, name, read_as)
    return GivenPoses(poses, "refined" if refine else "given")


def _at(poses: Trajectory, timestamp: float) -> NDArray[np.float64] | None:
    """Pose (4, 4) interpolated between near poses, or None."""
    stamps = poses.timestamps
    after = int(np.searchsorted(stamps, timestamp))
    for number in (after - 1, after):
        if 0 <= number < len(stamps) and abs(stamps[number] - timestamp) <= SAME_TIME:
            return poses.Ts_world_camera[number]
    if not 0 < after < len(stamps) or max(timestamp - stamps[after - 1], stamps[after] - timestamp) > LARGEST_GAP:
        return None
    return poses.interpolate(timestamp)


def _read(path: Path, sequence: "Sequence", name: str | None) -> Trajectory:
    if path.is_dir():
        files = sorted((file for file in path.iterdir() if file.suffix == ".txt"), key=_natural)
        matrices = [_matrices(file) for file in files]
        if not files or any(found is None or len(found) != 1 for found in matrices):
            raise DatasetError(
                f"{path} holds no poses; expected one text file per frame with the 4x4 numbers of its pose"
            )
        Ts = np.concatenate([found for found in matrices if found is not None])
    elif not path.is_file():
        raise DatasetError(f"there is no file {path}; expected poses (--poses FILE, or --poses {RECORDING})")
    elif name is None and (stacked := _matrices(path)) is not None:
        Ts = stacked
    else:
        found = read_poses(path, name, optional=True, option="--poses-as")
        if found.timestamps is not None:
            return Trajectory(found.timestamps, found.Ts_world_camera, found.remarks)
        Ts = found.Ts_world_camera
    if len(Ts) != len(sequence.timestamps):
        raise DatasetError(
            f"{path} holds {len(Ts)} poses without times, but the recording has {len(sequence.timestamps)} frames; "
            "expected one pose per frame, or times"
        )
    return Trajectory(np.asarray(sequence.timestamps, np.float64), Ts)


def _natural(path: Path) -> tuple[int, str]:
    digits = "".join(filter(str.isdigit, path.stem))
    return int(digits or 0), path.name


def _matrices(path: Path) -> NDArray[np.float64] | None:
    """Poses (N, 4, 4) of four rows each, with rows of three numbers between (Open3D's .log), or None."""
    with damaged(DatasetError, path):
        lines = [line.split() for line in read_text(path).splitlines() if line.strip() and line[0] != "#"]
        rows = [line for line in lines if len(line) != 3]
        if not rows or len(rows) % 4 or any(len(row) != 4 for row in rows):
            return None
        Ts = np.array(rows, dtype=np.float64).reshape(-1, 4, 4)
    rigid = np.abs(Ts[:, :3, :3] @ Ts[:, :3, :3].transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) < se3.LARGEST_SKEW
    if not np.all(np.isfinite(Ts)) or not np.all(rigid):
        raise DatasetError(f"{path}: expected rigid motions, four lines of four numbers each")
    return Ts


def stored_poses(folder: Path, role: Literal["given", "refined"]) -> GivenPoses:
    """Poses stored in a run folder."""
    return GivenPoses(Trajectory.load(folder / POSES), role)


def checked_options(*, has_poses: bool, refine: bool, saved_map: bool) -> None:
    """Refuse options that contradict given poses."""
    if refine and not has_poses:
        raise ConfigError("there are no poses to refine; name them (--poses FILE, or --poses recording)")
    if has_poses and saved_map:
        raise ConfigError("given poses are in another world frame than --map; drop one of the two")
