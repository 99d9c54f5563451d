"""ScanNet (Dai et al. 2017) as its SensReader exports it: folders color, depth, pose and intrinsic."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.errors import DatasetError
from dudmap.io.sequences import images, intrinsics
from dudmap.io.sequences.image_folder import ImageFolder
from dudmap.io.sequences.poses import read_matrix


class ScanNetSequence(ImageFolder):
    """Folder with ``color/0.jpg``, ``depth/0.png`` (mm), ``pose/0.txt`` (camera to world) and ``intrinsic/``.

    Colour and depth have their own intrinsics (4x4 matrices) and, where exported, extrinsics E that take the points of
    a camera to a common frame: ``T_color_depth = E_color^-1 E_depth``. Frames whose pose is infinite were lost by the
    data set's own system and have no truth.
    """

    format = "ScanNet export"
    color_files, pose_files = ("color", r"(\d+)\.(?:jpe?g|png)"), ("pose", r"(\d+)\.txt")

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether a folder has this layout."""
        folders = all((path / kind).is_dir() for kind in ("color", "depth", "pose"))
        return folders and _parameter(path, "intrinsic_depth.txt") is not None

    def _find_intrinsics(self) -> intrinsics.Intrinsics:
        depth = self._values("depth")
        color = self._values("color")
        height, width = images.read_color(self._pairs[0][0].path).shape[:2]
        return intrinsics.Intrinsics(
            depth,
            "intrinsic_depth.txt and intrinsic_color.txt",
            color | {"width": width, "height": height},
            se3.inverse(self._extrinsic("depth")) @ self._extrinsic("color"),
        )

    def _values(self, kind: str) -> dict[str, float]:
        file = _parameter(self.path, f"intrinsic_{kind}.txt")
        if file is None:
            raise DatasetError(f"{self.path} lacks intrinsic/intrinsic_{kind}.txt; export it with SensReader")
        K = read_matrix(file)
        return {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}

    def _extrinsic(self, kind: str) -> NDArray[np.float64]:
        file = _parameter(self.path, f"extrinsic_{kind}.txt")
        return np.eye(4) if file is None else read_matrix(file)


def _parameter(path: Path, name: str) -> Path | None:
    """File of the folder ``intrinsic``, or beside the images under the name of the 25k subset."""
    places = (path / "intrinsic" / name, path / name, path / name.replace("intrinsic_", "intrinsics_"))
    return next((place for place in places if place.is_file()), None)
