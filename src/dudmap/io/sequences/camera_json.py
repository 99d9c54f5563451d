"""Intrinsics of JSON and YAML files: Open3D, NICE-SLAM, librealsense, ZED, ROS, Kalibr, and plain keys."""

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.errors import DatasetError
from dudmap.input_files import read_json
from dudmap.io.sequences.intrinsics import KEYS, Intrinsics
from dudmap.io.sequences.yaml_files import read_yaml

NAMES = {
    "fx": ("fx", "fl_x", "focal_x"),
    "fy": ("fy", "fl_y", "focal_y"),
    "cx": ("cx", "ppx", "principal_x"),
    "cy": ("cy", "ppy", "principal_y"),
    "width": ("width", "w", "image_width"),
    "height": ("height", "h", "image_height"),
    "depth_scale": ("depth_scale", "scale", "png_depth_scale", "depth_map_factor"),
    "k1": ("k1",), "k2": ("k2",), "p1": ("p1",), "p2": ("p2",), "k3": ("k3",),
}  # fmt: skip
"""Our key and the names it has in files."""
MATRICES = ("intrinsic_matrix", "camera_matrix", "cam_K", "K", "k")
LENSES = ("coeffs", "disto", "distortion", "distortion_coefficients", "distortion_coeffs", "D", "d")
"""Names of the intrinsic matrix and of the coefficients of the lens: a list, or a ``data`` list as OpenCV writes it."""
OTHER_LENSES = ("equidistant", "fisheye", "kannala_brandt4", "equi")
MOTIONS = ("T_color_depth", "depth_to_color", "extrinsics_depth_to_color")
"""Names of a 4x4 matrix that takes points of the depth camera to the colour camera."""


def load(paths: Iterable[Path]) -> Intrinsics:
    """Intrinsics of JSON and YAML files: of one camera, or of a depth and a colour camera.

    Every object that holds focal lengths and a principal point is a camera; it is a depth camera where a name on the
    way to it, the file's included, contains "depth". A depth scale below 1 is metres per unit.

    Args:
        paths: The files.

    Raises:
        DatasetError: A file cannot be read, or there is no camera or more than one of a kind.
    """
    cameras: list[tuple[str, dict[str, float]]] = []
    scale, motion, files = {}, np.eye(4), list(paths)
    for path in files:
        tree = _read(path)
        cameras += _cameras(tree, path.stem.lower())
        unit = _depth_scale(tree)
        scale = {"depth_scale": unit} if unit else scale
        motion = _motion(tree, motion)
    source = " and ".join(path.name for path in files)
    depths = [values for name, values in cameras if "depth" in name]
    colors = [values for name, values in cameras if "depth" not in name and "right" not in name]
    if len(depths) > 1 or len(colors) > 1 or not cameras:
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


def _cameras(tree: Any, name: str) -> Iterator[tuple[str, dict[str, float]]]:  # noqa: ANN401
    """Names and values of all cameras below a JSON value."""
    if isinstance(tree, dict):
        values = values_of(tree)
        if values is not None:
            yield name, values
            return
        for key, below in tree.items():
            yield from _cameras(below, f"{name}/{key.lower()}")
    elif isinstance(tree, list):
        for below in tree:
            yield from _cameras(below, name)


def values_of(tree: dict[str, Any]) -> dict[str, float] | None:
    """Numbers by our keys of one JSON object; None if it is no camera.

    A matrix has 9 numbers row by row, or column by column (Open3D), or 3 rows of 3; its last row is 0 0 1.

    Raises:
        DatasetError: The lens model is another one than Brown and Conrady's with up to five coefficients.
    """
    values = {}
    for key, names in NAMES.items():
        found = next((tree[name] for name in names if _is_finite(tree.get(name))), None)
        if found is not None and key != "depth_scale":
            values[key] = float(found)
    K = _numbers(_first(tree, MATRICES), 9)
    if K is not None:
        K = K.reshape(3, 3)
        K = K.T if K[2, 0] or K[2, 1] else K
        values |= {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    four = _numbers(tree.get("intrinsics"), 4)
    if four is not None:
        values |= dict(zip(KEYS[:4], four.tolist(), strict=True))
    lens = _first(tree, LENSES)
    if isinstance(lens, list) and lens and all(map(_is_finite, lens)):
        model = str(tree.get("distortion_model", tree.get("model", "")))
        if any(lens) and (any(lens[5:]) or model.lower() in OTHER_LENSES):
            raise DatasetError(
                f"the lens {lens} of the model {model or 'that is not named'} is not read; expected k1 k2 p1 p2 [k3]: "
                "rectify the images, or give --camera fx,fy,cx,cy[,w,h[,depth_scale]]"
            )
        values |= dict(zip(KEYS[7:], map(float, lens[:5]), strict=False))
    return values if all(key in values for key in KEYS[:4]) else None


def _first(tree: dict[str, Any], names: tuple[str, ...]) -> Any:  # noqa: ANN401
    """Value of the first of some names, of a matrix in OpenCV's form its data."""
    value = next((tree[name] for name in names if name in tree), None)
    return value.get("data") if isinstance(value, dict) else value


def _depth_scale(tree: Any) -> float | None:  # noqa: ANN401
    """Depth units per metre anywhere in a JSON value."""
    if isinstance(tree, list):
        return next((scale for below in tree if (scale := _depth_scale(below))), None)
    if not isinstance(tree, dict):
        return None
    for name in NAMES["depth_scale"]:
        value = tree.get(name)
        if _is_finite(value) and value > 0:
            return float(value) if value >= 1 else 1.0 / value
    return next((scale for below in tree.values() if (scale := _depth_scale(below))), None)


def _motion(tree: Any, default: NDArray[np.float64]) -> NDArray[np.float64]:  # noqa: ANN401
    """T_color_depth of one of the names ``MOTIONS`` at the top of a JSON object."""
    for name in MOTIONS:
        numbers = _numbers(tree.get(name), 16) if isinstance(tree, dict) else None
        if numbers is not None:
            return numbers.reshape(4, 4)
    return default


def _is_finite(value: Any) -> TypeGuard[int | float]:  # noqa: ANN401 - any JSON value
    return isinstance(value, int | float) and math.isfinite(value)


def _numbers(value: Any, count: int) -> NDArray[np.float64] | None:  # noqa: ANN401
    """Numbers (count,) of a list or of a list of rows; None if it is something else."""
    if not isinstance(value, list):
        return None
    flat = [number for row in value for number in (row if isinstance(row, list) else [row])]
    if len(flat) != count or not all(map(_is_finite, flat)):
        return None
    return np.array(flat, dtype=np.float64)
