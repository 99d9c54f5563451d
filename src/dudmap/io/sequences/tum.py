"""Folders with lists of stamped images: TUM RGB-D benchmark (Sturm et al. 2012) and similar."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.geometry.association import TimedFile, associate, read_list, read_pairs
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import TUM_HEADER, Trajectory
from dudmap.errors import DatasetError, FrameError
from dudmap.input_files import read_text
from dudmap.io.sequences import images, intrinsics
from dudmap.io.sequences.archive import origin, unpack
from dudmap.io.sequences.camera_values import read_yaml
from dudmap.io.sequences.image_folder import ImageFolder, size
from dudmap.io.sequences.intrinsics import camera_values


class TumSequence(ImageFolder):
    """rgb.txt, depth.txt and optionally associations.txt, intrinsics.txt, groundtruth.txt, mask.txt.

    Without rgb.txt and rgb/ it is depth alone. associations.txt (``t_rgb rgb_file t_depth depth_file``) pairs images;
    else nearest first, at most 20 ms apart. Frames have the depth's timestamp.

    Intrinsics: ``camera``, a file, or freiburg1-3 in the name of the folder or of the bag in rgb.txt. Coefficients in
    intrinsics.txt (k1 k2 p1 p2 k3) apply to both images. The published distortion of freiburg1 and 2 is of the colour
    lens; depth was reprojected without it.
    """

    format = "TUM RGB-D"
    depth_scale = intrinsics.DEPTH_SCALE
    cameras = (
        (r"(freiburg|fr)1(?!\d)", "TUM freiburg1", camera_values(517.3, 516.5, 318.6, 255.3, 640, 480, 5000)),
        (r"(freiburg|fr)2(?!\d)", "TUM freiburg2", camera_values(520.9, 521.0, 325.1, 249.7, 640, 480, 5000)),
        (r"(freiburg|fr)3(?!\d)", "TUM freiburg3", camera_values(535.4, 539.2, 320.1, 247.6, 640, 480, 5000)),
    )
    """Name pattern, name, and published intrinsics of each camera."""

    def __init__(self, path: str | Path, camera: Camera | str | None = None) -> None:
        super().__init__(path, camera)
        self._masks = self._find_masks()

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a folder has this layout."""
        lists = (path / "rgb.txt").is_file() or not (path / "rgb").is_dir()
        return (lists and (path / "depth.txt").is_file()) or (path / "associations.txt").is_file()

    def mask(self, index: int) -> NDArray[np.bool_] | None:
        """True dynamic mask (H, W), or None.

        Raises:
            FrameError: Unreadable or of another size.
        """
        path = self._masks.get(range(len(self))[index])
        if path is None:
            return None
        mask = images.read_mask(path)
        if mask.shape != self.camera.shape:
            raise FrameError(f"the mask {path} is {size(mask)} pixels; expected the size of the recording's frames")
        return mask

    def _find_pairs(self) -> list[tuple[TimedFile, TimedFile]]:
        associations = self.path / "associations.txt"
        if associations.is_file():
            return read_pairs(associations)
        depths = read_list(self.path / "depth.txt")
        if not (self.path / "rgb.txt").is_file():
            return self._alone(depths)
        return self._pair_timed(read_list(self.path / "rgb.txt"), depths)

    def _published(self) -> intrinsics.Intrinsics | None:
        names = self.path.resolve().name, _bag_name(self.path / "rgb.txt")
        named = (
            intrinsics.by_name(name, values)
            for recording in names
            for pattern, name, values in self.cameras
            if re.search(pattern, recording, re.IGNORECASE)
        )
        return super()._published() or next(named, None)

    def _find_ground_truth(self) -> Trajectory | None:
        return self._stamped_poses()

    def _find_masks(self) -> dict[int, Path]:
        path = self.path / "mask.txt"
        if not path.is_file():
            return {}
        masks = read_list(path)
        colors = self.color_timestamps
        order = np.argsort(colors, kind="stable")
        pairs = associate(np.array([mask.timestamp for mask in masks]), colors[order])
        return {int(order[j]): masks[i].path for i, j in pairs}


def _bag_name(path: Path) -> str:
    if not path.is_file():
        return ""
    for line in read_text(path).splitlines():
        found = re.match(r"#\s*file:\s*'(.*)'", line)
        if found or not line.startswith("#"):
            return found.group(1) if found else ""
    return ""


T_ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Axes of Bonn's motion capture relative to the point cloud; its own inverse (page of the data set)."""
T_MARKER_CAMERA = np.array(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
        [0, 0, 0, 1],
    ]
)
"""T_m of the data set's page, camera to markers; its scale 1.0593 is removed."""


BONN_NAME = re.compile("rgbd_bonn", re.IGNORECASE)


def holds_bonn_markers(path: Path) -> bool:
    """Whether true poses are Bonn's as published, by names of file and folder."""
    inside = path.name == "groundtruth.txt" and BONN_NAME.search(path.resolve().parent.name)
    named = BONN_NAME.search(path.name) and re.search("gt|ground", path.name, re.IGNORECASE)
    return bool(inside or named) and path.is_file() and not read_text(path).startswith(TUM_HEADER)


