"""Recordings on disk: one small reader per format, all giving the same kind of object."""

from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import DatasetError

if TYPE_CHECKING:
    from dudmap.frames.frame import Frame
    from dudmap.geometry.camera import Camera
    from dudmap.geometry.trajectory import Trajectory

__all__ = ["Sequence", "open_sequence"]


@runtime_checkable
class Sequence(Protocol):
    """A recording with random access; everything that Slam is fed from has this shape.

    Attributes:
        name: Short name, fit for a folder.
        camera: Intrinsics of all frames; colour and depth share them.
        timestamps: (N,) float64, seconds, strictly increasing, of the depth images.
        ground_truth: True camera poses, if known; for scoring only.
    """

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def camera(self) -> "Camera": ...  # noqa: D102
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
            FrameError: This one frame cannot be read; the others may be fine.
        """
        ...

    def mask(self, index: int) -> NDArray[np.bool_] | None:
        """True dynamic mask (H, W) of a frame if known; for scoring only."""
        ...


def open_sequence(path: str | Path, camera: "Camera | str | None" = None) -> Sequence:
    """Recognise and open a recording.

    Args:
        path: Folder in the layout of the TUM RGB-D benchmark.
        camera: Intrinsics that replace those of the recording: a Camera, or text ``fx,fy,cx,cy[,w,h[,depth_scale]]``
            (size from the images and 5000 units per metre where left out).

    Raises:
        DatasetError: Nothing readable is there; the message says what was found and what was expected.
    """
    from dudmap.sequences.tum import TumSequence

    path = Path(path)
    if not path.exists():
        raise DatasetError(f"there is no folder {path}; expected a recording with rgb.txt and depth.txt")
    if not path.is_dir():
        raise DatasetError(f"{path} is a file; expected a folder with rgb.txt and depth.txt")
    if not any(path.iterdir()):
        raise DatasetError(f"the folder {path} is empty; expected a recording with rgb.txt and depth.txt")
    if TumSequence.recognises(path):
        return TumSequence(path, camera)
    missing = [name for name in ("rgb.txt", "depth.txt") if not (path / name).is_file()]
    raise DatasetError(
        f"{path} is not a recording in TUM layout: {' and '.join(missing)} not found "
        "(an associations.txt would do instead)"
    )
