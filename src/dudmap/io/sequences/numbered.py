"""Numbered images in any plain folder: exports of ZED, RealSense, Azure Kinect, your own camera."""

import re
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.geometry.association import TimedFile
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.times import time_unit
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError
from dudmap.input_files import DAMAGE, read_json, read_text
from dudmap.io.sequences import image_series, intrinsics
from dudmap.io.sequences.image_folder import ImageFolder
from dudmap.io.sequences.image_numbers import are_times, keys, last_number
from dudmap.io.sequences.pose_matrices import read_matrices, rigid_trajectory

POSES = ("poses.txt", "pose.txt", "poses", "pose")


class NumberedSequence(ImageFolder):
    """Numbered images in two folders (``color/000001.png``, ``depth/000001.png``) or one, told apart by words, content,
    or patterns (``image_series``). Equal numbers pair, 30 frames a second; numbers above 10^8 are times, within 20 ms.

    The ground truth is groundtruth.txt, or matrices camera to world in poses.txt or a folder ``pose`` or ``poses``.

    Args:
        color, depth: Patterns such as ``frames/*.jpg``, for ambiguous names.

    Raises:
        DatasetError: As for ``ImageFolder``; or a pattern matches nothing, or the ground truth is malformed.
    """

    format = "numbered images"
    options = (*ImageFolder.options, "color", "depth")

    def __init__(
        self, path: str | Path, camera: Camera | str | None = None, color: str | None = None, depth: str | None = None
    ) -> None:
        self._patterns = {"color": color, "depth": depth}
        super().__init__(path, camera)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a folder holds depth and colour by words of names."""
        return path.is_dir() and all(image_series.by_names(path).values())

    def _find_pairs(self) -> list[tuple[TimedFile, TimedFile]]:
        found = image_series.find(self.path, self._patterns)
        if not found or (depth := found["depth"]) is None:
            raise DatasetError(image_series.unknown(self.path))
        color = found["color"] or depth
        numbers = keys(color.files, depth.files)
        self._numbers = dict(zip(color.files + depth.files, numbers[0] + numbers[1], strict=True))
        colors, depths = (dict(zip(n, one.files, strict=True)) for n, one in zip(numbers, (color, depth), strict=True))
        if are_times(numbers):
            pairs = self._pair_timed(_timed(colors), _timed(depths))
        else:
            first, second = ({int(n): file for n, file in files.items()} for files in (colors, depths))
            pairs = self._pair_numbered(first, second)
        return pairs if found["color"] else self._alone([depth for _, depth in pairs])

    def set_rate(self, fps: float) -> None:
        """As for ``ImageFolder``; groundtruth.txt has its own times."""
        super().set_rate(fps)
        self._take_truth()

    def _find_ground_truth(self) -> Trajectory | None:
        if (truth := self._stamped_poses()) is not None:
            return truth
        for name in POSES:
            place = self.path / name
            if place.is_file():
                return rigid_trajectory(zip(self.timestamps.tolist(), self._matrices(place), strict=True))
            files = {last_number(file): file for file in place.glob("*.txt") if re.search(r"\d", file.stem)}
            stamps = {self._numbers[depth.path]: depth.timestamp for _, depth in self._pairs}
            if files:
                known = sorted(files.keys() & stamps.keys())
                return rigid_trajectory((stamps[number], read_matrices(files[number])[0]) for number in known)
        return None

    def _matrices(self, file: Path) -> NDArray[np.float64]:
        poses = read_matrices(file)
        if len(poses) != len(self):
            raise DatasetError(
                f"{file}, line {len(read_text(file).splitlines())}: the last pose is number {len(poses)}, but there "
                f"are {len(self)} frames; expected one pose per frame: complete the file, or move it away"
            )
        return poses


def _timed(files: dict[float, Path]) -> list[TimedFile]:
    unit = time_unit(list(files))
    return sorted(TimedFile(number / unit.per_second, file, unit) for number, file in files.items())


BOP_FILE = "scene_camera.json"
LARGEST_CHANGE = 0.5
"""Largest difference of two images' intrinsics, pixels."""


class BopSequence(NumberedSequence):
    """Scene of BOP (Hodan et al. 2018): rgb/, depth/ and scene_camera.json.

    It holds ``cam_K`` by image number and ``depth_scale``, millimetres per unit. Optional ``cam_R_w2c`` (by rows) and
    ``cam_t_w2c`` (mm), world to camera, are the ground truth (bop_toolkit, docs/bop_datasets_format.md).
    """

    format = "BOP"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a folder has this layout."""
        return (path / BOP_FILE).is_file() and super().recognises(path)

    @cached_property
    def _cameras(self) -> dict[int, dict[str, Any]]:
        try:
            found = {int(number): entry for number, entry in read_json(self.path / BOP_FILE).items()}
            return {int(depth.path.stem): found[int(depth.path.stem)] for _, depth in self._pairs}
        except DAMAGE as error:
            raise DatasetError(f"{self.path / BOP_FILE} does not give the camera of every image: {error!r}") from error

    def _find_intrinsics(self) -> intrinsics.Intrinsics:
        try:
            rows = [(*entry["cam_K"], 1000.0 / entry["depth_scale"]) for entry in self._cameras.values()]
            numbers = np.array(rows, dtype=np.float64)
        except DAMAGE as error:
            raise DatasetError(f"{self.path / BOP_FILE} lacks cam_K or depth_scale of an image: {error!r}") from error
        change = float(np.ptp(numbers, axis=0).max())
        if change > LARGEST_CHANGE:
            raise DatasetError(
                f"{self.path / BOP_FILE}: the camera changes by up to {change:g} from image to image; expected "
                "one camera"
            )
        known = intrinsics.from_matrix(numbers[0, :9], self.path / BOP_FILE)
        return intrinsics.Intrinsics(known.values | {"depth_scale": float(numbers[0, 9])}, known.source)

    def _find_ground_truth(self) -> Trajectory | None:
        poses = []
        for stamp, entry in zip(self.timestamps.tolist(), self._cameras.values(), strict=True):
            if "cam_R_w2c" in entry and "cam_t_w2c" in entry:
                T = np.eye(4)
                T[:3, :3] = np.reshape(entry["cam_R_w2c"], (3, 3))
                T[:3, 3] = np.asarray(entry["cam_t_w2c"]) / 1000
                poses.append((stamp, se3.inverse(T)))
        return rigid_trajectory(poses) if poses else super()._find_ground_truth()
