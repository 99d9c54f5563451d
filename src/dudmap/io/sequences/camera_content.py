"""Cameras in the content of any file: text, JSON, YAML, NumPy arrays.

A camera is a matrix with rows fx 0 cx, 0 fy cy, 0 0 1, or focal lengths and principal point under usual names; the
caller tests whether it fits the images.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import DatasetError
from dudmap.input_files import LARGEST_TOML, load_array, open_arrays, parse_json, read_text
from dudmap.io.sequences.camera_values import depth_scale, read_yaml, values_of

Values = dict[str, float]

ALIASES = {
    "fx": ("fx", "fl_x", "f_x", "focal_x", "focal_length_x"),
    "fy": ("fy", "fl_y", "f_y", "focal_y", "focal_length_y"),
    "cx": ("cx", "c_x", "ppx", "principal_x", "principal_point_x", "x_offset", "u0"),
    "cy": ("cy", "c_y", "ppy", "principal_y", "principal_point_y", "y_offset", "v0"),
    "width": ("width", "image_width", "img_width", "w"), "height": ("height", "image_height", "img_height", "h"),
    "k1": ("k1",), "k2": ("k2",), "p1": ("p1",), "p2": ("p2",), "k3": ("k3",),
}  # fmt: skip
PAIRS = {
    ("fx", "fy"): ("focal_length", "focal"), ("cx", "cy"): ("principal_point", "optical_center"),
    ("width", "height"): ("resolution", "image_size", "img_size", "size"),
}  # fmt: skip
LENSES = (
    "coeffs", "disto", "distortion", "distortion_coefficients", "distortion_coeffs", "dist_coeffs", "dist_coeff",
    "dist", "d",
)  # fmt: skip
ROWS = re.compile(r"intrin|calib|cam|param|^k$|^data$|^$")
"""Names of a list ``fx fy cx cy`` with size or lens."""
KNOWN = sorted((name for names in ALIASES.values() for name in names), key=len, reverse=True)
KEYED = re.compile(rf"(?:(.+)_)?({'|'.join(KNOWN)})(?:_(.+))?")
"""Name of one number with words for its camera: ``fx_depth``, ``Camera.fx``."""
LENS = ("k1", "k2", "p1", "p2", "k3")
COLMAP = {"pinhole": 6, "opencv": 10}
"""COLMAP's models and their number counts: width height fx fy cx cy [k1 k2 p1 p2]."""
SKEW = 0.01
"""Largest ignored skew, share of fx: 1 % of the height."""
LEAST = 8.0
"""Smallest focal length and principal point, pixels; quaternions are smaller."""
LEAST_SCALE = 100.0
"""Smallest scale of depth, units per metre (a centimetre)."""
LARGEST_CONTENT = LARGEST_TOML
NO_NAMES = ("px", "pixel", "pixels")


def cameras_in(file: Path) -> list[tuple[str, Values]]:
    """Names (lower case) and values by dudmap's keys of all cameras in a file; empty for other files.

    Raises:
        DatasetError: Unsupported lens model.
    """
    tree = _tree(file)
    unit = depth_scale(tree) or 0
    scale = {"depth_scale": unit} if unit >= LEAST_SCALE else {}
    return [
        (name, values | scale)
        for name, values in _cameras(tree, _name(file.stem))
        if min((values.get(key, 0) for key in ("fx", "fy", "cx", "cy")), default=0) >= LEAST
    ]


def _tree(file: Path) -> Any:  # noqa: ANN401 - dictionaries and lists
    suffix = file.suffix.lower()
    try:
        if suffix == ".npy":
            return np.asarray(load_array(file), dtype=np.float64).tolist()
        if suffix == ".npz":
            with open_arrays(file) as arrays:
                return {name: arrays[name].tolist() for name in arrays}
        text = read_text(file, LARGEST_CONTENT)
    except (OSError, ValueError, KeyError, EOFError):
        return None
    try:
        if text.lstrip()[:1] in ("{", "["):
            return parse_json(text)
        return read_yaml(file) if suffix in (".yaml", ".yml") else _tokens(text)
    except (ValueError, DatasetError):
        return _tokens(text)  # numbers in brackets, or names and numbers


def _tokens(text: str) -> Any:  # noqa: ANN401
    """Names in a text and their numbers; a repeated name begins another camera."""
    numbers: list[float] = []
    parts: list[dict[str, Any]] = [{}]
    words: list[str] = []
    taken = numbers
    text = re.sub(r"(?m)(#|//|%).*$", " ", text)
    for token in re.sub(r"(?<=\d)[x×](?=\d)|[\[\](){},;:=\"']", " ", text).split():
        try:
            number = float(token)
        except ValueError:
            words += [name for name in [_name(token)] if name and name not in NO_NAMES]
            continue
        if words:
            known = [word for word in words if word in KNOWN]
            if len(known) == len(words) > 1:  # a table: a line of names, then lines of numbers
                parts.append({"table": words, "rows": (taken := [])})
            else:
                name = words[-1] if known and len(words) == 1 else "_".join(words)
                if name in parts[-1]:
                    parts.append({})
                parts[-1][name] = taken = []
            words = []
        taken.append(number)
    trees: list[Any] = [numbers] if numbers else []
    for part in parts:
        if "table" in part:
            count = len(part["table"])
            rows = [part["rows"][at : at + count] for at in range(0, len(part["rows"]) - count + 1, count)]
            trees += [dict(zip(part["table"], row, strict=True)) for row in rows]
        elif part:
            trees.append({name: found[0] if len(found) == 1 else found for name, found in part.items()})
    return trees[0] if len(trees) == 1 else trees


