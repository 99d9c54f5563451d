"""Data sets in folders of numbered images: ICL-NUIM, 7-Scenes, VolumeDeform, ScanNet, Replica, Redwood and EPFL."""

import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.geometry.association import TimedFile, read_rows
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError, FrameError
from dudmap.input_files import read_text
from dudmap.io.sequences import camera_files, camera_search, images, intrinsics
from dudmap.io.sequences.image_folder import FRAME_RATE, ImageFolder, numbered_files
from dudmap.io.sequences.intrinsics import camera_values
from dudmap.io.sequences.pose_matrices import read_log, read_matrix, read_upper_rows, rigid_trajectory


class EpflSequence(ImageFolder):
    """EPFL RGB-D Pedestrian data set (Bagautdinov et al. 2015): a Kinect v2 at rest.

    ``rgb000033.png`` and ``depth000033.png`` (mm), registered, with one published camera.
    """

    format = "EPFL RGB-D Pedestrian"
    layout = ("rgb" + 6 * "[0-9]" + ".png", "depth" + 6 * "[0-9]" + ".png")
    published = "EPFL", camera_values(365.8046307762528, 365.80463336811664, 254.31510758228475, 206.98513348550657,
                                      512, 424, 1000)  # fmt: skip
    color_files, depth_files = ("", r"rgb(\d{6})\.png"), ("", r"depth(\d{6})\.png")


class ReplicaSequence(ImageFolder):
    """Replica as rendered for NICE-SLAM (Zhu et al. 2022): ``results/frame000000.jpg``, ``depth000000.png``.

    ``traj.txt`` has 16 numbers per line, camera to world. The camera is cam_params.json's, or published.
    """

    format = "Replica (NICE-SLAM)"
    layout = ("results/depth*.png",)
    depth_scale = 6553.5
    published = "NICE-SLAM's Replica", camera_values(600, 600, 599.5, 339.5, 1200, 680, 6553.5)
    color_files, depth_files = ("results", r"frame(\d+)\.(?:jpe?g|png)"), ("results", r"depth(\d+)\.png")
    pose_list = "traj.txt"


