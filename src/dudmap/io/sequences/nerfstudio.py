"""nerfstudio's transforms.json with depth images: what its converters and many phone apps export."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.association import TimedFile
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError
from dudmap.input_files import read_json
from dudmap.io.sequences import images
from dudmap.io.sequences.camera_files import values_of
from dudmap.io.sequences.image_folder import FRAME_RATE, ImageFolder
from dudmap.io.sequences.intrinsics import Intrinsics
from dudmap.io.sequences.poses import OPENGL_AXES, rigid_trajectory

MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "")


class NerfstudioSequence(ImageFolder):
    """Folder with transforms.json, whose frames name ``file_path``, ``depth_file_path`` and ``transform_matrix``.

    Frames are in the order of their images' names and 30 a second, unless each has a ``timestamp``. Depth is 16 bit,
    ``depth_unit_scale_factor`` (default 0.001) metres a unit, or float metres in a .npy file; it shows the same view as
    the colour image, often smaller. Intrinsics per frame are replaced by their median. Matrices are camera to world
    with OpenGL axes; poses of a structure-from-motion program have no metric scale, which makes them useless as truth.
    """

    format = "nerfstudio"
    layout = ("transforms.json",)

    def __init__(self, path: str | Path, camera: Camera | str | None = None) -> None:
        file = Path(path) / "transforms.json"
        try:
            self._tree: dict[str, Any] = read_json(file)
            frames = self._tree["frames"]
            self._frames = sorted((frame for frame in frames if "depth_file_path" in frame), key=_order)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DatasetError(f"cannot read {file}: {error!r}") from error
        if not self._frames:
            raise DatasetError(f"{file} names no depth images: none of its {len(frames)} frames has a depth_file_path")
        self.depth_scale = 1.0 / float(self._tree.get("depth_unit_scale_factor", 0.001))
        super().__init__(path, camera)

    def _find_pairs(self) -> list[tuple[TimedFile, TimedFile]]:
        stamps = self._stamps()
        return [
            (TimedFile(t, self.path / frame["file_path"]), TimedFile(t, self.path / frame["depth_file_path"]))
            for t, frame in zip(stamps, self._frames, strict=True)
        ]

    def _stamps(self) -> list[float]:
        given = [frame.get("timestamp") for frame in self._frames]
        if all(isinstance(stamp, int | float) for stamp in given) and np.all(np.diff(given) > 0):
            return [float(stamp) for stamp in given]
        self.timed = False
        return [n / FRAME_RATE for n in range(len(self._frames))]

    def _find_intrinsics(self) -> Intrinsics:
        model = self._tree.get("camera_model", "")
        if model not in MODELS:
            raise DatasetError(f"{self.path}/transforms.json has the camera model {model}; expected OPENCV or PINHOLE")
        found = [values for frame in self._frames if (values := values_of(self._tree | frame)) is not None]
        if not found:
            raise DatasetError(f"{self.path}/transforms.json lacks fl_x, fl_y, cx or cy; give --camera fx,fy,cx,cy")
        return self._one_view(found, "transforms.json")

    def _read_depth(self, path: Path, depth_scale: float) -> NDArray[np.float32]:
        return images.read_depth_array(path) if path.suffix == ".npy" else images.read_depth(path, depth_scale)

    def _find_ground_truth(self) -> Trajectory | None:
        scale = float(self._tree.get("applied_scale", 1.0))
        poses = []
        for stamp, frame in zip(self.timestamps, self._frames, strict=True):
            T = np.array(frame.get("transform_matrix", []), dtype=np.float64)
            if T.shape == (4, 4):
                T = T @ OPENGL_AXES
                T[:3, 3] /= scale
                poses.append((float(stamp), T))
        return rigid_trajectory(poses)


def _order(frame: dict[str, Any]) -> tuple[int, str]:
    """Name of the image, shorter ones first, so that frame_2 comes before frame_10."""
    return len(frame["file_path"]), frame["file_path"]
