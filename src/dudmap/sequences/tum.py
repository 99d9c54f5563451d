"""Folders in the layout of the TUM RGB-D benchmark (Sturm et al. 2012), which Bonn and ICL-NUIM share."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import DatasetError, FrameError
from dudmap.frames.frame import Frame
from dudmap.geometry.association import TimedFile, associate, read_list, read_pairs
from dudmap.geometry.camera import Camera
from dudmap.geometry.trajectory import Trajectory
from dudmap.sequences import images, intrinsics

PROBES = 30
"""Number of evenly spread frames that are tried until one is valid and gives the image size."""


class TumSequence:
    """Recording with rgb.txt, depth.txt and optionally associations.txt, intrinsics.txt, groundtruth.txt, mask.txt.

    associations.txt (``t_rgb rgb_file t_depth depth_file``) pairs colour and depth images; without it they are
    associated one to one, nearest first, at most 20 ms apart. The timestamp of a frame is that of its depth image.

    Intrinsics come from ``camera``, else from intrinsics.txt, else from the folder name (TUM freiburg1-3, Bonn,
    ICL-NUIM). The published distortion of TUM freiburg1 and 2 is deliberately left out: it describes the colour lens,
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
    options: tuple[str, ...] = ()

    def __init__(self, path: str | Path, camera: Camera | str | None = None) -> None:
        self.path = Path(path)
        self.name = self.path.resolve().name
        self._pairs = self._find_pairs()
        self.timestamps = np.array([depth.timestamp for _, depth in self._pairs], dtype=np.float64)
        self._masks = self._find_masks()
        if isinstance(camera, str):
            known = intrinsics.from_text(camera)
        else:
            known = intrinsics.from_camera(camera) if camera else intrinsics.of_folder(self.path)
        self.intrinsics_source = known.source
        self.calibration = known.calibration()
        self.camera = self._probe(known)
        truth = self._find_ground_truth()
        self.ground_truth = None if truth is None else Trajectory.load(truth)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether a folder has this layout."""
        lists = (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()
        return lists or (path / "associations.txt").is_file()

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: int) -> Frame:
        """Frame number ``index``.

        Raises:
            FrameError: The frame cannot be read, or has another size than the recording.
        """
        frame = self._read(index, self.camera.depth_scale)
        if frame.depth.shape != self.camera.shape:
            raise FrameError(
                f"frame {index}: {self._pairs[index][1].path} is {_size(frame.depth)} pixels, but the recording's "
                f"camera is {self.camera.width}x{self.camera.height}"
            )
        return frame

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
            raise FrameError(f"the mask {path} is {_size(mask)} pixels; expected the size of the recording's frames")
        return mask

    def _read(self, index: int, depth_scale: float) -> Frame:
        color_file, depth_file = self._pairs[index]
        try:
            depth = images.read_depth(depth_file.path, depth_scale)
            color = images.read_color(color_file.path)
        except FrameError as error:
            raise FrameError(f"frame {index}: {error}") from error
        if self.calibration is not None and color.shape[:2] != self.calibration.camera.shape:
            expected = self.calibration.camera
            raise FrameError(
                f"frame {index}: the colour image {color_file.path} is {_size(color)} pixels, but the recording's "
                f"colour camera is {expected.width}x{expected.height}"
            )
        if self.calibration is None and color.shape[:2] != depth.shape:
            raise FrameError(
                f"frame {index}: the colour image {color_file.path} is {_size(color)} pixels but the depth image "
                f"{depth_file.path} is {_size(depth)}; both must have one size, with depth registered to "
                "colour, or intrinsics.txt must give the colour camera (color_fx and so on)"
            )
        return Frame(depth_file.timestamp, depth, color, color_file.timestamp)

    def _find_pairs(self) -> list[tuple[TimedFile, TimedFile]]:
        associations = self.path / "associations.txt"
        if associations.is_file():
            return read_pairs(associations)
        colors, depths = read_list(self.path / "rgb.txt"), read_list(self.path / "depth.txt")
        pairs = associate(np.array([c.timestamp for c in colors]), np.array([d.timestamp for d in depths]))
        if not pairs:
            raise DatasetError(
                f"{self.path}: no colour image lies within 20 ms of a depth image; rgb.txt covers "
                f"{colors[0].timestamp:.3f} to {colors[-1].timestamp:.3f} s and depth.txt "
                f"{depths[0].timestamp:.3f} to {depths[-1].timestamp:.3f} s"
            )
        return [(colors[i], depths[j]) for i, j in pairs]

    def _find_ground_truth(self) -> Path | None:
        """groundtruth.txt, else the only ``*.gt.freiburg``, which is the name that ICL-NUIM gives its trajectories."""
        if (self.path / "groundtruth.txt").is_file():
            return self.path / "groundtruth.txt"
        found = list(self.path.glob("*.gt.freiburg"))
        return found[0] if len(found) == 1 else None

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

    def _probe(self, known: intrinsics.Intrinsics) -> Camera:
        """Camera with the size of the first valid frame.

        Raises:
            DatasetError: No frame is valid.
        """
        problem = None
        for index in np.unique(np.linspace(0, len(self) - 1, PROBES).astype(int)):
            try:
                frame = self._read(int(index), known.depth_scale)
            except FrameError as error:
                problem = problem or str(error)
                continue
            if frame.depth.any():
                return known.camera(frame.depth.shape[1], frame.depth.shape[0])
            problem = problem or f"frame {index}: the depth image holds no reading, all its pixels are zero"
        raise DatasetError(f"no frame of {self.path} is usable; {problem}")


def _size(image: NDArray) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"
