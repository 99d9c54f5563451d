"""CoRBS (Wasenmueller et al. 2016): Kinect v2, registered images in TUM layout, truth in a second download."""

import re
from pathlib import Path

from dudmap.core.geometry.association import TimedFile
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.io.sequences.archive import origin, unpack
from dudmap.io.sequences.tum import TumSequence

CAMERA = {"fx": 468.60, "fy": 468.61, "cx": 318.27, "cy": 243.99, "width": 640, "height": 480, "depth_scale": 5000.0}
"""Published camera of the pre-registered images."""
FOLDER = re.compile(r"(.+)_pre_?registered_?data", re.IGNORECASE)


class CorbsSequence(TumSequence):
    """Folder ``D1_pre_registereddata`` with rgb.txt and depth.txt, whose paths may be written with backslashes.

    The truth is groundtruth.txt in the folder, or in the folder or archive ``D1_Trajectory`` beside it, as downloaded.
    """

    format = "CoRBS"
    published = "CoRBS", CAMERA

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether a folder has the layout and the name of this data set."""
        return TumSequence.recognises(path) and FOLDER.fullmatch(path.resolve().name) is not None

    def _find_pairs(self) -> list[tuple[TimedFile, TimedFile]]:
        return [(_slashed(color), _slashed(depth)) for color, depth in super()._find_pairs()]

    def _find_ground_truth(self) -> Trajectory | None:
        truth = super()._find_ground_truth()
        match = FOLDER.fullmatch(self.name)
        if truth is not None or match is None:
            return truth
        archive = origin(self.path)
        for place in (self.path.parent, *(() if archive is None else (archive.parent,))):
            file = place / f"{match.group(1)}_Trajectory"
            if not file.is_dir() and file.with_name(file.name + ".zip").is_file():
                file = unpack(file.with_name(file.name + ".zip"))
            found = sorted(file.rglob("groundtruth.txt")) if file.is_dir() else []
            if found:
                return Trajectory.load(found[0])
        return None


def _slashed(file: TimedFile) -> TimedFile:
    return TimedFile(file.timestamp, Path(str(file.path).replace("\\", "/")))