class ScanNetSequence(ImageFolder):
    """ScanNet (Dai et al. 2017) as exported by SensReader: color, depth (mm), pose and intrinsic (4x4 each);
    ``T_color_depth = E_color^-1 E_depth`` from extrinsics to a common frame. Frames with an infinite pose have no
    ground truth."""

    format = "ScanNet export"
    color_files, pose_files = ("color", r"(\d+)\.(?:jpe?g|png)"), ("pose", r"(\d+)\.txt")

    layout = ("color/", "depth/", "pose/")

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a folder has this layout."""
        return super().recognises(path) and _parameter(path, "intrinsic_depth.txt") is not None

    def _find_intrinsics(self) -> intrinsics.Intrinsics:
        depth, color = self._values("depth"), self._values("color")
        height, width = images.read_color(self._pairs[0][0].path).shape[:2]
        T_depth_color = se3.inverse(self._extrinsic("depth")) @ self._extrinsic("color")
        color |= {"width": width, "height": height}
        return intrinsics.Intrinsics(depth, "intrinsic_depth.txt and intrinsic_color.txt", color, T_depth_color)

    def _values(self, kind: str) -> dict[str, float]:
        file = _parameter(self.path, f"intrinsic_{kind}.txt")
        if file is None:
            raise DatasetError(f"{self.path} lacks intrinsic/intrinsic_{kind}.txt; export it with SensReader")
        K = read_matrix(file)
        return camera_values(K[0, 0], K[1, 1], K[0, 2], K[1, 2])

    def _extrinsic(self, kind: str) -> NDArray[np.float64]:
        file = _parameter(self.path, f"extrinsic_{kind}.txt")
        return np.eye(4) if file is None else read_matrix(file)


def _parameter(path: Path, name: str) -> Path | None:
    places = (path / "intrinsic" / name, path / name, path / name.replace("intrinsic_", "intrinsics_"))
    return next((place for place in places if place.is_file()), None)


SEVEN_SCENES_DEPTH = camera_values(585, 585, 320, 240, 640, 480)
"""Depth camera given on the 7-Scenes page."""
SEVEN_SCENES_COLOR = camera_values(525, 525, 320, 240, 640, 480)
"""Colour camera for 7-Scenes (DSAC*, Brachmann and Rother 2021)."""
KINECT_COLOR_DEPTH = np.array(
    [
        [9.9996518012567637e-01, 2.6765126468950343e-03, -7.9041012313000904e-03, -2.5558943178152542e-02],
        [-2.7409311281316700e-03, 9.9996302803027592e-01, -8.1504520778013286e-03, 1.0109636268061706e-04],
        [7.8819942130445332e-03, 8.1718328771890631e-03, 9.9993554558014031e-01, 2.0318321729487039e-03],
        [0, 0, 0, 1],
    ]
)
"""Motion from a Kinect's depth to colour camera (LIRIS), as in DSAC* for 7-Scenes, confirmed by ``dudmap
calibrate``."""
SEVEN_SCENES = r"(7|seven)[-_ ]?scenes|/(chess|fire|heads|office|pumpkin|red_?kitchen|stairs)/seq-\d+$"
"""Path of 7-Scenes: the set, or a scene above ``seq-01``."""
LOST = 65535


class FrameFiles(ImageFolder):
    """Base of the formats with files ``frame-000000``; poses are camera to world."""

    color_files = "", r"frame-(\d+)\.(?:color|rgb)\.(?:png|jpe?g)"
    depth_files, pose_files = ("", r"frame-(\d+)\.depth\.(?:png|pgm)"), ("", r"frame-(\d+)\.pose\.txt")


class SharedFrameFiles(FrameFiles):
    """Such images with pose files: 7-Scenes (Shotton et al. 2013), 3DMatch, tsdf-fusion and others.

    Intrinsics are in the folder or its parent; colour is registered; 65535 means missing. A path that names 7-Scenes
    has its cameras, not registered; registered copies need an intrinsics.txt.
    """

    format = "7-Scenes, 3DMatch or tsdf-fusion"
    layout = ("frame-*.depth.png", "frame-*.pose.txt")

    def __init__(self, path: str | Path, camera: Camera | str | None = None) -> None:
        named = re.search(SEVEN_SCENES, Path(path).resolve().as_posix(), flags=re.IGNORECASE)
        self.format = "7-Scenes" if named else "3DMatch or tsdf-fusion"
        super().__init__(path, camera)

    def _find_intrinsics(self) -> intrinsics.Intrinsics:
        if self.format != "7-Scenes":
            why = ", since 7-Scenes, 3DMatch and others share this layout and the path does not name 7-Scenes"
            return camera_search.known(self.path, None, self._sizes, why)
        known = camera_files.find(self.path)
        if known is not None and Path(known.source).name != "camera-intrinsics.txt":
            return known
        values, source = SEVEN_SCENES_DEPTH, f"the 7-Scenes cameras{intrinsics.BY_NAME}"
        if known is not None:
            values, source = known.values, f"{known.source}; colour: 7-Scenes{intrinsics.BY_NAME}"
        return intrinsics.Intrinsics(values, source, SEVEN_SCENES_COLOR, se3.inverse(KINECT_COLOR_DEPTH))

    def _read_depth(self, path: Path, depth_scale: float) -> NDArray[np.float32]:
        depth = images.read_depth(path, depth_scale)
        depth[depth >= np.float32(LOST / depth_scale)] = 0
        return depth


class VolumeDeformSequence(FrameFiles):
    """VolumeDeform (Innmann et al. 2016): images (``data``) with colorIntrinsics.txt and depthIntrinsics.txt, and
    poses.txt with a 4x4 matrix per frame above."""

    format = "VolumeDeform"
    layout = ("depthIntrinsics.txt", "frame-*.depth.*")

    def __init__(self, path: str | Path, camera: Camera | str | None = None) -> None:
        self._top = path = Path(path)
        super().__init__(path / "data" if (path / "data").is_dir() else path, camera)
        if self.name == "data":
            self._top = self.path.resolve().parent
            self.name = self._top.name
            self._take_truth()

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a folder, or its ``data``, has this layout."""
        return super().recognises(path) or super().recognises(path / "data")

    def _find_intrinsics(self) -> intrinsics.Intrinsics:
        depth = intrinsics.from_file(self.path / "depthIntrinsics.txt").values
        file = self.path / "colorIntrinsics.txt"
        color = intrinsics.from_file(file).values if file.is_file() else depth
        if color == depth:
            return intrinsics.Intrinsics(depth, "depthIntrinsics.txt")
        height, width = images.read_color(self._pairs[0][0].path).shape[:2]
        color = color | {"width": width, "height": height}
        return intrinsics.Intrinsics(depth, "depthIntrinsics.txt and colorIntrinsics.txt", color)

    def _find_ground_truth(self) -> Trajectory | None:
        return super()._find_ground_truth() or self._listed_poses(self._top / "poses.txt")


REDWOOD_NAMES = r"redwood|/(burghers|cactusgarden|copyroom|lounge|readingroom|stonewall|totempole)(_png)?$"
"""Path of these data sets; object scans are recognised by file names."""
COLORS = ("color", "rgb", "image", "image_2d")
OBJECT_SCAN = r"(\d{7})-\d{12}\.(?:jpe?g|png)"
"""Redwood object scans: frame number and microseconds."""


