"""Phone recordings: Stray Scanner, ARKitScenes, Polycam, Record3D, nerfstudio's form.

ARKit's depth has 256x192 pixels in the view of colour. Pixels of confidence 0, the lowest, are omitted, as Polycam's
documentation advises.
"""

import math
import re
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.geometry.association import TimedFile
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError, FrameError
from dudmap.input_files import damaged, read_json, read_text
from dudmap.io.sequences import images
from dudmap.io.sequences.camera_values import values_of
from dudmap.io.sequences.gravity import Gravity
from dudmap.io.sequences.image_folder import FRAME_RATE, ImageFolder, numbered_files, size
from dudmap.io.sequences.intrinsics import Intrinsics, camera_values
from dudmap.io.sequences.pose_matrices import OPENGL_AXES, read_matrix, rigid_trajectory
from dudmap.io.sequences.video import Video

Y_UP, Z_UP = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
"""Up in worlds of ARKit, and in worlds turned later."""


def _rotations(poses: Trajectory) -> list[tuple[float, NDArray[np.float64]]]:
    return list(zip(poses.timestamps.tolist(), poses.Ts_world_camera[:, :3, :3], strict=True))


class ArkitFolder(ImageFolder):
    """Base of the formats; ``confidence`` has the depth images' file names."""

    def _read_depth(self, path: Path, depth_scale: float) -> NDArray[np.float32]:
        depth = images.read_depth(path, depth_scale)
        file = path.parent.with_name("confidence") / path.name
        if file.is_file():
            confidence = images.read_gray(file)
            if confidence.shape != depth.shape:
                raise FrameError(f"{file} is {size(confidence)} pixels, but the depth image {path} is {size(depth)}")
            depth[confidence == 0] = 0
        return depth


class StrayScannerSequence(ArkitFolder):
    """Stray Scanner: a colour video, and depth images by frame number.

    Layout: https://github.com/strayrobots/scanner/blob/main/docs/format.md. ``rgb.mp4``, ``depth/000000.png`` (mm),
    ``confidence/000000.png``, ``camera_matrix.csv`` (3x3) and ``odometry.csv`` with times; its poses are no ground
    truth.
    """

    format = "Stray Scanner"
    layout = ("rgb.mp4", "depth", "odometry.csv")

    def _find_pairs(self) -> list[tuple[TimedFile, TimedFile]]:
        file = self.path / "odometry.csv"
        lines = read_text(file).splitlines()
        if not lines or lines[0].replace(" ", "").split(",")[:2] != ["timestamp", "frame"]:
            raise DatasetError(f"{file} does not start with the header 'timestamp, frame, x, ...' of Stray Scanner")
        rows = [line.split(",")[:2] for line in lines[1:] if line.strip()]
        times = {float(stamp): int(number) for stamp, number in rows}
        depths = numbered_files((self.path / "depth").iterdir(), r"(\d+)\.png")
        pairs = [
            (TimedFile(stamp, self.path / "rgb.mp4" / str(times[stamp])), TimedFile(stamp, depths[times[stamp]]))
            for stamp in sorted(filter(math.isfinite, times))
            if times[stamp] in depths
        ]
        if not pairs:
            raise DatasetError(f"{self.path}: none of the {len(rows)} frames in odometry.csv has a depth image")
        return pairs

    def _find_intrinsics(self) -> Intrinsics:
        K = read_matrix(self.path / "camera_matrix.csv", 3, 3)
        return self._one_view([camera_values(K[0, 0], K[1, 1], K[0, 2], K[1, 2])], "camera_matrix.csv")

    @cached_property
    def gravity(self) -> Gravity | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The world has y up; poses have dudmap's camera axes."""
        file = self.path / "odometry.csv"
        header, *rows = (line.replace(" ", "").split(",") for line in read_text(file).splitlines() if line.strip())
        if not {"qx", "qy", "qz", "qw"} <= set(header):
            return None
        with damaged(DatasetError, file):
            columns = [header.index(name) for name in ("timestamp", "qx", "qy", "qz", "qw")]
            numbers = np.array([[float(row[column]) for column in columns] for row in rows]).reshape(-1, 5)
            numbers = numbers[np.all(np.isfinite(numbers), axis=1)]
            return Gravity.of_rotations(
                [(row[0], se3.quat_xyzw_to_rotation(row[1:])) for row in numbers], Y_UP, file.name
            )

    @cached_property
    def _video(self) -> Video:
        return Video(self.path / "rgb.mp4")

    def _read_color(self, path: Path) -> NDArray[np.uint8]:
        return self._video[int(path.name)]


