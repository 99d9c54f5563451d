"""Readers of recordings: one small class per format, all with the interface ``Sequence``."""

from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import DatasetError

if TYPE_CHECKING:
    from dudmap.frames.frame import Frame
    from dudmap.geometry.calibration import Calibration
    from dudmap.geometry.camera import Camera
    from dudmap.geometry.trajectory import Trajectory

__all__ = ["Sequence", "is_recording", "open_sequence"]


@runtime_checkable
class Sequence(Protocol):
    """A recording with random access to its frames.

    Attributes:
        name: Short name, usable as a folder name.
        camera: Intrinsics of the depth images, and of the colour images where these are registered to them.
        calibration: Of the colour camera; None for colour that is registered to depth.
        timestamps: (N,) float64 strictly increasing timestamps of the depth images, seconds.
        ground_truth: True camera poses if known; used for evaluation only.
    """

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def camera(self) -> "Camera": ...  # noqa: D102
    @property
    def calibration(self) -> "Calibration | None": ...  # noqa: D102
    @property
    def timestamps(self) -> NDArray[np.float64]: ...  # noqa: D102
    @property
    def ground_truth(self) -> "Trajectory | None": ...  # noqa: D102

    def __len__(self) -> int:
        """Number of frames."""
        ...

    def __getitem__(self, index: int) -> "Frame":
        """Frame number ``index``.

        Raises:
            FrameError: This frame cannot be read; the others may be valid.
        """
        ...

    def mask(self, index: int) -> NDArray[np.bool_] | None:
        """True dynamic mask (H, W) of a frame if known; used for evaluation only."""
        ...


class Reader(Protocol):
    """Class of a sequence on disk: can recognise its format and open a folder of it."""

    def __call__(self, path: Path, camera: "Camera | str | None" = None) -> Sequence:
        """Open a recording."""
        ...

    def recognises(self, path: Path) -> bool:
        """Whether a folder has this format."""
        ...


def readers() -> "tuple[Reader, ...]":
    """Readers of all known formats, in the order in which they are tried."""
    from dudmap.sequences.tum import TumSequence

    return (TumSequence,)


def is_recording(path: Path) -> bool:
    """Whether a folder is a recording of a known format."""
    return any(reader.recognises(path) for reader in readers())


def open_sequence(path: str | Path, camera: "Camera | str | None" = None) -> Sequence:
    """Open a recording with the first reader of ``readers()`` that recognises it.

    Args:
        path: Folder in the layout of the TUM RGB-D benchmark.
        camera: Intrinsics that replace those of the recording: a Camera, or text ``fx,fy,cx,cy[,w,h[,depth_scale]]``
            (default: the size of the images and 5000 depth units per metre).

    Raises:
        DatasetError: The folder is missing or not a recording of a known format.
    """
    path = Path(path)
    if not path.exists():
        raise DatasetError(f"there is no folder {path}; expected a recording with rgb.txt and depth.txt")
    if not path.is_dir():
        raise DatasetError(f"{path} is a file; expected a folder with rgb.txt and depth.txt")
    if not any(path.iterdir()):
        raise DatasetError(f"the folder {path} is empty; expected a recording with rgb.txt and depth.txt")
    for reader in readers():
        if reader.recognises(path):
            return reader(path, camera)
    missing = [name for name in ("rgb.txt", "depth.txt") if not (path / name).is_file()]
    raise DatasetError(
        f"{path} is not a recording in TUM layout: {' and '.join(missing)} not found "
        "(an associations.txt would do instead)"
    )