class RedwoodSequence(ImageFolder):
    """``color`` (or rgb, image), ``depth`` (mm) and a ``*.log`` inside or next to it, or an object scan.

    A ``.log`` holds camera-to-world matrices by frame number; ``scene/trajectory.log`` is Open3D's estimate and no
    ground truth. Intrinsics come from Open3D's JSON file, or are known.
    """

    format = "Redwood or Open3D"
    published = "Redwood", camera_values(525, 525, 319.5, 239.5, 640, 480, 1000)  # PrimeSense default

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a folder has this layout."""
        if not (path / "depth").is_dir() or _color_folder(path) is None:
            return False
        scan = any(re.fullmatch(OBJECT_SCAN, file.name) for file in (path / "depth").glob("*.png"))
        return scan or bool(_logs(path)) or (path / "camera_primesense.json").is_file()

    def _find_pairs(self) -> list[tuple[TimedFile, TimedFile]]:
        color = _color_folder(self.path)
        colors, depths = list(color.iterdir()) if color else [], list((self.path / "depth").iterdir())
        scan = any(re.fullmatch(OBJECT_SCAN, file.name) for file in depths)
        pattern = OBJECT_SCAN if scan else r"\D*(\d+)\.(?:jpe?g|png)"
        pairs = self._pair_numbered(numbered_files(colors, pattern), numbered_files(depths, pattern))
        if not scan:
            return pairs
        self.timed = True
        stamps = [int(depth.path.stem[8:]) / 1e6 for _, depth in pairs]
        return [(TimedFile(t, c.path), TimedFile(t, d.path)) for t, (c, d) in zip(stamps, pairs, strict=True)]

    def _published(self) -> intrinsics.Intrinsics | None:
        if self.timed or re.search(REDWOOD_NAMES, self.path.resolve().as_posix(), flags=re.IGNORECASE):
            return super()._published()
        return None

    def _find_ground_truth(self) -> Trajectory | None:
        logs = _logs(self.path)
        if len(logs) != 1:
            return None
        poses = read_log(logs[0])
        first = round(float(self.timestamps[0]) * FRAME_RATE)
        return rigid_trajectory(((first + n) / FRAME_RATE, poses[n]) for n in sorted(poses))


def _color_folder(path: Path) -> Path | None:
    return next((path / name for name in COLORS if (path / name).is_dir()), None)


def _logs(path: Path) -> list[Path]:
    name = path.resolve().name.removesuffix("_png")
    inside = sorted(path.glob("*traj*.log")) or sorted(path.glob("*.log"))
    return inside or sorted(path.resolve().parent.glob(f"{name}[_-]traj*.log"))


ICL_NUIM = camera_values(481.2, 480, 319.5, 239.5, 640, 480, 5000)
"""Published camera of ICL-NUIM; its fy is negative because y points up."""
MIRROR_Y = np.diag([1.0, -1.0, 1.0, 1.0])
"""Between the renderer's left-handed axes (y up) and dudmap's, for world and camera."""
MIRROR_X = np.diag([-1.0, 1.0, 1.0, 1.0])
"""Between the renderer's axes and the living room model's."""
NUMBER = r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?"
SCENE_FILE = r"scene_\d+_(\d+)"


class IclNuimSequence(ImageFolder):
    """ICL-NUIM (Handa et al. 2014): ``rgb/N.png``, ``depth/N.png`` and perhaps a ``*.gt.freiburg``.

    Published poses T are left-handed: ``M T M`` with M = diag(1, -1, 1) fits a positive fy. The first frames have no
    pose.
    """

    format = "ICL-NUIM"
    truth = "left-handed poses mirrored"
    depth_scale = ICL_NUIM["depth_scale"]
    published = "ICL-NUIM", ICL_NUIM

    layout = ("rgb/", "depth/")

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a folder has this layout and the data set's name."""
        if not super().recognises(path) or not numbered_files((path / "depth").iterdir(), r"(\d+)\.png"):
            return False
        named = re.search(r"(living|office)_?room|traj\d+n?_(frei|loop)", path.resolve().name, re.IGNORECASE)
        return named is not None or any(path.glob("*.gt.freiburg"))

    def _find_ground_truth(self) -> Trajectory | None:
        return _freiburg(self.path)

    @property
    def model(self) -> "PlacedModel | None":
        """The published living room in the world of the ground truth; None without its file.

        living-room.ply or .obj, in the folder or above, has the renderer's axes with x mirrored. ``*.gt.sim`` (three
        rows per frame) has poses in them for each row of ``*.gt.freiburg``; the first places the model.

        Raises:
            DatasetError: A pose that places the model is missing.
        """
        files = [folder / f"living-room{ending}" for folder in (self.path, self.path.resolve().parent)
                 for ending in (".ply", ".obj")]  # fmt: skip
        file = next((file for file in files if file.is_file()), None)
        if file is None:
            return None
        poses = sorted(self.path.glob("*.gt.sim"))
        if len(poses) != 1 or self.ground_truth is None:
            raise DatasetError(
                f"{file} cannot be placed: {self.path} holds {len(poses)} files *.gt.sim; expected one, and a "
                "*.gt.freiburg, both of the page of the data set"
            )
        T_model_camera = MIRROR_X @ read_upper_rows(poses[0])[0] @ MIRROR_Y
        return PlacedModel(file, self.ground_truth.Ts_world_camera[0] @ se3.inverse(T_model_camera))


