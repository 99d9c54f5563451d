"""BOP (Hodan et al. 2018): a scene of the benchmark for poses of objects, with its cameras in scene_camera.json."""

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from dudmap.core.geometry import se3
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError
from dudmap.input_files import DAMAGE, read_json
from dudmap.io.sequences import intrinsics
from dudmap.io.sequences.numbered import NumberedSequence
from dudmap.io.sequences.poses import rigid_trajectory

FILE = "scene_camera.json"
LARGEST_CHANGE = 0.5
"""Largest difference of the intrinsics of two images, pixels: below what shifts an edge by a pixel."""


class BopSequence(NumberedSequence):
    """Folder with rgb/000000.png, depth/000000.png and scene_camera.json, which holds ``cam_K`` by image number.

    ``depth_scale`` there is millimetres per unit. ``cam_R_w2c`` (row by row) and ``cam_t_w2c`` (mm), if they are there,
    take points of the world to the camera and are the truth (bop_toolkit, docs/bop_datasets_format.md).
    """

    format = "BOP"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether a folder has this layout."""
        return (path / FILE).is_file() and NumberedSequence.recognises(path)

    @cached_property
    def _cameras(self) -> dict[int, dict[str, Any]]:
        """Entries of the file by number of the image, of the frames that there are."""
        try:
            found = {int(number): entry for number, entry in read_json(self.path / FILE).items()}
            return {int(depth.path.stem): found[int(depth.path.stem)] for _, depth in self._pairs}
        except DAMAGE as error:
            raise DatasetError(f"{self.path / FILE} does not give the camera of every image: {error!r}") from error

    def _find_intrinsics(self) -> intrinsics.Intrinsics:
        try:
            rows = [(*entry["cam_K"], 1000.0 / entry["depth_scale"]) for entry in self._cameras.values()]
            numbers = np.array(rows, dtype=np.float64)
        except DAMAGE as error:
            raise DatasetError(f"{self.path / FILE} lacks cam_K or depth_scale of an image: {error!r}") from error
        change = float(np.ptp(numbers, axis=0).max())
        if change > LARGEST_CHANGE:
            raise DatasetError(
                f"{self.path / FILE}: the camera changes by up to {change:g} from image to image; expected one camera"
            )
        known = intrinsics.from_matrix(numbers[0, :9], self.path / FILE)
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