def bonn_camera_poses(Ts_marker: NDArray[np.float64]) -> NDArray[np.float64]:
    """Camera poses ``T_ROS^-1 T T_ROS T_m`` (N, 4, 4) of marker poses T, in the point cloud's frame."""
    T_marker_camera = T_MARKER_CAMERA.copy()
    T_marker_camera[:3, :3] = se3.nearest_rotation(T_MARKER_CAMERA[:3, :3])
    return T_ROS @ Ts_marker @ T_ROS @ T_marker_camera


class BonnSequence(TumSequence):
    """``rgbd_bonn_*`` of the Bonn RGB-D Dynamic Dataset (Palazzolo et al. 2019).

    Poses of the markers in groundtruth.txt become camera poses (``bonn_camera_poses``) in the frame of
    ``rgbd_bonn_groundtruth_1mm_section.ply``.
    """

    format = "Bonn RGB-D Dynamic"
    published = "Bonn", camera_values(542.822841, 542.576870, 315.593520, 237.756098, 640, 480, 5000)
    truth = "marker poses converted to camera poses"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a folder has the layout and the name of this data set."""
        return super().recognises(path) and BONN_NAME.search(path.resolve().name) is not None

    def _find_ground_truth(self) -> Trajectory | None:
        truth = super()._find_ground_truth()
        if truth is None or not holds_bonn_markers(self.path / "groundtruth.txt"):
            return truth
        return replace(truth, Ts_world_camera=bonn_camera_poses(truth.Ts_world_camera))


class CorbsSequence(TumSequence):
    """``D1_pre_registereddata`` of CoRBS (Wasenmueller et al. 2016); lists may have backslashes.

    The ground truth is groundtruth.txt, or in the folder or archive ``D1_Trajectory`` next to it.
    """

    format = "CoRBS"
    published = "CoRBS", camera_values(468.60, 468.61, 318.27, 243.99, 640, 480, 5000)
    folder = re.compile(r"(.+)_pre_?registered_?data", re.IGNORECASE)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a folder has the layout and the name of this data set."""
        return super().recognises(path) and cls.folder.fullmatch(path.resolve().name) is not None

    def _find_pairs(self) -> list[tuple[TimedFile, TimedFile]]:
        def slashed(file: TimedFile) -> TimedFile:
            return file._replace(place=str(file.place).replace("\\", "/"))

        return [(slashed(depth), slashed(color)) for depth, color in super()._find_pairs()]

    def _find_ground_truth(self) -> Trajectory | None:
        truth = super()._find_ground_truth()
        match = self.folder.fullmatch(self.name)
        if truth is not None or match is None:
            return truth
        archive = origin(self.path)
        for place in (self.path.parent, *(() if archive is None else (archive.parent,))):
            file = place / f"{match.group(1)}_Trajectory"
            if not file.is_dir() and file.with_name(file.name + ".zip").is_file():
                file = unpack(file.with_name(file.name + ".zip"))
            found = sorted(file.rglob("groundtruth.txt")) if file.is_dir() else []
            if found:
                return Trajectory.load(found[0], optional=True)
        return None


CAMERA_FRAME, BODY_FRAME = "d400_color_optical_frame", "base_link"


class OpenLorisSequence(ImageFolder):
    """OpenLORIS-Scene (Shi et al. 2020), "package" form: a RealSense D435i on a robot.

    sensors.yaml has fx, cx, fy, cy; groundtruth.txt poses of ``base_link``, camera poses follow from trans_matrix.yaml.
    """

    format = "OpenLORIS-Scene"
    truth = "robot poses converted to camera poses"
    layout = ("color.txt", "aligned_depth.txt", "sensors.yaml")

    def _find_pairs(self) -> list[tuple[TimedFile, TimedFile]]:
        return self._pair_timed(read_list(self.path / "color.txt"), read_list(self.path / "aligned_depth.txt"))

    def _find_intrinsics(self) -> intrinsics.Intrinsics:
        path = self.path / "sensors.yaml"
        node = read_yaml(path).get(CAMERA_FRAME) or {}
        numbers = _matrix(node, "intrinsics")
        if numbers is None or numbers.size != 4:
            raise DatasetError(f"{path} lacks the intrinsics (4 numbers) of {CAMERA_FRAME}")
        fx, cx, fy, cy = numbers.ravel().tolist()
        size = {key: float(node[key]) for key in ("width", "height") if isinstance(node.get(key), int | float)}
        return intrinsics.Intrinsics(camera_values(fx, fy, cx, cy) | size, "sensors.yaml")

    def _find_ground_truth(self) -> Trajectory | None:
        truth, path = self._stamped_poses(), self.path / "trans_matrix.yaml"
        if truth is None or not path.is_file():
            return truth
        return replace(truth, Ts_world_camera=truth.Ts_world_camera @ _motion(path, BODY_FRAME, CAMERA_FRAME))


def _matrix(node: Any, key: str) -> NDArray[np.float64] | None:  # noqa: ANN401 - a value of a YAML file
    try:
        rows, columns, numbers = (node[key][name] for name in ("rows", "cols", "data"))
        return np.array(numbers, dtype=np.float64).reshape(max(int(rows), 0), max(int(columns), 0))
    except (TypeError, KeyError, ValueError, OverflowError):
        return None


def _motion(path: Path, parent: str, child: str) -> NDArray[np.float64]:
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
