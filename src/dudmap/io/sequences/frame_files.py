"""Folders of ``frame-000000.color.png``, ``.depth.png`` and ``.pose.txt``: 7-Scenes, VolumeDeform and others."""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.io.sequences import camera_files, images, intrinsics
from dudmap.io.sequences.image_folder import FRAME_RATE, ImageFolder
from dudmap.io.sequences.poses import read_matrices, rigid_trajectory

NAME = r"frame-(\d+)"
SEVEN_SCENES_DEPTH = {"fx": 585.0, "fy": 585.0, "cx": 320.0, "cy": 240.0, "width": 640, "height": 480}
"""Depth camera that the 7-Scenes page gives."""
SEVEN_SCENES_COLOR = {"fx": 525.0, "fy": 525.0, "cx": 320.0, "cy": 240.0, "width": 640, "height": 480}
"""Colour camera that work on 7-Scenes uses (DSAC*, Brachmann and Rother 2021); the page gives none."""
KINECT_COLOR_DEPTH = np.array(
    [
        [9.9996518012567637e-01, 2.6765126468950343e-03, -7.9041012313000904e-03, -2.5558943178152542e-02],
        [-2.7409311281316700e-03, 9.9996302803027592e-01, -8.1504520778013286e-03, 1.0109636268061706e-04],
        [7.8819942130445332e-03, 8.1718328771890631e-03, 9.9993554558014031e-01, 2.0318321729487039e-03],
        [0, 0, 0, 1],
    ]
)
"""Points of the depth camera of one Kinect into its colour camera (LIRIS), which DSAC* takes for 7-Scenes. ``dudmap
calibrate`` on 200 frames of a recording finds no better place, focal length or principal point than these."""
SEVEN_SCENES = r"(7|seven)[-_ ]?scenes|/(chess|fire|heads|office|pumpkin|red_?kitchen|stairs)/seq-\d+$"
"""Path of a recording of 7-Scenes: the name of the set, or of one of its scenes above ``seq-01``."""
LOST = 65535
"""Value of a pixel without reading in 7-Scenes."""


class FrameFiles(ImageFolder):
    """Base of the formats whose files are named ``frame-000000``; poses are camera to world, one file per frame."""

    color_files, depth_files = ("", NAME + r"\.(?:color|rgb)\.(?:png|jpe?g)"), ("", NAME + r"\.depth\.(?:png|pgm)")
    pose_files = "", NAME + r"\.pose\.txt"


class SharedFrameFiles(FrameFiles):
    """Folder of such images with pose files: 7-Scenes (Shotton et al. 2013), 3DMatch, tsdf-fusion and others.

    The intrinsics lie in the folder or the one above, and colour is registered to depth. Where the path names 7-Scenes,
    the cameras are those of that data set, whose depth is not registered to colour, and camera-intrinsics.txt is its
    depth camera; depth that somebody has registered needs an intrinsics.txt. 65535 means no reading.
    """

    format = "7-Scenes, 3DMatch or tsdf-fusion"

    def __init__(self, path: str | Path, camera: intrinsics.Camera | str | None = None) -> None:
        named = re.search(SEVEN_SCENES, Path(path).resolve().as_posix(), flags=re.IGNORECASE)
        self.format = "7-Scenes" if named else "3DMatch or tsdf-fusion"
        super().__init__(path, camera)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether a folder has this layout."""
        return path.is_dir() and any(path.glob("frame-*.depth.png")) and any(path.glob("frame-*.pose.txt"))

    def _find_intrinsics(self) -> intrinsics.Intrinsics:
        known = camera_files.find(self.path)
        if self.format != "7-Scenes" and known is None:
            raise camera_files.unknown(
                self.path, ", since 7-Scenes, 3DMatch and others share this layout and the path does not name 7-Scenes"
            )
        if known is not None and (self.format != "7-Scenes" or Path(known.source).name != "camera-intrinsics.txt"):
            return known
        depth = (
            intrinsics.Intrinsics(SEVEN_SCENES_DEPTH, f"the 7-Scenes cameras{intrinsics.BY_NAME}")
            if known is None
            else known
        )
        source = depth.source if known is None else f"{depth.source}; colour: 7-Scenes{intrinsics.BY_NAME}"
        motion = se3.inverse(KINECT_COLOR_DEPTH)
        return intrinsics.Intrinsics(dict(depth.values), source, dict(SEVEN_SCENES_COLOR), motion)

    def _read_depth(self, path: Path, depth_scale: float) -> NDArray[np.float32]:
        depth = images.read_depth(path, depth_scale)
        depth[depth >= np.float32(LOST / depth_scale)] = 0
        return depth


class VolumeDeformSequence(FrameFiles):
    """Folder of VolumeDeform (Innmann et al. 2016): images with colorIntrinsics.txt and depthIntrinsics.txt.

    The folder is the one of the images (``data``) or the one above, in which poses.txt may hold a 4x4 matrix per frame.
    The images are registered where both matrices are equal, as in that data set; otherwise the cameras are taken to be
    in one place, as the files do not say more.
    """

    format = "VolumeDeform"

    def __init__(self, path: str | Path, camera: intrinsics.Camera | str | None = None) -> None:
        path = Path(path)
        self._top = path
        super().__init__(path / "data" if (path / "data").is_dir() else path, camera)
        if self.name == "data":
            self._top = self.path.resolve().parent
            self.name = self._top.name
        self.ground_truth = self._find_ground_truth()

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether a folder has this layout."""
        return any(
            (place / "depthIntrinsics.txt").is_file() and any(place.glob("frame-*.depth.*"))
            for place in (path, path / "data")
            if place.is_dir()
        )

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
        per_frame = super()._find_ground_truth()
        file = self._top / "poses.txt"
        if per_frame is not None or not file.is_file():
            return per_frame
        return rigid_trajectory((n / FRAME_RATE, T) for n, T in enumerate(read_matrices(file)))
