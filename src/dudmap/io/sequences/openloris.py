"""OpenLORIS-Scene (Shi et al. 2020): RealSense D435i on a robot, depth registered to colour, truth of the robot."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.geometry.association import TimedFile, read_list
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError
from dudmap.io.sequences import intrinsics
from dudmap.io.sequences.image_folder import ImageFolder
from dudmap.io.sequences.yaml_files import read_yaml

CAMERA_FRAME, BODY_FRAME = "d400_color_optical_frame", "base_link"


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
        return self._pair_timed(read_list(self.path / "color.txt"), read_list(self.path / "aligned_depth.txt"))

    def _find_intrinsics(self) -> intrinsics.Intrinsics:
        path = self.path / "sensors.yaml"
        node = read_yaml(path).get(CAMERA_FRAME) or {}
        numbers = _matrix(node, "intrinsics")
        if numbers is None or numbers.size != 4:
            raise DatasetError(f"{path} lacks the intrinsics (4 numbers) of {CAMERA_FRAME}")
        fx, cx, fy, cy = numbers.ravel().tolist()
        values = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
        for key in ("width", "height"):
            if isinstance(node.get(key), int | float):
                values[key] = float(node[key])
        return intrinsics.Intrinsics(values, "sensors.yaml")

    def _find_ground_truth(self) -> Trajectory | None:
        if not (self.path / "groundtruth.txt").is_file():
            return None
        truth, path = Trajectory.load(self.path / "groundtruth.txt"), self.path / "trans_matrix.yaml"
        if not path.is_file():
            return truth
        return Trajectory(truth.timestamps, truth.Ts_world_camera @ _motion(path, BODY_FRAME, CAMERA_FRAME))


def _matrix(node: Any, key: str) -> NDArray[np.float64] | None:  # noqa: ANN401 - a value of a YAML file
    """Matrix under a key of a node, as OpenCV writes it; None if there is none."""
    try:
        rows, columns, numbers = (node[key][name] for name in ("rows", "cols", "data"))
        return np.array(numbers, dtype=np.float64).reshape(max(int(rows), 0), max(int(columns), 0))
    except (TypeError, KeyError, ValueError, OverflowError):
        return None


def _motion(path: Path, parent: str, child: str) -> NDArray[np.float64]:
    """T_parent_child (4, 4) along the tree of the file; a matrix takes points of the child frame to the parent frame.

    Raises:
        DatasetError: The frames are not connected.
    """
    entries = read_yaml(path).get("trans_matrix")
    edges: dict[str, dict[str, NDArray[np.float64]]] = {}
    for index, node in enumerate(entries if isinstance(entries, list) else []):
        T_a_b = _matrix(node, "matrix")
        if T_a_b is None or T_a_b.shape != (4, 4):
            raise DatasetError(f"{path}: entry {index + 1} of trans_matrix has no 4x4 matrix")
        a, b = str(node.get("parent_frame")), str(node.get("child_frame"))
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
