"""Recordings of a benchmark: descriptions that another process can open, and frames that are read once."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dudmap.errors import DatasetError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from dudmap.core.frames.frame import Frame
    from dudmap.core.geometry.mesh import Mesh
    from dudmap.io.sequences import Sequence


@dataclass(frozen=True)
class Entry:
    """One recording of a suite.

    Attributes:
        name: Name in tables, folders and published figures.
        path: Folder, file or archive of a recording on disk; None for a synthetic one.
        parameters: Arguments of ``lab.synthetic.sequence``; ``camera`` is a (width, height) in pixels, ``faults`` a
            mapping of the fields of ``SensorFaults`` that differ from those of the sensor.
        address: Public page it can be downloaded from, empty if there is none.
        max_frames: Use only this many frames from the start.
    """

    name: str
    path: Path | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict, hash=False)
    address: str = ""
    max_frames: int | None = None

    def open(self) -> "Sequence":
        """Open the recording, or set up the synthetic one.

        Raises:
            DatasetError: The folder is missing or not a recording.
        """
        if self.path is not None:
            from dudmap.io.sequences import open_sequence

            return open_sequence(self.path)
        from dudmap.lab.synthetic import sequence

        return sequence(**self.parameters)

    def surfaces(self, sequence: "Sequence") -> "tuple[Mesh, Mesh] | None":
        """True static surface and its observed part, in the frame of the ground truth, if known."""
        from dudmap.core.geometry.mesh import Mesh
        from dudmap.lab.synthetic.recording import SyntheticSequence

        if isinstance(sequence, SyntheticSequence):
            return sequence.surface(), sequence.surface(observed=True)
        if self.path is None or not (self.path / "surface.ply").is_file():
            return None
        whole, seen = self.path / "surface.ply", self.path / "surface_observed.ply"
        return Mesh.load(whole), Mesh.load(seen if seen.is_file() else whole)


def local_entries(data: Path) -> list[Entry]:
    """Every recording in a folder, or the folder itself if it is a recording.

    Raises:
        DatasetError: No recording was found.
    """
    from dudmap.io.sequences import is_recording

    if not data.is_dir():
        raise DatasetError(f"there is no folder {data}; expected one that holds recordings")
    folders = [data, *sorted(child for child in data.iterdir() if child.is_dir())]
    found = [Entry(folder.resolve().name, folder) for folder in folders if is_recording(folder)]
    if not found:
        raise DatasetError(f"no recording found in {data}; `dudmap info` says what it finds in a folder")
    return found


class Excerpt:
    """The first frames of a recording, all without a number, each of which is read or rendered once."""

    def __init__(self, recording: "Sequence", frames: int | None = None) -> None:
        self.recording, self.timestamps = recording, recording.timestamps[:frames]
        self.name, self.camera = recording.name, recording.camera
        self.calibration, self.ground_truth = recording.calibration, recording.ground_truth
        self._frames: dict[int, Frame] = {}
        self._masks: dict[int, NDArray[np.bool_] | None] = {}

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - what else the recording has
        return getattr(self.recording, name)

    def __len__(self) -> int:
        return len(self.timestamps)

    def __getitem__(self, index: int) -> "Frame":
        if index not in self._frames:
            self._frames[index] = self.recording[index]
        return self._frames[index]

    def mask(self, index: int) -> "NDArray[np.bool_] | None":
        """True dynamic mask (H, W) of a frame if known."""
        if index not in self._masks:
            self._masks[index] = self.recording.mask(index)
        return self._masks[index]

    def load(self) -> "Excerpt":
        """Read or render all frames and masks now, so that this falls into the time of nobody."""
        for index in range(len(self)):
            _ = self[index], self.mask(index)
        return self
