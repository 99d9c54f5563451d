"""Folders in the layout of the TUM RGB-D benchmark (Sturm et al. 2012), which several other data sets share."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.association import TimedFile, associate, read_list, read_pairs
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import FrameError
from dudmap.io.sequences import images, intrinsics
from dudmap.io.sequences.image_folder import ImageFolder, size


class TumSequence(ImageFolder):
    """Recording with rgb.txt, depth.txt and optionally associations.txt, intrinsics.txt, groundtruth.txt, mask.txt.

    associations.txt (``t_rgb rgb_file t_depth depth_file``) pairs colour and depth images; without it they are
    associated one to one, nearest first, at most 20 ms apart. The timestamp of a frame is that of its depth image.

    Intrinsics come from ``camera``, else from a file, else from the folder's name (TUM freiburg1-3, Bonn).
    The published distortion of TUM freiburg1 and 2 is deliberately left out: it describes the colour lens,
    but the driver reprojected the depth as if that lens had no distortion, and undistorting both images would distort
    correct depth. On 240 frames of freiburg1_xyz the ATE was 0.96 cm without and 0.93 cm with it. Coefficients in
    intrinsics.txt (k1 k2 p1 p2 k3) are applied to both images.

    Args:
        path: The folder.
        camera: Intrinsics that replace those of the recording, as a Camera or as ``fx,fy,cx,cy[,w,h[,depth_scale]]``.

    Attributes:
        name: Name of the folder.
        camera: Intrinsics.
        calibration: Of the colour camera, where intrinsics.txt gives it; None for colour that is registered to depth.
        timestamps: (N,) strictly increasing timestamps of the depth images, seconds.
        ground_truth: True camera poses, None without groundtruth.txt.

    Raises:
        DatasetError: A list is missing or malformed, no images can be paired, or no frame is valid.
    """

    format = "TUM RGB-D"
    depth_scale = intrinsics.DEPTH_SCALE

    def __init__(self, path: str | Path, camera: Camera | str | None = None) -> None:
        super().__init__(path, camera)
        self._masks = self._find_masks()

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether a folder has this layout."""
        lists = (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()
        return lists or (path / "associations.txt").is_file()

    def mask(self, index: int) -> NDArray[np.bool_] | None:
        """True dynamic mask (H, W) of a frame, None if mask.txt lists none.

        Raises:
            FrameError: The mask cannot be read or has another size than the recording.
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
        return self._pair_timed(read_list(self.path / "rgb.txt"), read_list(self.path / "depth.txt"))

    def _published(self) -> intrinsics.Intrinsics | None:
        return super()._published() or intrinsics.by_name(self.path)

    def _find_ground_truth(self) -> Trajectory | None:
        path = self.path / "groundtruth.txt"
        return Trajectory.load(path) if path.is_file() else None

    def _find_masks(self) -> dict[int, Path]:
        """Mask files by frame number; mask.txt has the timestamps of the colour images."""
        path = self.path / "mask.txt"
        if not path.is_file():
            return {}
        masks = read_list(path)
        colors = np.array([color.timestamp for color, _ in self._pairs])
        order = np.argsort(colors, kind="stable")
        pairs = associate(np.array([mask.timestamp for mask in masks]), colors[order])
        return {int(order[j]): masks[i].path for i, j in pairs}
