"""Timed camera poses and their text format."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import write_text
from dudmap.core.arrays import copied
from dudmap.core.geometry import se3
from dudmap.core.geometry.pose_files import read_poses
from dudmap.errors import DatasetError

TUM_HEADER = "# timestamp tx ty tz qx qy qz qw"
LARGEST_STEP = 0.15
"""Longest time of assumed constant velocity, seconds."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Camera poses over time.

    Attributes:
        timestamps: (N,) float64, seconds, strictly increasing.
        Ts_world_camera: (N, 4, 4) float64.
        remarks: On the assumed unit and skipped rows.
    """

    timestamps: NDArray[np.float64]
    Ts_world_camera: NDArray[np.float64]
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, what in (("timestamps", "times of a trajectory"), ("Ts_world_camera", "poses of a trajectory")):
            object.__setattr__(self, name, copied(getattr(self, name), what))
        if self.timestamps.ndim != 1 or self.Ts_world_camera.shape != (len(self.timestamps), 4, 4):
            raise DatasetError(
                f"trajectory has {len(self.timestamps)} timestamps but poses of shape {self.Ts_world_camera.shape}; "
                "expected one 4x4 pose per timestamp"
            )
        if not np.all(np.isfinite(self.timestamps)) or not np.all(np.isfinite(self.Ts_world_camera)):
            raise DatasetError("trajectory holds NaN or infinite numbers; remove those rows")
        if np.any(np.diff(self.timestamps) <= 0):
            raise DatasetError("trajectory timestamps are not strictly increasing; sort the rows and remove duplicates")

    def __len__(self) -> int:
        return len(self.timestamps)

    def __repr__(self) -> str:
        times = f", {self.timestamps[0]:.6f} to {self.timestamps[-1]:.6f} s" if len(self) else ""
        return f"Trajectory({len(self)} poses{times})"

    @classmethod
    def from_poses(cls, poses: Iterable[tuple[float, NDArray[np.float64]]]) -> "Trajectory":
        """Trajectory of (timestamp, T_world_camera) pairs."""
        pairs = list(poses)
        stamps = np.array([stamp for stamp, _ in pairs], dtype=np.float64)
        Ts = np.array([T for _, T in pairs], dtype=np.float64).reshape(-1, 4, 4)
        return cls(stamps, Ts)

    def interpolate(self, timestamp: float) -> NDArray[np.float64]:
        """Pose (4, 4) on the screw between its two neighbours.

        Raises:
            DatasetError: The time lies outside the trajectory.
        """
        if len(self) == 0 or not self.timestamps[0] <= timestamp <= self.timestamps[-1]:
            raise DatasetError(f"no pose at time {timestamp:.6f}: it lies outside the trajectory")
        return se3.interpolate_in_time(self.timestamps, self.Ts_world_camera, timestamp).copy()

    def after(self, seconds: float | NDArray[np.float64]) -> "Trajectory":
        """Poses ``seconds`` (a number or (N,)) after the time stamps.

        On the screw to the next pose; at ends and gaps longer than ``LARGEST_STEP`` on the opposite side's. Without a
        near neighbour unchanged.
        """
        seconds = np.broadcast_to(seconds, len(self))[:, None]
        if not seconds.any() or len(self) < 2:
            return self
        gaps, forwards = np.diff(self.timestamps), seconds > 0
        near = np.append(gaps <= LARGEST_STEP, False)
        motions = se3.log_all(se3.inverse(self.Ts_world_camera[:-1]) @ self.Ts_world_camera[1:]) / gaps[:, None]
        to_next = np.where(near[:, None], np.vstack([motions, np.zeros(6)]), 0.0)
        from_last, has_last = np.roll(to_next, 1, axis=0), np.roll(near, 1)
        near, has_last = near[:, None], has_last[:, None]
        ahead, behind = np.where(near, to_next, from_last), np.where(has_last, from_last, to_next)
        twists = np.where(forwards, ahead, behind)
        return Trajectory(self.timestamps, self.Ts_world_camera @ se3.exp_all(seconds * twists))

    def save(self, path: str | Path) -> None:
        """Write TUM text ``timestamp tx ty tz qx qy qz qw``, camera to world."""
        lines = [TUM_HEADER]
        for stamp, T in zip(self.timestamps, self.Ts_world_camera, strict=True):
            numbers = (*T[:3, 3], *se3.rotation_to_quat_xyzw(T[:3, :3]))
            lines.append(f"{stamp:.6f} " + " ".join(f"{number:.9f}" for number in numbers))
        write_text(path, "\n".join(lines) + "\n")

    @classmethod
    def load(
        cls,
        path: str | Path,
        *,
        format: str | None = None,
        timestamps: NDArray[np.float64] | None = None,
        optional: bool = False,
    ) -> "Trajectory":
        """Read a text file in the format of TUM, EuRoC or KITTI.

        Args:
            path: The file.
            format: ``tum``, ``euroc`` or ``kitti``; None recognises it (``pose_files.pose_format``).
            timestamps: (N,) seconds of the poses of a file without times (KITTI).
            optional: Skip rows that are not a pose, and count them in ``remarks``.

        Raises:
            DatasetError: The file is missing or of unclear format, or has no pose, no times, or, unless ``optional``, a
                wrong row.
        """
        path = Path(path)
        found = read_poses(path, format, optional=optional)
        stamps = timestamps if found.timestamps is None else found.timestamps
        if stamps is None:
            raise DatasetError(
                f"{path} holds {len(found.Ts_world_camera)} poses without times ({found.format.name}); expected times, "
                "as in TUM or EuRoC files (dudmap evaluate takes --times and --fps)"
            )
        try:
            return cls(stamps, found.Ts_world_camera, found.remarks)
        except DatasetError as error:
            raise DatasetError(f"{path}: {error}") from None
