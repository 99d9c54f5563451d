"""What the recordings of all formats have in common."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import FrameError
from dudmap.input_files import damaged
from dudmap.io.sequences import intrinsics


class Recording(ABC):
    """A sequence on disk: recognises its format, opens a folder or file of it, and reads a frame when it is asked for.

    A format sets the times, the cameras and their sources in its constructor, and reads a frame in ``_frame``.
    Constructors take the options of the format, too; they raise a ``DatasetError`` for a recording that is damaged or
    of another kind, and a ``MissingExtraError`` where a package is missing.

    Args:
        path: The folder or file.
        camera: Intrinsics of the depth images that replace those of the recording.

    Attributes:
        format: Name of the format, for people.
        options: Names of the options of ``open_sequence`` that the format has.
        name: Name of the folder, or of the file without its suffix.
        camera: Intrinsics of the depth images.
        calibration: Of the colour camera, None for colour that is registered to depth.
        timestamps: (N,) strictly increasing timestamps of the depth images, seconds.
        ground_truth: True camera poses, None if they are not known.
        sources: Where ``intrinsics``, ``depth unit`` and ``times`` come from: a file, a data set's name, an option, or
            that they are assumed.
        timed: Whether the times were read or their rate was given; False where they are invented.
        opened: Arguments of ``open_sequence`` that open it again, with an absolute path.
    """

    format = ""
    options: tuple[str, ...] = ()
    suffix = ""
    """Suffix of the files of the format, where it is that of files."""
    layout: tuple[str, ...] = ()
    """Patterns of files and folders that all lie in every folder of the format."""
    timed = True
    camera: Camera
    calibration: Calibration | None = None
    timestamps: NDArray[np.float64]
    ground_truth: Trajectory | None = None
    sources: dict[str, str]
    opened: dict[str, Any]

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.name = self.path.resolve().stem

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether an existing folder or file has this format, judged by names and first bytes only."""
        if cls.suffix:
            return path.suffix.lower() == cls.suffix and path.is_file()
        return path.is_dir() and all(any(path.glob(pattern)) for pattern in cls.layout)

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
        """True dynamic mask (H, W) of a frame, None if it is not known."""
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
