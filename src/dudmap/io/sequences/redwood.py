"""Redwood data sets and folders of Open3D's reconstruction system: numbered images and a ``.log`` trajectory."""

import re
from pathlib import Path

from dudmap.core.geometry.association import TimedFile
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.io.sequences import intrinsics
from dudmap.io.sequences.image_folder import FRAME_RATE, ImageFolder, numbered_files
from dudmap.io.sequences.poses import read_log, rigid_trajectory

CAMERA = {"fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480, "depth_scale": 1000.0}
"""PrimeSense default, the camera of the Redwood data sets."""
NAMES = r"redwood|/(burghers|cactusgarden|copyroom|lounge|readingroom|stonewall|totempole)(_png)?$"
"""Path of a recording of these data sets; object scans are known by the names of their files."""
COLORS = ("color", "rgb", "image", "image_2d")
"""Names of the colour folder that Open3D's reconstruction system takes."""
OBJECT_SCAN = r"\d{7}-\d{12}\.(?:jpe?g|png)"
"""File names of the Redwood object scans: frame number and microseconds."""


class RedwoodSequence(ImageFolder):
    """Folder with ``color`` (or rgb, image) and ``depth`` (mm) and a ``*.log`` in it or beside it, or an object scan.

    A ``.log`` holds camera-to-world matrices by frame number, counted from the first image; ``scene/trajectory.log`` is
    Open3D's own estimate and no truth. Intrinsics come from a JSON file of Open3D in the folder; of these data sets
    they are known.
    """

    format = "Redwood or Open3D"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether a folder has this layout."""
        if not (path / "depth").is_dir() or _color_folder(path) is None:
            return False
        scan = any(re.fullmatch(OBJECT_SCAN, file.name) for file in (path / "depth").glob("*.png"))
        return scan or bool(_logs(path)) or (path / "camera_primesense.json").is_file()

    def _find_pairs(self) -> list[tuple[TimedFile, TimedFile]]:
        color = _color_folder(self.path)
        colors, depths = list(color.iterdir()) if color else [], list((self.path / "depth").iterdir())
        timed = {
            int(file.stem[:7]): int(file.stem[8:]) / 1e6 for file in depths if re.fullmatch(OBJECT_SCAN, file.name)
        }
        pattern = r"(\d{7})-\d{12}\.(?:jpe?g|png)" if timed else r"\D*(\d+)\.(?:jpe?g|png)"
        pairs = self._pair_numbered(numbered_files(colors, pattern), numbered_files(depths, pattern))
        if not timed:
            return pairs
        self.timed = True
        stamps = [timed[int(depth.path.stem[:7])] for _, depth in pairs]
        return [(TimedFile(t, c.path), TimedFile(t, d.path)) for t, (c, d) in zip(stamps, pairs, strict=True)]

    def _published(self) -> intrinsics.Intrinsics | None:
        if self.timed or re.search(NAMES, self.path.resolve().as_posix(), flags=re.IGNORECASE):
            return intrinsics.Intrinsics(dict(CAMERA), f"the camera of Redwood{intrinsics.BY_NAME}")
        return None

    def _find_ground_truth(self) -> Trajectory | None:
        logs = _logs(self.path)
        if len(logs) != 1:
            return None
        poses = read_log(logs[0])
        first = round(float(self.timestamps[0]) * FRAME_RATE)
        return rigid_trajectory(((first + n) / FRAME_RATE, poses[n]) for n in sorted(poses))


def _color_folder(path: Path) -> Path | None:
    return next((path / name for name in COLORS if (path / name).is_dir()), None)


def _logs(path: Path) -> list[Path]:
    """Trajectories in a folder, by name or else any, or beside it: ``copyroom_trajectory.log`` for ``copyroom_png``."""
    name = path.resolve().name.removesuffix("_png")
    inside = sorted(path.glob("*traj*.log")) or sorted(path.glob("*.log"))
    return inside or sorted(path.resolve().parent.glob(f"{name}[_-]traj*.log"))
