"""A saved map that a later run continues."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import atomic_file
from dudmap.core.dynamics.detector import DynamicDetector
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.place_recognition import Keyframe, KeyframeDatabase, PlacedFeatures
from dudmap.core.tracking.quality_monitor import RegistrationHistory
from dudmap.errors import ConfigError, MapError
from dudmap.input_files import DAMAGE, open_arrays

MAP_FILE, KEYFRAME_FILE = "map.npz", "keyframes.npz"
KIND, VERSION = "dudmap keyframes", 1
"""Content and version of a keyframe file; older programs refuse a higher version."""


@dataclass(frozen=True, eq=False)
class SavedMap:
    """The main map of a run, in the world frame of that run.

    Attributes:
        volume: The map.
        keyframes: Keyframes of the main submap.
        registrations: Last residuals, which judge the first registrations of the next run.
        folder: Folder of the map.
    """

    volume: TsdfVolume
    keyframes: list[Keyframe] = field(repr=False)
    registrations: RegistrationHistory = field(default_factory=RegistrationHistory, repr=False)
    folder: Path = Path()

    @classmethod
    def load(cls, folder: str | Path, voxel_size: float | None = None) -> "SavedMap":
        """Read the map of a run folder; ``voxel_size``: required one (m), or None.

        Raises:
            MapError: A file is missing, damaged or of a newer version, or there are no keyframes.
            ConfigError: The map has another voxel size.
        """
        folder = Path(folder)
        missing = [name for name in (MAP_FILE, KEYFRAME_FILE) if not (folder / name).is_file()]
        if missing:
            raise MapError(
                f"{folder} holds no {' and no '.join(missing)}, so no map to continue; name a complete run folder"
            )
        keyframes, registrations, stored_size = load_keyframes(folder / KEYFRAME_FILE)
        if voxel_size is not None and not np.isclose(voxel_size, stored_size):
            raise ConfigError(
                f"the map in {folder} has voxels of {stored_size:g} m, the run is to have {voxel_size:g} m; set "
                f"volume.voxel_size={stored_size:g}"
            )
        if not keyframes:
            raise MapError(f"{folder / KEYFRAME_FILE} holds no keyframe, so that no place can be recognised in the map")
        volume = TsdfVolume.load(folder / MAP_FILE)
        if not np.isclose(volume.voxel_size, stored_size):
            raise MapError(
                f"{folder} is mixed up: {MAP_FILE} has voxels of {volume.voxel_size:g} m, {KEYFRAME_FILE} belongs to a "
                f"map with {stored_size:g} m; repeat the run"
            )
        return cls(volume, keyframes, registrations, folder)

    def save_keyframes(self, path: str | Path) -> None:
        """Write everything except the volume.

        Raises:
            MapError: The file cannot be written.
        """
        features = [keyframe.features for keyframe in self.keyframes]
        try:
            with atomic_file(path) as file:
                np.savez_compressed(
                    file,
                    format=f"{KIND} {VERSION}",
                    voxel_size=self.volume.voxel_size,
                    timestamps=np.array([keyframe.timestamp for keyframe in self.keyframes], np.float64),
                    Ts_world_camera=np.array([k.T_world_camera for k in self.keyframes], np.float64).reshape(-1, 4, 4),
                    counts=np.array([len(part) for part in features], np.int64),
                    points=_stacked([part.points for part in features], 3, np.float32),
                    descriptors=_stacked([part.descriptors for part in features], 128, np.float16),
                    residuals=np.array(self.registrations.residuals, np.float64),
                    shares=np.array(self.registrations.shares, np.float64),
                    colors=np.array(self.registrations.colors, np.float64),
                )
        except OSError as error:
            raise MapError(f"cannot write the keyframes to {path}: {error}") from error


def load_keyframes(path: str | Path) -> tuple[list[Keyframe], RegistrationHistory, float]:
    """Keyframes, registrations and voxel size (m) of a keyframe file.

    Descriptors have 11 bits and points 24, far below their noise.

    Raises:
        MapError: The file is missing, damaged or of a newer version.
    """
    try:
        with open_arrays(path) as data:
            kind, _, version = str(data["format"]).rpartition(" ")
            if kind != KIND or not version.isdigit():
                raise MapError(f"{path} is no keyframe file of dudmap: its format is {str(data['format'])!r}")
            if int(version) > VERSION:
                raise MapError(
                    f"{path} has version {version} and this program reads up to {VERSION}; update dudmap to use the map"
                )
            _check_arrays(data)
            ends = np.cumsum(data["counts"])[:-1]
            points = np.split(data["points"].astype(np.float64), ends)
            descriptors = np.split(data["descriptors"].astype(np.float32), ends)
            keyframes = [
                Keyframe(float(stamp), T, PlacedFeatures(part, xyz))
                for stamp, T, part, xyz in zip(
                    data["timestamps"], data["Ts_world_camera"], descriptors, points, strict=False
                )
            ]
            if len(keyframes) != len(data["counts"]) or sum(map(len, points)) != data["counts"].sum():
                raise MapError(f"{path} is damaged: its keyframes and their features differ in number; repeat the run")
            registrations = RegistrationHistory(
                *(tuple(float(x) for x in data[name]) for name in ("residuals", "shares", "colors"))
            )
            return keyframes, registrations, float(data["voxel_size"])
    except DAMAGE as error:
        raise MapError(f"{path} is not a readable keyframe file: {error}") from error


def _check_arrays(data: "Mapping[str, NDArray]") -> None:
    n, total = len(data["counts"]), len(data["points"])
    wanted = {
        "counts": ("iu", (n,)), "timestamps": ("f", (n,)), "Ts_world_camera": ("f", (n, 4, 4)),
        "points": ("f", (total, 3)), "descriptors": ("f", (total, 128)), "residuals": ("f", None),
        "shares": ("f", None), "colors": ("f", None), "voxel_size": ("f", ()),
    }  # fmt: skip
    for name, (kinds, shape) in wanted.items():
        array = data[name]
        if array.dtype.kind not in kinds or array.shape != (shape if shape is not None else (array.size,)):
            raise ValueError(f"{name} is {array.dtype} {array.shape}")
    if np.any(data["counts"] < 0) or np.any(data["counts"] > total):
        raise ValueError("a keyframe has an impossible number of features")
    if not all(np.isfinite(data[name]).all() for name in ("timestamps", "Ts_world_camera", "points", "descriptors")):
        raise ValueError("a time, a pose or a feature is not finite")
    if not data["voxel_size"] > 0:
        raise ValueError(f"the voxel size is {data['voxel_size']} m")


def _stacked(parts: Iterable[NDArray], width: int, dtype: type) -> NDArray:
    return np.concatenate([np.empty((0, width), dtype), *(part.astype(dtype) for part in parts)])


@dataclass(frozen=True, eq=False)
class PriorMap:
    """The map of a first pass, for a second pass.

    Attributes:
        volume: Map of the largest submap.
        submap: Its number.
        Ts_world_camera: Poses (4, 4) of its frames by timestamp.
        keyframes: Keyframes of all submaps.
        detector: The dynamic detector, with its state of the first seconds.
    """

    volume: TsdfVolume
    submap: int
    Ts_world_camera: dict[float, NDArray[np.float64]]
    keyframes: KeyframeDatabase
    detector: DynamicDetector
