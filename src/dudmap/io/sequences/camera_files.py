"""Intrinsics in files of known names: Open3D, NICE-SLAM, librealsense, ZED, ROS, Kalibr, ORB-SLAM. Bad files raise a
``DatasetError``."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dudmap.core.geometry import se3
from dudmap.errors import DatasetError
from dudmap.input_files import damaged, load_array, read_json
from dudmap.io.sequences.camera_content import cameras_in
from dudmap.io.sequences.camera_values import SETTINGS, depth_scale, numbers_of, read_yaml, values_of
from dudmap.io.sequences.intrinsics import (
    Intrinsics,
    from_file,
    from_matrix,
)

FILES = (
    "intrinsics.txt", "intrinsics.K.txt", "K.txt", "cam_K.txt", "camera-intrinsics.txt", "camera_intrinsics.txt",
    "intrinsic.txt", "camera-intrinsics.npy", "intrinsics.npy", "cam_K.npy", "K.npy",
)  # fmt: skip
"""Files of one camera: text, or a matrix as an array; the first one is used."""
TREES = ("camera_info.yaml", "calibration.yaml", "cam_params.json", "camera_intrinsic.json", "intrinsic.json")
"""Files of one or two cameras; also any JSON or YAML with such a name (``NAMED``)."""
NAMED = r".*(cam|intrin|calib).*\.(json|ya?ml)"
LARGEST_SETTINGS = 1 << 16
LARGEST_LIST = 5
IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".exr", ".webp")
MOTIONS = ("T_color_depth", "depth_to_color", "extrinsics_depth_to_color")
"""Names of a 4x4 matrix from depth to colour camera."""


def find(folder: Path) -> Intrinsics | None:
    """Intrinsics in a folder or its parent; None without a file of a known name."""
    for place in (folder, folder.resolve().parent):
        for file in (place / name for name in FILES):
            if file.is_file() and file.suffix == ".npy":
                with damaged(DatasetError, f"the array {file}"):
                    return from_matrix(np.asarray(load_array(file), dtype=np.float64).ravel(), file)
            if file.is_file():
                return _of_file(file)
        files = [place / name for name in TREES if (place / name).is_file()]
        if place is folder:
            files = [file for file in sorted(place.iterdir()) if re.fullmatch(NAMED, file.name.lower())]
            files = files or [file for file in sorted(place.glob("*.yaml")) if _are_settings(file)]
        if files:
            try:
                return load(files)
            except DatasetError as error:
                raise UnclearFilesError(str(error)) from error
    return None


class UnclearFilesError(DatasetError):
    """Files of a usual name are no JSON or YAML of one or two cameras."""


def _of_file(file: Path) -> Intrinsics:
    try:
        return from_file(file)
    except DatasetError:
        cameras = cameras_in(file)
        if not cameras or any("color" in name or values != cameras[0][1] for name, values in cameras):
            raise
        return Intrinsics(cameras[0][1], str(file))


def unknown(folder: Path, why: str = "") -> DatasetError:
    """Error on a recording without intrinsics: existing files and remedy."""
    return DatasetError(
        f"the camera of {folder} is not known{why}: neither {', '.join(FILES[:4])} nor another known file of "
        f"intrinsics (docs/formats.md) is in it or its parent, only {seen(folder)}; give --camera "
        "fx,fy,cx,cy[,w,h[,depth_scale]]"
    )


def seen(folder: Path) -> str:
    """Content of a folder: names with numbers as N, and counts."""
    kinds = Counter(re.sub(r"\d+", "N", path.name) + "/" * path.is_dir() for path in sorted(folder.iterdir()))
    shown = [f"{count} x {name}" if count > 1 else name for name, count in list(kinds.items())[:LARGEST_LIST]]
    return ", ".join(shown) + (" ..." if len(kinds) > LARGEST_LIST else "") if shown else "nothing"


def load(paths: Iterable[Path]) -> Intrinsics:
    """Intrinsics of JSON and YAML files: every object with focal lengths and principal point is a camera, of depth if
    file or parent key contains "depth".

    A depth scale below 1 is metres per unit.
    """
    cameras: list[tuple[str, dict[str, float]]] = []
    scale, motion, files = {}, np.eye(4), list(paths)
    for path in files:
        tree = _read(path)
        cameras += _cameras(tree, path.stem.lower())
        unit = depth_scale(tree)
        scale = {"depth_scale": unit} if unit else scale
        found = (numbers_of(tree.get(name), 16) for name in MOTIONS) if isinstance(tree, dict) else ()
        motion = next((numbers.reshape(4, 4) for numbers in found if numbers is not None), motion)
    source = " and ".join(path.name for path in files)
    depths = [values for name, values in cameras if "depth" in name]
    colors = [values for name, values in cameras if "depth" not in name and "right" not in name]
    if not cameras:
        raise DatasetError(
            f"{source} gives no camera; expected fx, fy, cx and cy, or a 3x3 matrix: give --camera "
            "fx,fy,cx,cy[,w,h[,depth_scale]]"
        )
    if len(depths) > 1 or len(colors) > 1:
        raise DatasetError(
            f"{source} gives {len(depths)} depth and {len(colors)} other cameras; expected one of each at most: "
            "give --camera fx,fy,cx,cy[,w,h[,depth_scale]]"
        )
    if not depths:
        return Intrinsics(colors[0] | scale, source)
    color = colors[0] if colors and colors[0] != depths[0] else {}
    return Intrinsics(depths[0] | scale, source, color, se3.inverse(motion))


def _read(path: Path) -> Any:  # noqa: ANN401 - any JSON value
    try:
        return read_yaml(path) if path.suffix.lower() in (".yaml", ".yml") else read_json(path)
    except (OSError, ValueError) as error:
        raise DatasetError(f"cannot read {path}: {error}") from error


def _are_settings(file: Path) -> bool:
    with file.open(encoding="utf-8", errors="replace") as text:
        head = text.read(LARGEST_SETTINGS)
    return any(f"\n{start}fx" in head for start in SETTINGS)


def _cameras(tree: Any, name: str) -> Iterator[tuple[str, dict[str, float]]]:  # noqa: ANN401
    if isinstance(tree, list):
        for below in tree:
            yield from _cameras(below, name)
    elif isinstance(tree, dict) and (values := values_of(tree)) is not None:
        yield name, values
    elif isinstance(tree, dict):
        for key, below in tree.items():
            yield from _cameras(below, f"{name}/{key.lower()}")
