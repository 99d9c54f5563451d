"""Recordings in one file: what their formats share."""

from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import FrameError
from dudmap.input_files import damaged
from dudmap.io.sequences import intrinsics


class FileRecording(ABC):
    """Base class of recordings in one file.

    A format sets the times and the cameras in its constructor, and reads a frame in ``_frame``.

    Args:
        path: The file.

    Attributes:
        name: Name of the file without its suffix.
        camera: Intrinsics of the depth images.
        sources: Where the intrinsics, the depth unit and the times come from.
        calibration: Of the colour camera, None for colour that is registered to depth.
        timestamps: (N,) strictly increasing timestamps of the depth images, seconds.
        ground_truth: True camera poses, None if they are not known.
    """

    format = ""
    suffix = ""
    """By which the format is recognised."""
    options: tuple[str, ...] = ()
    camera: Camera
    timed = True
    sources: dict[str, str]
    calibration: Calibration | None = None
    timestamps: NDArray[np.float64]
    ground_truth: Trajectory | None = None

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.name = self.path.resolve().stem

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a file has the suffix of the format."""
        return path.suffix.lower() == cls.suffix and path.is_file()

    def __len__(self) -> int:
        return len(self.timestamps)

    def __getitem__(self, index: int) -> Frame:
        """Frame number ``index``.

        Raises:
            FrameError: An image is missing, damaged, or has another size than its camera.
        """
        index = range(len(self))[index]
        name = f"frame {index} of {self.path}"
        with damaged(FrameError, name):
            return self._frame(index, name)

    def mask(self, index: int) -> NDArray[np.bool_] | None:
        """No true masks are known."""
        return None

    @abstractmethod
    def _frame(self, index: int, name: str) -> Frame:
        """A frame; ``name`` is used in messages."""

    def _set_cameras(self, own: Camera, color: Calibration, source: str, given: Camera | str | None) -> None:
        """Set the cameras: those of the file, where the depth camera may be given instead."""
        known = intrinsics.given(given) if given else None
        self.camera = known.camera(own.width, own.height, own.depth_scale) if known else own
        one_size = (color.camera.width, color.camera.height) == (own.width, own.height)
        self.calibration = None if color.is_registered(self.camera) or (known and one_size) else color
        unit = known.source if known and "depth_scale" in known.values else source
        self.sources = {"intrinsics": known.source if known else source, "depth unit": unit, "times": source}
