"""ICL-NUIM (Handa et al. 2014): rendered rooms, as TUM-like folders of PNG files or in the renderer's own layout."""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.association import read_rows
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError, FrameError
from dudmap.input_files import read_text
from dudmap.io.sequences.image_folder import FRAME_RATE, ImageFolder, numbered_files
from dudmap.io.sequences.poses import rigid_trajectory

CAMERA = {"fx": 481.2, "fy": 480.0, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480, "depth_scale": 5000.0}
"""The published camera. Its fy is -480 because the renderer's y axis points up; the images are not upside down."""
MIRROR_Y = np.diag([1.0, -1.0, 1.0, 1.0])
"""Between the renderer's left-handed axes (y up) and ours (y down), for the world and the camera alike."""
NUMBER = r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?"
SCENE_FILE = r"scene_\d+_(\d+)"


class IclNuimSequence(ImageFolder):
    """Folder with ``rgb/N.png`` and ``depth/N.png``, and optionally a true ``*.gt.freiburg``.

    Frames are numbered, not timed, and 30 a second. The published poses T are those of the renderer's left-handed axes;
    with the mirror M = diag(1, -1, 1) at both ends, ``M T M``, they fit the images with a positive fy. The first frames
    have no pose. Noisy depth (``traj2n``) has the same layout.
    """

    format = "ICL-NUIM"
    depth_scale = CAMERA["depth_scale"]
    published = "ICL-NUIM", CAMERA

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether a folder has this layout: the images, and the name of the data set on it or on its truth."""
        if not all((path / kind).is_dir() for kind in ("rgb", "depth")):
            return False
        if not any(re.fullmatch(r"\d+\.png", file.name) for file in (path / "depth").iterdir()):
            return False
        named = re.search(r"(living|office)_?room|traj\d+n?_(frei|loop)", path.resolve().name, re.IGNORECASE)
        return named is not None or any(path.glob("*.gt.freiburg"))

    def _find_ground_truth(self) -> Trajectory | None:
        file = _truth_file(self.path)
        return None if file is None else _freiburg(file)


class IclNuimLoopSequence(ImageFolder):
    """Folder with ``scene_00_0000.png``, ``.depth`` and ``.txt``: the renderer's own layout.

    A ``.depth`` file is text: the distance along the ray of every pixel in metres, row by row. A ``.txt`` file gives
    position, direction and right vector of the camera, left-handed with y up.
    """

    format = "ICL-NUIM"
    published = "ICL-NUIM", CAMERA
    color_files, depth_files = ("", SCENE_FILE + r"\.png"), ("", SCENE_FILE + r"\.depth")

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether a folder has this layout."""
        return path.is_dir() and any(path.glob("scene_*_*.depth"))

    def _read_depth(self, path: Path, depth_scale: float) -> NDArray[np.float32]:
        try:
            distance = np.array(read_text(path).split(), dtype=np.float64)
        except (OSError, ValueError) as error:
            raise FrameError(f"cannot read {path}: {error}") from error
        width, height = CAMERA["width"], CAMERA["height"]
        if distance.size != width * height:
            raise FrameError(f"{path} holds {distance.size} distances; expected {width * height}, one per pixel")
        x = (np.arange(width) - CAMERA["cx"]) / CAMERA["fx"]
        y = (np.arange(height) - CAMERA["cy"]) / CAMERA["fy"]
        depth = distance.reshape(height, width) / np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2)
        return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)

    def _find_ground_truth(self) -> Trajectory | None:
        file = _truth_file(self.path)
        if file is not None:
            return _freiburg(file)
        poses = numbered_files(self.path.iterdir(), SCENE_FILE + r"\.txt")
        return rigid_trajectory((n / FRAME_RATE, MIRROR_Y @ _pov_pose(poses[n]) @ MIRROR_Y) for n in sorted(poses))


def _truth_file(path: Path) -> Path | None:
    """groundtruth.txt, else the only ``*.gt.freiburg``."""
    if (path / "groundtruth.txt").is_file():
        return path / "groundtruth.txt"
    found = list(path.glob("*.gt.freiburg"))
    return found[0] if len(found) == 1 else None


def _freiburg(path: Path) -> Trajectory:
    """Poses of a file ``number tx ty tz qx qy qz qw`` in our axes and in seconds."""
    _check_numbers(path)
    raw = Trajectory.load(path)
    return Trajectory(raw.timestamps / FRAME_RATE, MIRROR_Y @ raw.Ts_world_camera @ MIRROR_Y)


def _check_numbers(path: Path) -> None:
    """Check that poses are numbered, so that a file of real times is not read as one of frame numbers.

    Raises:
        DatasetError: A first column is not a whole number.
    """
    for number, fields in read_rows(path, "number tx ty tz qx qy qz qw"):
        if not re.fullmatch(r"\d+(\.0*)?", fields[0]):
            raise DatasetError(f"{path}, line {number}: expected the number of a frame, found {fields[0]!r}")


def _pov_pose(path: Path) -> NDArray[np.float64]:
    """T_world_camera (4, 4) in the renderer's axes: columns right, up, direction (made orthogonal), position."""
    try:
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot read {path}: {error}") from error
    vectors = {}
    for key, body in re.findall(r"(cam_\w+)\s*=\s*\[([-+.,eE\d\s]*)\]", text):
        fields = body.replace(",", " ").split()
        vectors[key] = np.array([float(field) for field in fields if re.fullmatch(NUMBER, field)])
    missing = [key for key in ("cam_pos", "cam_dir", "cam_up") if len(vectors.get(key, ())) != 3]
    if missing:
        raise DatasetError(f'{path} lacks {", ".join(missing)}; expected lines such as "cam_pos = [x, y, z]\'"')
    z = vectors["cam_dir"] / np.linalg.norm(vectors["cam_dir"])
    x = np.cross(vectors["cam_up"], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = x, np.cross(z, x), z, vectors["cam_pos"]
    return T