def _name(text: str) -> str:
    return re.sub(r"[\W_]+", "_", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", text)).strip("_").lower()


def _cameras(tree: Any, name: str) -> Iterator[tuple[str, Values]]:  # noqa: ANN401
    if isinstance(tree, dict):
        yield from _of_dictionary({_name(str(key)): value for key, value in tree.items()}, name)
    elif isinstance(tree, list) and (values := _row(tree, name)) is not None:
        yield name, values
    elif isinstance(tree, list):
        for below in tree:
            if isinstance(below, dict) or (isinstance(below, list) and not all(map(_is_number, below))):
                yield from _cameras(below, name)


def _of_dictionary(tree: dict[str, Any], name: str) -> Iterator[tuple[str, Values]]:
    groups: dict[str, dict[str, Any]] = {"": {}}
    lists: dict[str, Any] = {}
    for key, value in tree.items():
        keyed, pair = KEYED.fullmatch(key), next((keys for keys, names in PAIRS.items() if key in names), None)
        if keyed and _is_number(value):
            group = "_".join(part for part in (keyed[1], keyed[3]) if part)
            groups.setdefault(group, {})[next(ours for ours, names in ALIASES.items() if keyed[2] in names)] = value
        elif pair and isinstance(value, list) and len(value) == 2 and all(map(_is_number, value)):
            groups[""] |= dict(zip(pair, value, strict=True))
        elif key in LENSES:
            groups[""]["coeffs"] = _flat(value)
        elif key in ("model", "distortion_model"):
            groups[""]["model"] = str(value).rpartition(".")[2]
        else:
            lists[key] = value
    shared = groups.pop("")
    matrices = {key: K for key, value in lists.items() if (K := _matrix(value)) is not None}
    square = {key: K for key, K in matrices.items() if len(_flat(lists[key]) or []) == 9}
    matrices = square or matrices  # the projection of rectified images is another matrix than K
    for key, K in matrices.items():
        sizes = {ours: shared[ours] for ours in ("width", "height", "coeffs", "model") if ours in shared}
        yield f"{name}/{key}", values_of(sizes | {"K": K.ravel().tolist()}) or {}
    for group, numbers in groups.items() or ():
        if (values := values_of(shared | numbers)) is not None:
            yield f"{name}/{group}", values
    if (
        not any(values_of(shared | numbers) for numbers in groups.values())
        and (values := values_of(shared)) is not None
    ):
        yield name, values
    for key, below in lists.items():
        if key in COLMAP and isinstance(below, list) and len(below) == COLMAP[key]:
            yield (
                name,
                _by_place([*below[2:6], *below[:2]]) | dict(zip(("k1", "k2", "p1", "p2"), below[6:], strict=False)),
            )
        elif (
            key not in matrices and isinstance(below, dict | list) and (isinstance(below, dict) or _may_be(key, below))
        ):
            for found, values in _cameras(below, f"{name}/{key}"):
                sizes = {ours: shared[ours] for ours in ("width", "height") if ours in shared and ours not in values}
                yield found, values | sizes


def _may_be(key: str, below: Any) -> bool:  # noqa: ANN401
    if isinstance(below, list):
        return ROWS.search(key) is not None or not all(map(_is_number, below))
    return isinstance(below, dict)


def _row(value: list[Any], name: str) -> Values | None:
    if (K := _matrix(value)) is not None:
        return values_of({"K": K.ravel().tolist()})
    if not all(map(_is_number, value)) or len(value) not in (4, 6, 7, 8, 9):
        return None
    if len(value) in (4, 6):
        return _by_place(value)
    if len(value) == 7:
        return _by_place(value[:6]) | {"depth_scale": float(value[6])}
    return _by_place(value[:4]) | dict(zip(LENS, map(float, value[4:]), strict=False))


def _by_place(numbers: list[Any]) -> Values:
    return dict(zip(("fx", "fy", "cx", "cy", "width", "height"), map(float, numbers), strict=False))


def _matrix(value: Any) -> NDArray[np.float64] | None:  # noqa: ANN401
    flat = _flat(value)
    if flat is None or len(flat) not in (9, 12, 16):
        return None
    matrix = np.array(flat, dtype=np.float64).reshape(4 if len(flat) == 16 else 3, -1)
    for M in (matrix, matrix.T) if len(flat) != 12 else (matrix,):
        K = M[:3, :3]
        zeros = K[1, 0], *K[2, :2], *M[:3, 3:].ravel(), *M[3:, :3].ravel()
        if (
            not any(zeros)
            and K[2, 2] == 1
            and (K[[0, 1, 0, 1], [0, 1, 2, 2]] > 0).all()
            and abs(K[0, 1]) <= SKEW * K[0, 0]
        ):
            return K
    return None


def _flat(value: Any) -> list[float] | None:  # noqa: ANN401
    if isinstance(value, dict):
        value = value.get("data")
    if not isinstance(value, list):
        return None
    flat = [number for row in value for number in (row if isinstance(row, list) else [row])]
    return [float(number) for number in flat] if all(map(_is_number, flat)) else None


def _is_number(value: Any) -> bool:  # noqa: ANN401
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))
