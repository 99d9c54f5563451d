"""Where a folder's intrinsics may lie: files of the names that data sets and recorders use, in it or one folder up."""

import re
from collections import Counter
from pathlib import Path

import numpy as np

from dudmap.errors import DatasetError
from dudmap.input_files import load_array
from dudmap.io.sequences import camera_json
from dudmap.io.sequences.intrinsics import Intrinsics, from_file, from_matrix

NAMES = (
    "intrinsics.txt", "intrinsics.K.txt", "K.txt", "cam_K.txt", "camera-intrinsics.txt", "camera_intrinsics.txt",
    "intrinsic.txt", "camera-intrinsics.npy", "intrinsics.npy", "cam_K.npy", "K.npy",
)  # fmt: skip
"""Files of one camera: text that ``from_file`` understands, or a matrix as an array. The first that is there counts."""
TREES = ("camera_info.yaml", "calibration.yaml", "cam_params.json", "camera_intrinsic.json", "intrinsic.json")
"""Files of one or two cameras; in the folder itself any JSON or YAML file that is named like one (``NAMED``)."""
NAMED = r".*(cam|intrin|calib).*\.(json|ya?ml)"
SHOWN = 10
"""Kinds of files that a message lists."""
IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm")


def find(folder: Path) -> Intrinsics | None:
    """Intrinsics that lie in a folder or in the one above it; None without a file of a known name.

    Raises:
        DatasetError: The file cannot be understood.
    """
    for place in (folder, folder.resolve().parent):
        for file in (place / name for name in NAMES):
            if file.is_file():
                return _from_array(file) if file.suffix == ".npy" else from_file(file)
        files = [place / name for name in TREES if (place / name).is_file()]
        if place is folder:
            files = [file for file in sorted(place.iterdir()) if re.fullmatch(NAMED, file.name.lower())]
        if files:
            return camera_json.load(files)
    return None


def unknown(folder: Path, why: str = "") -> DatasetError:
    """Error on a recording without intrinsics, which names what is there and how to give them."""
    return DatasetError(
        f"the camera of {folder} is not known{why}: neither {', '.join(NAMES[:4])} nor another file of intrinsics that "
        f"is read (docs/formats.md) lies there or one folder up, only {seen(folder)}; give --camera "
        "fx,fy,cx,cy[,w,h[,depth_scale]]"
    )


def seen(folder: Path) -> str:
    """What lies in a folder: names with their numbers replaced by N, and how many there are of each."""
    names = (re.sub(r"\d+", "N", path.name) + "/" * path.is_dir() for path in sorted(folder.iterdir()))
    kinds = Counter(names)
    shown = [f"{count} x {name}" if count > 1 else name for name, count in list(kinds.items())[:SHOWN]]
    return ", ".join(shown) + (" ..." if len(kinds) > SHOWN else "") if shown else "nothing"


def _from_array(file: Path) -> Intrinsics:
    try:
        return from_matrix(np.asarray(load_array(file), dtype=np.float64).ravel(), file)
    except (OSError, ValueError, EOFError) as error:
        raise DatasetError(f"cannot read the array {file}: {error}") from error
