"""External dynamic masks: one 8-bit image per frame, named by its timestamp."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.association import LARGEST_GAP, associate
from dudmap.core.geometry.camera import Camera
from dudmap.errors import DatasetError
from dudmap.io.sequences.images import read_mask


class MaskFolder:
    """Folder of masks ``<timestamp>.png`` (255 = dynamic), each paired with the nearest frame at most 20 ms away.

    Args:
        path: The folder.
        timestamps: (N,) increasing timestamps of the frames, seconds.
        camera: Camera of the frames; the masks must have its image size.

    Raises:
        DatasetError: The folder does not exist, holds no image named by a timestamp, or no mask is near a frame.
    """

    def __init__(self, path: str | Path, timestamps: NDArray[np.float64], camera: Camera) -> None:
        path = Path(path)
        if not path.is_dir():
            raise DatasetError(f"there is no folder {path}; expected one with masks named <timestamp>.png")
        stamps = dict(stamped_masks(path))
        if not stamps:
            raise DatasetError(
                f"{path} holds no masks; expected images named <timestamp>.png, e.g. 1305031102.175304.png"
            )
        times = np.array(sorted(stamps))
        pairs = associate(times, timestamps)
        if not pairs:
            raise DatasetError(
                f"none of the {len(times)} masks in {path} belongs to a frame: their times run from {times[0]:.6f} to "
                f"{times[-1]:.6f} s, the frames' from {timestamps[0]:.6f} to {timestamps[-1]:.6f} s; expected masks at "
                f"most {1000 * LARGEST_GAP:.0f} ms from a frame"
            )
        self._shape = camera.shape
        self._files = {j: stamps[float(times[i])] for i, j in pairs}

    def __getitem__(self, index: int) -> NDArray[np.bool_] | None:
        """Mask (H, W) of a frame, or None if it has none.

        Raises:
            FrameError: The image cannot be decoded.
            DatasetError: The image does not have the size of the frames.
        """
        file = self._files.get(index)
        if file is None:
            return None
        mask = read_mask(file)
        if mask.shape != self._shape:
            raise DatasetError(
                f"the mask {file} is {mask.shape[1]}x{mask.shape[0]} pixels, but the frames are "
                f"{self._shape[1]}x{self._shape[0]}; masks must have the size of the images"
            )
        return mask


def stamped_masks(folder: Path) -> list[tuple[float, Path]]:
    """Timestamps in seconds and paths of the PNG files of a folder that are named by a timestamp."""
    masks = []
    for path in folder.glob("*.png"):
        try:
            stamp = float(path.stem)
        except ValueError:
            continue
        if np.isfinite(stamp):
            masks.append((stamp, path))
    return masks
