"""Intrinsics in JSON or YAML values under usual names."""

import math
import re
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
import yaml
from numpy.typing import NDArray

from dudmap.core.geometry.camera import Camera
from dudmap.errors import DatasetError
from dudmap.input_files import LARGEST_TREE, read_text
from dudmap.io.sequences.intrinsics import DISTORTION_KEYS, INVERSE, KEYS, brown_of_inverse, camera_values

SETTINGS = "Camera.", "Camera1."
"""Prefixes of camera keys in ORB-SLAM's settings files."""
NAMES = {
    "fx": ("fx", "fl_x", "focal_x"), "fy": ("fy", "fl_y", "focal_y"), "cx": ("cx", "ppx", "principal_x"),
    "cy": ("cy", "ppy", "principal_y"), "width": ("width", "w", "image_width"),
    "height": ("height", "h", "image_height"), **{key: (key,) for key in DISTORTION_KEYS},
}  # fmt: skip
SCALES = ("depth_scale", "scale", "png_depth_scale", "depth_map_factor", "DepthMapFactor", "RGBD.DepthMapFactor")
MATRICES = ("intrinsic_matrix", "camera_matrix", "cam_K", "K", "k")
LENSES = ("coeffs", "disto", "distortion", "distortion_coefficients", "distortion_coeffs", "dist_coeffs", "distCoeffs",
          "dist_coeff", "dist", "D", "d")  # fmt: skip
OTHER_LENSES = ("equidistant", "fisheye", "kannala_brandt4", "equi")


def values_of(tree: dict[str, Any]) -> dict[str, float] | None:
    """Numbers by dudmap's keys of one object, or None; a matrix has 9 numbers by rows, by columns (Open3D), or 3
    rows."""
    values = {}
    tree = tree | {str(key).partition(".")[2]: tree[key] for key in tree if str(key).startswith(SETTINGS)}
    for key, names in NAMES.items():
        found = next((tree[name] for name in names if _is_finite(tree.get(name))), None)
        if found is not None:
            values[key] = float(found)
    K = numbers_of(_first(tree, MATRICES), 9)
    if K is not None:
        K = K.reshape(3, 3)
        K = K.T if K[2, 0] or K[2, 1] else K
        values |= camera_values(K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    four = numbers_of(tree.get("intrinsics"), 4)
    if four is not None:
        values |= camera_values(*four)
    lens = _first(tree, LENSES)
    rows = lens if isinstance(lens, list) else []
    lens = [number for row in rows for number in (row if isinstance(row, list) else [row])]
    if lens and all(map(_is_finite, lens)):
        model = str(tree.get("distortion_model", tree.get("model", "")))
        if any(lens) and (any(lens[5:]) or model.lower() in OTHER_LENSES):
            raise DatasetError(
                f"the lens {lens} of the model {model or 'that is not named'} is not read; expected k1 k2 p1 p2 [k3]: "
                "rectify the images, or give --camera fx,fy,cx,cy[,w,h[,depth_scale]]"
            )
        if model.rpartition(".")[2].lower() == INVERSE and any(lens) and {*KEYS[:6]} <= values.keys():
            fx, fy, cx, cy, width, height = (values[key] for key in KEYS[:6])
            lens = brown_of_inverse(Camera(fx, fy, cx, cy, int(width), int(height)), tuple(lens[:5]))
        values |= dict(zip(DISTORTION_KEYS, map(float, lens[:5]), strict=False))
    return values if all(key in values for key in KEYS[:4]) else None


def read_yaml(path: Path) -> dict[str, Any]:
    """Tree of a YAML file, without OpenCV's header and type names."""
    try:
        text = re.sub(r"^%YAML.*\n|!!opencv-\w+", "", read_text(path, LARGEST_TREE))
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, yaml.SafeLoader)):
            raise DatasetError(f"{path} uses aliases (*name); expected YAML of plain keys and values")
        content = yaml.safe_load(text)
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot read {path}: {error}") from error
    except (yaml.YAMLError, RecursionError, ValueError):
        raise DatasetError(f"cannot read {path}; expected YAML of keys, numbers, texts and lists") from None
    if not isinstance(content, dict):
        raise DatasetError(f"{path} holds no keys; expected YAML of keys and values")
    return content


def depth_scale(tree: Any) -> float | None:  # noqa: ANN401
    """Depth units per metre anywhere in a tree."""
    if not isinstance(tree, dict | list):
        return None
    for value in (tree.get(name) for name in SCALES) if isinstance(tree, dict) else ():
        if _is_finite(value) and value > 0:
            return float(value) if value >= 1 else 1.0 / value
    parts = tree.values() if isinstance(tree, dict) else tree
    return next((scale for below in parts if (scale := depth_scale(below))), None)


def _first(tree: dict[str, Any], names: tuple[str, ...]) -> Any:  # noqa: ANN401
    value = next((tree[name] for name in names if name in tree), None)
    return value.get("data") if isinstance(value, dict) else value


def _is_finite(value: Any) -> TypeGuard[int | float]:  # noqa: ANN401 - any JSON value
    return isinstance(value, int | float) and math.isfinite(value)


def numbers_of(value: Any, count: int) -> NDArray[np.float64] | None:  # noqa: ANN401
    """Numbers (count,) of a list, or of rows; None for other values."""
    if not isinstance(value, list):
        return None
    flat = [number for row in value for number in (row if isinstance(row, list) else [row])]
    return np.array(flat, dtype=np.float64) if len(flat) == count and all(map(_is_finite, flat)) else None
