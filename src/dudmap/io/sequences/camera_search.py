"""Intrinsics in files of any name: the only camera that fits the images' size."""

import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dudmap.core.geometry.camera import Camera
from dudmap.errors import DatasetError
from dudmap.io.sequences import camera_files
from dudmap.io.sequences.camera_content import LARGEST_CONTENT, Values, cameras_in
from dudmap.io.sequences.intrinsics import SAME_SHAPE, Intrinsics

NAMED = re.compile(r".*(cam|intrin|calib|param).*|k([._-].*)?", re.IGNORECASE)
SUFFIXES = (".txt", ".json", ".yaml", ".yml", ".csv", ".npy", ".npz", ".cfg", ".ini", ".conf", ".toml", "")
FOLDERS = re.compile(r"config|.*(intrin|calib).*", re.IGNORECASE)
MOST_NAMES = 5
SAME = 0.5
"""Largest difference of one camera in two files, pixels."""
FIELD_OF_VIEW = (20.0, 130.0)
"""Plausible fields of view, degrees."""
OFF_CENTER = 0.25
"""Largest distance of the principal point from the centre, share of the size."""
UNEQUAL_FOCAL = 0.1
"""Largest difference of fx and fy, share."""
SCALED = ", scaled from "
COLOR_WORDS, OTHER_WORDS = r"colou?r|rgb(?!_?d)|left", r"right|infra"

Size = tuple[int, int]


class Found(NamedTuple):
    """Camera of a file for one kind of images."""

    file: Path
    kind: str
    values: Values
    scaled: Size | None = None


def known(
    folder: Path, published: Intrinsics | None, sizes: Callable[[], tuple[Size, Size] | None], why: str = ""
) -> Intrinsics:
    """Intrinsics of a recording: a file of usual name, the published ones, or any file that fits.

    Args:
        sizes: Width and height of depth and colour images, None if unreadable.

    Raises:
        DatasetError: No file gives one camera.
    """
    problem = None
    try:
        found = camera_files.find(folder) or published
    except camera_files.UnclearFilesError as error:
        found, problem = None, error
    given = found and tuple(int(found.values.get(key, 0)) for key in ("width", "height"))
    if found is not None and (found is published or given == (0, 0)):
        return found
    both = sizes()
    if both is not None and given != both[0]:
        try:
            found = search(folder, *both) or found
        except DatasetError:
            if found is None:
                raise
    if found is None:
        raise problem or camera_files.unknown(folder, why)
    return found


def search(folder: Path, depth: Size, color: Size) -> Intrinsics | None:
    """Intrinsics in a folder, its parent, or their configuration folders; None without any.

    Args:
        depth, color: Image width and height.

    Raises:
        DatasetError: Files contradict each other, or none fits the images.
    """
    misfits: list[str] = []
    for place in (folder, folder.resolve().parent):
        found: list[Found] = []
        for file in _candidates(place):
            for name, values in cameras_in(file):
                fitting = _fitting(file, name, values, depth, color)
                if fitting is not None:
                    found.append(fitting)
                elif not re.search(OTHER_WORDS, name):
                    misfits.append(f"{_shown(file, folder)} ({_numbers(values)})")
        if found:
            return _decided(found, folder, depth, color)
    if misfits:
        images = f"{depth[0]}x{depth[1]}" + (f" (depth) and {color[0]}x{color[1]} (colour)" if color != depth else "")
        raise DatasetError(
            f"no camera that lies at {folder} fits its images of {images} pixels: {_listed(misfits)}; give --camera "
            "fx,fy,cx,cy[,w,h[,depth_scale]]"
        )
    return None


def _candidates(place: Path) -> Iterator[Path]:
    for path in sorted(place.iterdir()):
        if FOLDERS.fullmatch(path.name) and path.is_dir():
            yield from (file for file in sorted(path.iterdir()) if _is_small(file))
        elif NAMED.fullmatch(path.stem) and _is_small(path):
            yield path


def _is_small(file: Path) -> bool:
    return file.suffix.lower() in SUFFIXES and file.is_file() and file.stat().st_size <= LARGEST_CONTENT


