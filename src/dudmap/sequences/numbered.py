"""Numbered colour and depth images in any plain folder: exports of ZED, RealSense, Azure Kinect, your own camera."""

import re
from pathlib import Path

import numpy as np

from dudmap.errors import DatasetError
from dudmap.geometry.association import TimedFile, associate
from dudmap.geometry.trajectory import Trajectory
from dudmap.sequences import camera_json, intrinsics
from dudmap.sequences.image_folder import ImageFolder

IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm")
DEPTH_WORDS = ("depth",)
COLOR_WORDS = ("color", "colour", "rgb", "left", "image", "img", "mono")
NEITHER_WORDS = ("confidence", "right", "mask", "normal", "vis", "infra", "ir")
"""Words of files and folders that hold other images than depth and colour."""
LARGEST_NUMBER = 10**8
"""From here on a number in a file name is a time, not the number of a frame: 38 days at 30 frames a second."""
TIME_UNITS = ((1e17, 1e9), (1e14, 1e6), (1e11, 1e3), (0.0, 1.0))
"""Smallest value and units per second of times since 1970: ns, us, ms, s. All lie between 1973 and 5138."""


class NumberedSequence(ImageFolder):
    """Folder of numbered images, in two folders (``color/000001.png``, ``depth/000001.png``) or in one.

    Which images are depth and colour is told by words in the names of files and folders. Equal numbers pair, 30 frames
    a second; numbers above 10^8 are times, which pair at 20 ms. Depth: 16 bit in millimetres, or float metres.
    Intrinsics come from intrinsics.txt, from JSON files beside the images, or from ``camera``; groundtruth.txt is read.
    """

    format = "numbered images"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether a folder holds depth and colour images by the words of their names."""
        return path.is_dir() and all(_kinds(path).values())

    def _find_pairs(self) -> list[tuple[TimedFile, TimedFile]]:
        kinds = _kinds(self.path)
        colors, depths = ({_number(file): file for file in kinds[kind]} for kind in ("color", "depth"))
        if max(map(abs, colors)) < LARGEST_NUMBER and all(float(n).is_integer() for n in (*colors, *depths)):
            return self._pair_numbered({int(n): f for n, f in colors.items()}, {int(n): f for n, f in depths.items()})
        first = sorted(TimedFile(_seconds(n), file) for n, file in colors.items())
        second = sorted(TimedFile(_seconds(n), file) for n, file in depths.items())
        pairs = associate(np.array([f.timestamp for f in first]), np.array([f.timestamp for f in second]))
        if not pairs:
            raise DatasetError(
                f"{self.path}: by the times in the names no colour image lies within 20 ms of a depth image"
            )
        return [(first[i], second[j]) for i, j in pairs]

    def _find_intrinsics(self) -> intrinsics.Intrinsics:
        own = intrinsics.own(self.path, self.depth_scale)
        if own is not None:
            return own
        files = sorted(file for file in self.path.glob("*.json") if re.search("cam|intrin|calib", file.name.lower()))
        if files:
            return camera_json.load(files, self.depth_scale)
        raise DatasetError(
            f"the camera of {self.path} is not known: it has neither an intrinsics.txt nor a JSON file of intrinsics; "
            "give --camera fx,fy,cx,cy[,w,h[,depth_scale]] (depth_scale: units per metre, 1000 unless given)"
        )

    def _find_ground_truth(self) -> Trajectory | None:
        file = self.path / "groundtruth.txt"
        return Trajectory.load(file) if file.is_file() else None


def _kinds(path: Path) -> dict[str, list[Path]]:
    """Numbered colour and depth images of a folder, or of one folder of each kind in it."""
    found = _sorted_out(path)
    if not all(found.values()):
        for kind, words in (("color", COLOR_WORDS), ("depth", DEPTH_WORDS)):
            folders = [p for p in sorted(path.iterdir()) if p.is_dir() and _kind_of(p.name) == kind]
            folders.sort(key=lambda p: [word in p.name.lower() for word in words], reverse=True)
            numbered = ([f for f in sorted(folder.iterdir()) if _is_numbered_image(f)] for folder in folders)
            found[kind] = next((files for files in numbered if files), [])
    return found


def _sorted_out(path: Path) -> dict[str, list[Path]]:
    """Colour and depth images among the files of one folder."""
    files = [file for file in sorted(path.iterdir()) if _is_numbered_image(file)]
    return {kind: [file for file in files if _kind_of(file.stem) == kind] for kind in ("color", "depth")}


def _kind_of(name: str) -> str | None:
    words = re.findall("[a-z]+", name.lower())
    text = " ".join(words)
    if any(word in NEITHER_WORDS or word.startswith(("confid", "mask")) for word in words):
        return None
    if any(word in text for word in DEPTH_WORDS):
        return "depth"
    return "color" if any(word in text for word in COLOR_WORDS) else None


def _is_numbered_image(file: Path) -> bool:
    return file.suffix.lower() in IMAGES and re.search(r"\d", file.stem) is not None


def _number(file: Path) -> float:
    """Last number in a file's name; a decimal one counts as a whole."""
    return float(re.findall(r"\d+(?:\.\d+)?", file.stem)[-1])


def _seconds(number: float) -> float:
    return next(number / units for smallest, units in TIME_UNITS if number >= smallest)
