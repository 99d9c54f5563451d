"""What a suite consists of: recordings on disk and synthetic ones, described so that another process can open them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dudmap.errors import DatasetError

if TYPE_CHECKING:
    from dudmap.geometry.mesh import Mesh
    from dudmap.sequences import Sequence


@dataclass(frozen=True)
class Entry:
    """One recording of a suite.

    Attributes:
        name: Name in tables, of folders and in the published values.
        path: Folder of a recording on disk; None for a synthetic one.
        parameters: Arguments of ``dudmap.synthetic.sequence``; ``camera`` is a (width, height) in pixels.
        address: Public page a user can download it from, empty if there is none.
        camera: Intrinsics as text for a recording that does not know its own.
        max_frames: Use only the first frames.
    """

    name: str
    path: Path | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict)
    address: str = ""
    camera: str | None = None
    max_frames: int | None = None

    def open(self) -> "Sequence":
        """The recording.

        Raises:
            DatasetError: The folder is missing or not a recording.
        """
        if self.path is not None:
            from dudmap.geometry.trajectory import Trajectory
            from dudmap.sequences import open_sequence
            from dudmap.sequences.tum import TumSequence

            recording = open_sequence(self.path, self.camera)
            beside = sorted(self.path.glob("*.gt.freiburg"))  # the name that ICL-NUIM gives its ground truth
            if isinstance(recording, TumSequence) and recording.ground_truth is None and len(beside) == 1:
                recording.ground_truth = Trajectory.load(beside[0])
            return recording
        from dudmap.synthetic import sequence
        from dudmap.synthetic.recording import DEFAULT_CAMERA

        size = self.parameters.get("camera", (DEFAULT_CAMERA.width, DEFAULT_CAMERA.height))
        return sequence(**{**self.parameters, "camera": DEFAULT_CAMERA.resized(*size)})

    def surfaces(self, sequence: "Sequence") -> "tuple[Mesh, Mesh] | None":
        """True static surface in the frame of the ground truth, whole and as far as the camera saw it, if known."""
        from dudmap.geometry.mesh import Mesh
        from dudmap.synthetic.recording import SyntheticSequence

        if isinstance(sequence, SyntheticSequence):
            return sequence.surface(), sequence.surface(observed=True)
        if self.path is None or not (self.path / "surface.ply").is_file():
            return None
        whole, seen = self.path / "surface.ply", self.path / "surface_observed.ply"
        return Mesh.load(whole), Mesh.load(seen if seen.is_file() else whole)


def local_entries(data: Path) -> list[Entry]:
    """Every recording in a folder, or the folder itself if it is one.

    Raises:
        DatasetError: There is none.
    """
    from dudmap.sequences.tum import TumSequence

    if not data.is_dir():
        raise DatasetError(f"there is no folder {data}; expected one that holds recordings")
    folders = [data, *sorted(child for child in data.iterdir() if child.is_dir())]
    found = [Entry(folder.resolve().name, folder) for folder in folders if TumSequence.recognises(folder)]
    if not found:
        raise DatasetError(f"no recording found in {data}; expected folders with rgb.txt and depth.txt")
    return found