def _fitting(file: Path, name: str, values: Values, depth: Size, color: Size) -> Found | None:
    if re.search(OTHER_WORDS, name):
        return None
    kinds = {"depth": depth, "color": color}
    if "depth" in name:
        kinds = {"depth": depth}
    elif re.search(COLOR_WORDS, name):
        kinds = {"color": color}
    elif depth == color:
        kinds = {"color": color}  # of both
    given = int(values.get("width", 0)), int(values.get("height", 0))
    for kind, size in kinds.items():
        if given in (size, size[::-1]) and _is_plausible(values, size):
            return Found(file, kind, values | {"width": size[0], "height": size[1]})
    scaled = [kind for kind, size in kinds.items() if _is_multiple(given, size) and _is_plausible(values, given)]
    if len(scaled) == 1:
        size = kinds[scaled[0]]
        camera = Camera(values["fx"], values["fy"], values["cx"], values["cy"], *given).resized(*size)
        numbers = {key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy", "width", "height")}
        return Found(file, scaled[0], values | numbers, given)
    if all(given):
        return None
    kind = next((kind for kind, size in kinds.items() if _is_plausible(values, size)), None)
    return None if kind is None else Found(file, kind, values)


def _is_multiple(given: Size, size: Size) -> bool:
    if not all(given) or abs(given[0] * size[1] / (given[1] * size[0]) - 1) > SAME_SHAPE:
        return False
    factor = max(given[0] / size[0], size[0] / given[0])
    return abs(2 * factor - round(2 * factor)) < SAME_SHAPE


def _is_plausible(values: Values, size: Size) -> bool:
    focal, center = np.array([values["fx"], values["fy"]]), np.array([values["cx"], values["cy"]])
    if not (focal > 0).all():
        return False
    angles = np.degrees(2 * np.arctan(np.array(size) / 2 / focal))
    centered = np.abs(center + 0.5 - np.array(size) / 2) <= OFF_CENTER * np.array(size)
    square = abs(focal[0] - focal[1]) <= UNEQUAL_FOCAL * focal.max()
    return bool(FIELD_OF_VIEW[0] <= angles.min() and angles.max() <= FIELD_OF_VIEW[1] and centered.all() and square)


def _decided(found: list[Found], folder: Path, depth: Size, color: Size) -> Intrinsics:
    cameras: dict[str, Values] = {}
    for kind in ("depth", "color"):
        known = [camera for camera in found if camera.kind == kind]
        distinct = _distinct(known)
        if len(distinct) > 1:
            named = [f"{_shown(camera.file, folder)} ({_numbers(camera.values)})" for camera in distinct]
            raise DatasetError(
                f"{len(named)} different cameras lie at {folder}: {_listed(named)}; give the right one with --camera "
                "fx,fy,cx,cy[,w,h[,depth_scale]]"
            )
        if distinct:
            cameras[kind] = distinct[0].values
    source = _source(found, folder)
    if "depth" not in cameras and depth != color:
        raise DatasetError(
            f"{source} gives the camera of the colour images of {color[0]}x{color[1]} pixels, but the depth images "
            f"are {depth[0]}x{depth[1]}; give their camera with --camera fx,fy,cx,cy"
        )
    scale = {key: values[key] for values in cameras.values() for key in ("depth_scale",) if key in values}
    own = cameras.get("depth") or cameras["color"]
    other = cameras.get("color", own)
    if _is_same(own, other):
        return Intrinsics(own | scale, source)
    if depth == color:
        raise DatasetError(
            f"{source} gives two cameras of images of one size, {_numbers(own)} for depth and {_numbers(other)} for "
            "colour, and depth may be registered to colour: give the camera of the depth images with --camera "
            "fx,fy,cx,cy, the colour camera if depth is registered to it"
        )
    return Intrinsics(own | scale, source, other | {"width": color[0], "height": color[1]})


def _distinct(cameras: list[Found]) -> list[Found]:
    kept: list[Found] = []
    for camera in sorted(cameras, key=lambda camera: -len(camera.values)):
        if not any(_is_same(camera.values, other.values) for other in kept):
            kept.append(camera)
    return kept


def _is_same(one: Values, other: Values) -> bool:
    near = all(abs(one[key] - other[key]) <= SAME for key in ("fx", "fy", "cx", "cy"))
    return near and all(one[key] == other[key] for key in one.keys() & other.keys() & {"k1", "k2", "p1", "p2", "k3"})


def _source(found: list[Found], folder: Path) -> str:
    names = list(dict.fromkeys(_shown(camera.file, folder) for camera in found))
    scaled = next((camera for camera in found if camera.scaled), None)
    text = _listed(names)
    if scaled is not None:
        to = f"{scaled.values['width']:g}x{scaled.values['height']:g}"
        text += f"{SCALED}{scaled.scaled[0]}x{scaled.scaled[1]} to {to} pixels" if scaled.scaled else ""
    return text


def _shown(file: Path, folder: Path) -> str:
    return os.path.relpath(file.resolve(), folder.resolve())


def _numbers(values: Values) -> str:
    size = f" for {values['width']:g}x{values['height']:g}" if {"width", "height"} <= values.keys() else ""
    return ",".join(f"{values[key]:.6g}" for key in ("fx", "fy", "cx", "cy")) + size


def _listed(names: list[str]) -> str:
    more = len(names) - MOST_NAMES
    return ", ".join(names[:MOST_NAMES]) + (f" and {more} more" if more > 0 else "")