class ArkitScenesSequence(ArkitFolder):
    """ARKitScenes (Baruch et al. 2021), raw or 3dod: 256x192 pixels, times in names.

    Layout: https://github.com/apple/ARKitScenes/blob/main/DATA.md. ``lowres_wide/ID_TIME.png``, ``lowres_depth``,
    ``confidence``, ``lowres_wide_intrinsics/ID_TIME.pincam`` (median) and ``lowres_wide.traj``, world to camera.
    """

    format = "ARKitScenes"
    layout = ("lowres_wide/", "lowres_depth/", "lowres_wide_intrinsics/")

    def _find_pairs(self) -> list[tuple[TimedFile, TimedFile]]:
        colors, depths = (self._timed(kind, "png") for kind in ("lowres_wide", "lowres_depth"))
        return self._pair_timed(colors, depths)

    def _timed(self, folder: str, suffix: str) -> list[TimedFile]:
        matches = ((re.fullmatch(rf"\d+_(\d+\.\d+)\.{suffix}", f.name), f) for f in (self.path / folder).iterdir())
        return sorted(TimedFile(float(match[1]), file) for match, file in matches if match)

    def _find_intrinsics(self) -> Intrinsics:
        files = [file.path for file in self._timed("lowres_wide_intrinsics", "pincam")]
        if not files:
            raise DatasetError(
                f"{self.path}/lowres_wide_intrinsics holds no files ID_TIME.pincam; give --camera fx,fy,cx,cy"
            )
        numbers = [read_matrix(file, 1, 6)[0, 2:].tolist() for file in files]  # after width and height
        return self._one_view([camera_values(*row) for row in numbers], "lowres_wide_intrinsics")

    def _find_ground_truth(self) -> Trajectory | None:
        file = self.path / "lowres_wide.traj"
        if not file.is_file():
            return None
        rows = np.array(read_text(file).split(), np.float64).reshape(-1, 7)
        poses = []
        for row in rows[np.unique(rows[:, 0], return_index=True)[1]]:
            T_camera_world = np.eye(4)
            T_camera_world[:3, :3], T_camera_world[:3, 3] = se3.exp_rotation(row[1:4]), row[4:]
            poses.append((float(row[0]), se3.inverse(T_camera_world)))
        return rigid_trajectory(poses)

    @property
    def gravity(self) -> Gravity | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The world of the poses has z up."""
        poses = self.ground_truth
        return None if poses is None else Gravity.of_rotations(_rotations(poses), Z_UP, "lowres_wide.traj")


class PolycamSequence(ArkitFolder):
    """Polycam: keyframes named by microseconds.

    Layout: https://github.com/PolyCam/polyform#polycams-data-format. ``keyframes``: ``images/TIME.jpg``,
    ``cameras/TIME.json``, ``depth/TIME.png`` (mm), ``confidence/TIME.png``. ``corrected_images`` and
    ``corrected_cameras`` replace them; these optimised cameras are the ground truth. Intrinsics are the median.
    """

    format = "Polycam"

    def __init__(self, path: str | Path, camera: Camera | str | None = None) -> None:
        folder = Path(path)
        super().__init__(folder / "keyframes" if (folder / "keyframes").is_dir() else folder, camera)
        self.name = folder.resolve().name

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a folder, or the one above ``keyframes``, has this layout."""
        return any(
            (place / "depth").is_dir() and any(place.glob("*images")) and any(place.glob("*cameras/*.json"))
            for place in (path / "keyframes", path)
        )

    @cached_property
    def _kind(self) -> str:
        return "corrected_" if any(self.path.glob("corrected_images/*.jpg")) else ""

    @cached_property
    def _cameras(self) -> dict[int, dict[str, Any]]:
        files = numbered_files(self.path.glob(f"{self._kind}cameras/*"), r"(\d+)\.json")
        return {number: read_json(file) for number, file in files.items()}

    def _find_pairs(self) -> list[tuple[TimedFile, TimedFile]]:
        colors = numbered_files(self.path.glob(f"{self._kind}images/*"), r"(\d+)\.jpg")
        depths = numbered_files(self.path.glob("depth/*"), r"(\d+)\.png")
        return self._pair_numbered(colors, depths, per_second=1e6)

    def _find_intrinsics(self) -> Intrinsics:
        found = [values for tree in self._cameras.values() if (values := values_of(tree)) is not None]
        if not found:
            raise DatasetError(f"{self.path / self._kind}cameras holds no camera with fx, fy, cx and cy")
        return self._one_view(found, f"{self._kind}cameras")

    def _find_ground_truth(self) -> Trajectory | None:
        return self._poses() if self._kind else None

    @cached_property
    def gravity(self) -> Gravity | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The world of all cameras has y up."""
        with damaged(DatasetError, self.path / f"{self._kind}cameras"):
            poses = self._poses()
            return None if poses is None else Gravity.of_rotations(_rotations(poses), Y_UP, f"{self._kind}cameras")

    def _poses(self) -> Trajectory | None:
        poses = []
        for number, tree in self._cameras.items():
            T = np.eye(4)
            T[:3] = [[float(tree[f"t_{row}{column}"]) for column in range(4)] for row in range(3)]
            poses.append((number / 1e6, T @ OPENGL_AXES))
        return rigid_trajectory(poses)


class Record3DFolder(ImageFolder):
    """Record3D in images: ``rgb/N.jpg``, ``depth/N.exr`` (float metres) and metadata.json with K by columns and times;

    ARKit's poses are no ground truth. Depth has the view of colour and is smaller.
    """

    format = "Record3D images"
    layout = ("metadata.json", "rgb/", "depth/*.exr")
    color_files, depth_files = ("rgb", r"(\d+)\.(?:jpe?g|png)"), ("depth", r"(\d+)\.exr")
    options = ()

    def __init__(self, path: str | Path, camera: Camera | str | None = None) -> None:
        super().__init__(path, camera)
        self.sources["depth unit"] = "the format"

    def _find_pairs(self) -> list[tuple[TimedFile, TimedFile]]:
        pairs, tree = super()._find_pairs(), read_json(self.path / "metadata.json")
        stamps = record3d_times(tree, [int(depth.path.stem) for _, depth in pairs], self.path / "metadata.json")
        self.timed = True
        return [(TimedFile(t, c.path), TimedFile(t, d.path)) for t, (c, d) in zip(stamps, pairs, strict=True)]

    def _find_intrinsics(self) -> Intrinsics:
        K = read_json(self.path / "metadata.json")["K"]
        return self._one_view([camera_values(K[0], K[4], K[6], K[7])], "metadata.json")


def record3d_times(tree: dict[str, Any], numbers: list[int], source: Path) -> list[float]:
    """Times in seconds of these frames from Record3D's metadata.

    Raises:
        DatasetError: They do not increase.
    """
    stamps = tree.get("frameTimestamps") or [n / float(tree["fps"]) for n in range(max(numbers) + 1)]
    times = [float(stamps[number]) for number in numbers]
    if np.any(np.diff(times) <= 0):
        raise DatasetError(f"the frame times in the metadata of {source} do not increase")
    return times


MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "")


class NerfstudioSequence(ImageFolder):
    """nerfstudio's form: transforms.json names ``file_path``, ``depth_file_path`` and ``transform_matrix``.

    Frames are ordered by name, at 30 Hz unless each has a ``timestamp``. Depth has 16 bits, ``depth_unit_scale_factor``
    (default 0.001) metres per unit, or is a .npy file of metres, in the view of colour. Intrinsics are the median;
    matrices are camera to world with OpenGL axes; poses without scale are no ground truth.
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
        stamps = [frame.get("timestamp") for frame in self._frames]
        self.timed = all(isinstance(stamp, int | float) for stamp in stamps) and bool(np.all(np.diff(stamps) > 0))
        if not self.timed:
            stamps = [n / FRAME_RATE for n in range(len(self._frames))]
        return [
            (TimedFile(t, self.path / frame["file_path"]), TimedFile(t, self.path / frame["depth_file_path"]))
            for t, frame in zip(map(float, stamps), self._frames, strict=True)
        ]

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
