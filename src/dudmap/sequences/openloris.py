"""OpenLORIS-Scene (Shi et al. 2020): RealSense D435i on a robot, depth registered to colour, truth of the robot."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import DatasetError
from dudmap.geometry import se3
from dudmap.geometry.association import TimedFile, associate, read_list
from dudmap.geometry.trajectory import Trajectory
from dudmap.input_files import LARGEST_TREE, read_text
from dudmap.sequences import intrinsics
from dudmap.sequences.image_folder import ImageFolder

if TYPE_CHECKING:
    import cv2

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
        colors, depths = read_list(self.path / "color.txt"), read_list(self.path / "aligned_depth.txt")
        pairs = associate(np.array([c.timestamp for c in colors]), np.array([d.timestamp for d in depths]))
        if not pairs:
            raise DatasetError(f"{self.path}: no image of color.txt lies within 20 ms of one of aligned_depth.txt")
        return [(colors[i], depths[j]) for i, j in pairs]

    def _find_intrinsics(self) -> intrinsics.Intrinsics:
        path = self.path / "sensors.yaml"
        storage = _open(path)  # kept: its nodes do not own what they point to
        node = storage.getNode(CAMERA_FRAME)
        numbers = _matrix(node, "intrinsics")
        if numbers is None or numbers.size != 4:
            raise DatasetError(f"{path} lacks the intrinsics (4 numbers) of {CAMERA_FRAME}")
        fx, cx, fy, cy = numbers.ravel().tolist()
        values = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "depth_scale": self.depth_scale}
        for key in ("width", "height"):
            if node.getNode(key).isInt():
                values[key] = node.getNode(key).real()
        return intrinsics.Intrinsics(values, "sensors.yaml")

    def _find_ground_truth(self) -> Trajectory | None:
        if not (self.path / "groundtruth.txt").is_file():
            return None
        truth, path = Trajectory.load(self.path / "groundtruth.txt"), self.path / "trans_matrix.yaml"
        if not path.is_file():
            return truth
        return Trajectory(truth.timestamps, truth.Ts_world_camera @ _motion(path, BODY_FRAME, CAMERA_FRAME))


def _open(path: Path) -> "cv2.FileStorage":
    import cv2

    try:
        text = read_text(path, LARGEST_TREE)
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot read {path}: {error}") from error
    except (cv2.error, SystemError):
        raise DatasetError(f"cannot read {path}; expected OpenCV's form of YAML, which starts with %YAML:1.0") from None
    if not storage.isOpened() or not storage.root().isMap():
        raise DatasetError(f"{path} holds no keys; expected those of OpenLORIS-Scene")
    return storage


def _matrix(node: "cv2.FileNode", key: str) -> NDArray[np.float64] | None:
    """Matrix of up to 16 numbers under a key of a node; None if there is none.

    ``FileNode.mat`` is not used: it writes outside of its memory where the size is not that of the data (OpenCV 4).
    """
    if not node.isMap() or not node.getNode(key).isMap():
        return None
    rows, columns, data = (node.getNode(key).getNode(name) for name in ("rows", "cols", "data"))
    if not (rows.isInt() and columns.isInt() and data.isSeq() and data.size() <= 16):
        return None
    numbers = [data.at(k) for k in range(data.size())]
    shape = int(rows.real()), int(columns.real())
    if min(shape) < 1 or shape[0] * shape[1] != len(numbers) or not all(n.isInt() or n.isReal() for n in numbers):
        return None
    return np.array([number.real() for number in numbers], dtype=np.float64).reshape(shape)


def _motion(path: Path, parent: str, child: str) -> NDArray[np.float64]:
    """T_parent_child (4, 4) along the tree of the file; a matrix takes points of the child frame to the parent frame.

    Raises:
        DatasetError: The frames are not connected.
    """
    storage = _open(path)
    list_node = storage.getNode("trans_matrix")
    edges: dict[str, dict[str, NDArray[np.float64]]] = {}
    for index in range(list_node.size() if list_node.isSeq() else 0):
        node = list_node.at(index)
        T_a_b = _matrix(node, "matrix")
        if T_a_b is None or T_a_b.shape != (4, 4):
            raise DatasetError(f"{path}: entry {index + 1} of trans_matrix has no 4x4 matrix")
        a, b = node.getNode("parent_frame").string(), node.getNode("child_frame").string()
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