class PlacedModel(NamedTuple):
    """Mesh file of a true surface, and its pose (4, 4) in the ground truth's world."""

    path: Path
    T_world_model: NDArray[np.float64]


class IclNuimLoopSequence(ImageFolder):
    """The renderer's layout: ``scene_00_0000.png``, ``.depth`` and ``.txt``.

    A ``.depth`` file has the distance along the ray of every pixel, metres, by rows. A ``.txt`` file has position,
    direction and right vector, left-handed, y up.
    """

    format = "ICL-NUIM"
    truth = "left-handed poses mirrored"
    published = "ICL-NUIM", ICL_NUIM
    layout = ("scene_*_*.depth",)
    color_files, depth_files = ("", SCENE_FILE + r"\.png"), ("", SCENE_FILE + r"\.depth")

    def _read_depth(self, path: Path, depth_scale: float) -> NDArray[np.float32]:
        try:
            distance = np.array(read_text(path).split(), dtype=np.float64)
        except (OSError, ValueError) as error:
            raise FrameError(f"cannot read {path}: {error}") from error
        width, height = int(ICL_NUIM["width"]), int(ICL_NUIM["height"])
        if distance.size != width * height:
            raise FrameError(f"{path} holds {distance.size} distances; expected {width * height}, one per pixel")
        x = (np.arange(width) - ICL_NUIM["cx"]) / ICL_NUIM["fx"]
        y = (np.arange(height) - ICL_NUIM["cy"]) / ICL_NUIM["fy"]
        depth = distance.reshape(height, width) / np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2)
        return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)

    def _find_ground_truth(self) -> Trajectory | None:
        known = _freiburg(self.path)
        if known is not None:
            return known
        poses = numbered_files(self.path.iterdir(), SCENE_FILE + r"\.txt")
        return rigid_trajectory((n / FRAME_RATE, MIRROR_Y @ _pov_pose(poses[n]) @ MIRROR_Y) for n in sorted(poses))


def _freiburg(folder: Path) -> Trajectory | None:
    """Poses of groundtruth.txt or the only ``*.gt.freiburg`` (``number tx ty tz qx qy qz qw``), in dudmap's axes and
    seconds."""
    found = [folder / "groundtruth.txt"]
    found = found if found[0].is_file() else list(folder.glob("*.gt.freiburg"))
    if len(found) != 1:
        return None
    for number, fields in read_rows(found[0], "number tx ty tz qx qy qz qw"):
        if not re.fullmatch(r"\d+(\.0*)?", fields[0]):
            raise DatasetError(f"{found[0]}, line {number}: expected the number of a frame, found {fields[0]!r}")
    raw = Trajectory.load(found[0], optional=True)
    Ts_world_camera = MIRROR_Y @ raw.Ts_world_camera @ MIRROR_Y
    return replace(raw, timestamps=raw.timestamps / FRAME_RATE, Ts_world_camera=Ts_world_camera)


def _pov_pose(path: Path) -> NDArray[np.float64]:
    try:
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot read {path}: {error}") from error
    found = re.findall(r"(cam_\w+)\s*=\s*\[([-+.,eE\d\s]*)\]", text)
    vectors = {key: np.array([float(number[0]) for number in re.finditer(NUMBER, body)]) for key, body in found}
    missing = [key for key in ("cam_pos", "cam_dir", "cam_up") if len(vectors.get(key, ())) != 3]
    if missing:
        raise DatasetError(f'{path} lacks {", ".join(missing)}; expected lines such as "cam_pos = [x, y, z]\'"')
    z = vectors["cam_dir"] / np.linalg.norm(vectors["cam_dir"])
    x = np.cross(vectors["cam_up"], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = x, np.cross(z, x), z, vectors["cam_pos"]
    return T
