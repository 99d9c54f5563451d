"""Input of exporters: results in a run folder, and export options.

Missing, damaged or newer files raise a ``DatasetError``, or a ``MapError`` for mesh and map.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import ConfigError, DatasetError, MapError, NoImagesError
from dudmap.input_files import DAMAGE, parse_json, read_json, read_text
from dudmap.version import __version__

if TYPE_CHECKING:
    from dudmap.core.geometry.camera import Camera
    from dudmap.core.map.volume import TsdfVolume
    from dudmap.io.sequences import Sequence

NEAR = 0.001


@dataclass(frozen=True, eq=False)
class RunContent:
    """Results of a run, read on first access."""

    folder: Path

    @classmethod
    def load(cls, folder: str | Path) -> "RunContent":
        """Open a run folder."""
        folder = Path(folder)
        if not (folder / "trajectory.txt").is_file():
            raise DatasetError(f"{folder} holds no trajectory.txt; name a run folder, as dudmap run writes it")
        run = cls(folder)
        run.check_version()
        return run

    def check_version(self) -> None:
        """Refuse the folder of a newer version."""
        versions = self.metrics.get("versions")
        written = str(versions.get("dudmap", "0")) if isinstance(versions, dict) else "0"
        if _numbers(written) > _numbers(__version__):
            found = f"{self.folder} was written by dudmap {written} and this is {__version__}"
            raise DatasetError(f"{found}; update dudmap")

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """Content of metrics.json; empty without this file."""
        path = self.folder / "metrics.json"
        try:
            return dict(read_json(path)) if path.is_file() else {}
        except DAMAGE as error:
            raise DatasetError(f"{path} is damaged: {error}; repeat the run") from error

    @property
    def recording(self) -> dict[str, Any]:
        """Arguments of ``open_sequence`` for the recording of the run; empty if unnamed."""
        found = self.metrics.get("recording")
        return found if isinstance(found, dict) else {}

    @cached_property
    def trajectory(self) -> Trajectory:
        """Poses of the tracked frames at exposure times."""
        taken = self.folder / "image_poses.txt"
        return Trajectory.load(taken if taken.is_file() else self.folder / "trajectory.txt")

    @cached_property
    def mesh(self) -> Mesh | None:
        """The static surface, None after localisation."""
        path = self.folder / "mesh.ply"
        return Mesh.load(path) if path.is_file() else None

    @property
    def surface(self) -> Mesh:
        """The static surface."""
        if self.mesh is None:
            raise MapError(f"{self.folder} holds no mesh.ply (a run that only localised, or that was cut off)")
        if len(self.mesh.faces) == 0:
            raise MapError(f"the mesh of {self.folder} has no triangles, so there is nothing to export")
        return self.mesh

    @cached_property
    def volume(self) -> "TsdfVolume":
        """The map."""
        from dudmap.core.map.volume import TsdfVolume

        if not (self.folder / "map.npz").is_file():
            raise MapError(f"{self.folder} holds no map.npz, which this needs; repeat the run without --localize")
        return TsdfVolume.load(self.folder / "map.npz")

    @cached_property
    def movers(self) -> list[dict[str, Any]]:
        """Moving objects by frame, as in movers.jsonl."""
        path = self.folder / "movers.jsonl"
        if not path.is_file():
            return []
        try:
            return [parse_json(line) for line in read_text(path).splitlines() if line.strip()]
        except DAMAGE as error:
            raise DatasetError(f"{path} is damaged: {error}; repeat the run") from error

    @cached_property
    def calibration(self) -> Calibration | None:
        """Colour calibration of the run, or None."""
        path = self.folder / "calibration.toml"
        return Calibration.load(path) if path.is_file() else None

    def color_pose(self, timestamp: float) -> NDArray[np.float64]:
        """Pose (4, 4) of the colour camera at a time stamp, by the calibration; clamped to the trajectory."""
        calibration, stamps = self.calibration, self.trajectory.timestamps
        delay = 0.0 if calibration is None else calibration.delay
        T = self.trajectory.interpolate(float(np.clip(timestamp + delay, stamps[0], stamps[-1])))
        return T if calibration is None else T @ np.linalg.inv(calibration.T_color_depth)

    def mask_files(self) -> dict[float, Path]:
        """Dynamic masks by time stamp of the depth image."""
        from dudmap.io.sequences.masks import stamped_masks

        folder = self.folder / "masks"
        masks = dict(stamped_masks(folder)) if folder.is_dir() else {}
        if not masks:
            raise NoImagesError(f"{self.folder} holds no dynamic masks; repeat the run with --save-masks")
        return masks

    def frames_of(self, sequence: "Sequence") -> Iterator[tuple[int, NDArray[np.float64], Path]]:
        """Number, pose (4, 4) and mask of every frame that has both.

        Raises:
            DatasetError: The run has no masks, or no pose of the recording.
        """
        masks, found = self.mask_files(), False
        stamps = np.array(sorted(masks))
        for index, moment in enumerate(sequence.timestamps.tolist()):
            pose, mask = _index_at(self.trajectory.timestamps, moment), _index_at(stamps, moment)
            if pose is not None and mask is not None:
                found = True
                yield index, self.trajectory.Ts_world_camera[pose], masks[float(stamps[mask])]
        if not found:
            raise DatasetError(
                f"no frame of {sequence.name} has a pose in {self.folder}; name the run of this recording"
            )

    def color_camera(self, sequence: "Sequence") -> "Camera":
        """Camera of the recorded colour images: the depth camera if registered.

        Raises:
            DatasetError: They are not registered, and the run lacks their camera's pose.
        """
        if sequence.calibration is None:
            return sequence.camera
        if self.calibration is None:
            raise DatasetError(f"{self.folder} lacks calibration.toml, which a camera for colour needs; repeat the run")
        return self.calibration.camera


def _index_at(stamps: NDArray[np.float64], timestamp: float) -> int | None:
    nearest = int(np.argmin(np.abs(stamps - timestamp)))
    return nearest if abs(float(stamps[nearest]) - timestamp) <= NEAR else None


def _numbers(version: str) -> list[int]:
    return [int(number) for number in re.findall(r"\d+", version)[:2]]


Box = tuple[float, float, float, float, float, float]
SPECK = 4e-4
"""Smallest exported connected piece, square metres: 2 cm wide; smaller ones are noise."""
MESH_OPTIONS = ("max_triangles", "crop", "drop_pieces_below", "fill_holes")


@dataclass(frozen=True)
class ExportOptions:
    """Options of an export.

    Attributes:
        max_triangles: Limit.
        crop: Corners of the kept part of the map, metres, world frame.
        drop_pieces_below: Surface of omitted connected pieces, square metres.
        fill_holes: Longest border of closed holes, metres.
        up: Direction against gravity, world frame; None for the measured one, else the floor's normal.
        z_up: Whether surface and trajectory have z up from the floor, x along the first view.
        resolution: Edge of the cells of grids, metres.
        heights: Of the robot's lower and upper end above the floor, metres.
        sequence: Recording; None for the run's.
        camera: Its intrinsics, as for ``--camera``; None for the run's.
        every: Exports every N-th frame.
        texture: Width and height, pixels; None for vertex colours.
    """

    max_triangles: int | None = None
    crop: Box | None = None
    drop_pieces_below: float = SPECK
    fill_holes: float | None = None
    up: tuple[float, float, float] | None = None
    z_up: bool = False
    resolution: float = 0.05
    heights: tuple[float, float] = (0.1, 1.8)
    sequence: Path | None = None
    camera: str | None = None
    every: int = 1
    texture: int | None = None

    def check(self, taken: tuple[str, ...], name: str) -> None:
        """Check that a format takes all set options.

        Raises:
            ConfigError: It does not.
        """
        for field in fields(self):
            if getattr(self, field.name) != field.default and field.name not in taken:
                known = ", ".join(option_name(option) for option in taken) or "no option"
                raise ConfigError(f"{name} does not take {option_name(field.name)}; it takes {known}")
        if self.up is not None and "z_up" in taken and not self.z_up:
            raise ConfigError(f"{name} keeps the axes of the run, so --up changes nothing; add --z-up or leave it out")


def option_name(field: str) -> str:
    """Name of an option on the command line."""
    return "--" + field.replace("_", "-")
