"""OpenLORIS-Scene (Shi et al. 2020): RealSense D435i on a robot, depth registered to colour, truth of the robot."""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import DatasetError
from dudmap.geometry import se3
from dudmap.geometry.association import TimedFile, associate, read_list
from dudmap.geometry.trajectory import Trajectory
from dudmap.input_files import read_text
from dudmap.sequences import intrinsics
from dudmap.sequences.image_folder import ImageFolder

CAMERA_FRAME, BODY_FRAME = "d400_color_optical_frame", "base_link"
LARGEST_YAML = 2**20
"""Largest file of parameters, bytes; they have some kilobytes."""
MATRIX = r"[^\[]{0,200}\[([^\[\]]*)\]"
"""Numbers of a matrix as OpenCV writes it in YAML: rows, columns, type and ``data: [ ... ]``."""
EDGE = r"parent_frame:\s*(\w+)\s+child_frame:\s*(\w+)\s+matrix:" + MATRIX


class OpenLorisSequence(ImageFolder):
    """Folder of the "package" form with color.txt, aligned_depth.txt, sensors.yaml and trans_matrix.yaml.

    Intrinsics are stored in the order fx, cx, fy, cy. groundtruth.txt holds poses of the robot (``base_link``); those
    of the camera follow from the tree of motions in trans_matrix.yaml.
    """

    format = "OpenLORIS-Scene"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether a folder has this layout."""
        return all((path / name).is_file() for name in ("color.txt", "aligned_depth.txt", "sensors.yaml"))

    def _find_pairs(self) -> list[tuple[TimedFile, TimedFile]]:
        colors, depths = read_list(self.path / "color.txt"), read_list(self.path / "aligned_depth.txt")
        pairs = associate(np.array([c.timestamp for c in colors]), np.array([d.timestamp for d in depths]))
        if not pairs:
            raise DatasetError(f"{self.path}: no image of color.txt lies within 20 ms of one of aligned_depth.txt")
        return [(colors[i], depths[j]) for i, j in pairs]

    def _find_intrinsics(self) -> intrinsics.Intrinsics:
        path = self.path / "sensors.yaml"
        found = re.search(rf"^{CAMERA_FRAME}:.*\n((?:[ \t].*\n)*)", read_text(path, LARGEST_YAML) + "\n", re.MULTILINE)
        block = found[1] if found else ""
        numbers = re.search(r"^\s+intrinsics:" + MATRIX, block, re.MULTILINE)
        values = [float(number) for number in numbers[1].split(",")] if numbers else []
        if len(values) != 4:
            raise DatasetError(f"{path} lacks the intrinsics (4 numbers) of {CAMERA_FRAME}")
        camera = dict(zip(("fx", "cx", "fy", "cy"), values, strict=True)) | {"depth_scale": self.depth_scale}
        sizes = re.findall(r"^\s+(width|height):\s*(\d{1,9})\s*$", block, re.MULTILINE)
        return intrinsics.Intrinsics(camera | {key: float(value) for key, value in sizes}, "sensors.yaml")

    def _find_ground_truth(self) -> Trajectory | None:
        if not (self.path / "groundtruth.txt").is_file():
            return None
        truth, path = Trajectory.load(self.path / "groundtruth.txt"), self.path / "trans_matrix.yaml"
        if not path.is_file():
            return truth
        return Trajectory(truth.timestamps, truth.Ts_world_camera @ _motion(path, BODY_FRAME, CAMERA_FRAME))


def _motion(path: Path, parent: str, child: str) -> NDArray[np.float64]:
    """T_parent_child (4, 4) along the tree of the file; a matrix takes points of the child frame to the parent frame.

    Raises:
        DatasetError: The frames are not connected.
    """
    edges: dict[str, dict[str, NDArray[np.float64]]] = {}
    for a, b, data in re.findall(EDGE, read_text(path, LARGEST_YAML)):
        numbers = [float(number) for number in data.split(",")]
        if len(numbers) != 16:
            raise DatasetError(f"{path}: the motion from {b} to {a} has {len(numbers)} numbers; expected a 4x4 matrix")
        T_a_b = np.array(numbers).reshape(4, 4)
        edges.setdefault(a, {})[b] = T_a_b
        edges.setdefault(b, {})[a] = se3.inverse(T_a_b)
    reached = {parent: np.eye(4)}
    queue = [parent]
    while queue:
        frame = queue.pop()
        for neighbour, T in edges.get(frame, {}).items():
            if neighbour not in reached:
                reached[neighbour] = reached[frame] @ T
                queue.append(neighbour)
    if child not in reached:
        raise DatasetError(f"{path} does not connect {parent} with {child}")
    return reached[child]
