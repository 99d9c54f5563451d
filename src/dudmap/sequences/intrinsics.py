"""Where a recording's intrinsics come from: text, its own file, or the benchmarks' published cameras."""

import re
from dataclasses import dataclass
from pathlib import Path

from dudmap.errors import DatasetError
from dudmap.geometry.camera import Camera

DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3")
TUM_DEPTH_SCALE = 5000.0
"""Units of the TUM RGB-D benchmark's depth images per metre: the default of a recording in its format."""
KEYS = ("fx", "fy", "cx", "cy", "width", "height", "depth_scale", *DISTORTION_KEYS)


@dataclass(frozen=True)
class Intrinsics:
    """What is known of a camera before its images are seen.

    Attributes:
        values: Numbers by key (``KEYS``); fx, fy, cx, cy always there.
        source: Where they come from, for messages.
    """

    values: dict[str, float]
    source: str

    def camera(self, width: int, height: int) -> Camera:
        """Camera of images of this size.

        Raises:
            DatasetError: The intrinsics are for images of another size, or not acceptable.
        """
        expected = (int(self.values.get("width", width)), int(self.values.get("height", height)))
        if expected != (width, height):
            raise DatasetError(
                f"{self.source} is for images of {expected[0]}x{expected[1]} pixels, but the recording's are "
                f"{width}x{height}; give the right intrinsics with --camera fx,fy,cx,cy,w,h,depth_scale"
            )
        distortion = tuple(self.values.get(key, 0.0) for key in DISTORTION_KEYS)
        return Camera(
            fx=self.values["fx"],
            fy=self.values["fy"],
            cx=self.values["cx"],
            cy=self.values["cy"],
            width=width,
            height=height,
            depth_scale=self.values.get("depth_scale", TUM_DEPTH_SCALE),
            distortion=distortion if any(distortion) else (),
        )


def _numbers(*numbers: float) -> dict[str, float]:
    return dict(zip(KEYS, numbers, strict=False))


KNOWN = (
    (r"(freiburg|fr)1(?!\d)", "TUM freiburg1", _numbers(517.3, 516.5, 318.6, 255.3, 640, 480, 5000)),
    (r"(freiburg|fr)2(?!\d)", "TUM freiburg2", _numbers(520.9, 521.0, 325.1, 249.7, 640, 480, 5000)),
    (r"(freiburg|fr)3(?!\d)", "TUM freiburg3", _numbers(535.4, 539.2, 320.1, 247.6, 640, 480, 5000)),
    (r"rgbd_bonn", "Bonn", _numbers(542.822841, 542.576870, 315.593520, 237.756098, 640, 480, 5000)),
)
"""Folder-name pattern, name and intrinsics of the benchmarks' cameras."""


def of_folder(path: Path) -> Intrinsics:
    """Intrinsics of a recording: its ``intrinsics.txt``, else those of a benchmark that its folder's name tells.

    Raises:
        DatasetError: Neither is there, or the file cannot be understood.
    """
    file = path / "intrinsics.txt"
    if file.is_file():
        return from_file(file)
    for pattern, name, values in KNOWN:
        if re.search(pattern, path.resolve().name, flags=re.IGNORECASE):
            return Intrinsics(values, f"the {name} camera")
    raise DatasetError(
        f"the camera of {path} is not known: there is no intrinsics.txt and the folder is not named like a TUM or Bonn "
        "recording; give --camera fx,fy,cx,cy[,w,h[,depth_scale]]"
    )


def from_text(text: str) -> Intrinsics:
    """Intrinsics of ``fx,fy,cx,cy[,w,h[,depth_scale]]``.

    Raises:
        DatasetError: These are not 4, 6 or 7 numbers.
    """
    try:
        numbers = [float(field) for field in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (4, 6, 7):
        raise DatasetError(f"cannot understand the camera {text!r}; expected fx,fy,cx,cy[,w,h[,depth_scale]]")
    return Intrinsics(_numbers(*numbers), f"the camera {text!r}")


def from_camera(camera: Camera) -> Intrinsics:
    """Intrinsics of a camera."""
    values = {key: getattr(camera, key) for key in KEYS[:7]}
    return Intrinsics(values | dict(zip(DISTORTION_KEYS, camera.distortion, strict=False)), "the given camera")


def from_file(path: Path) -> Intrinsics:
    """Intrinsics of a text file: ``key value`` lines, a 3x3 matrix, or one line ``fx fy cx cy [w h [depth_scale]]``.

    Raises:
        DatasetError: It is none of these, or a key is unknown or missing.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot read {path}: {error}") from error
    rows = [row for line in lines if (row := re.sub(r"[,:=\[\];]", " ", line.partition("#")[0]).split())]
    if rows and not _is_number(rows[0][0]):
        return Intrinsics(_keyed(path, rows), str(path))
    if rows and all(_is_number(field) for row in rows for field in row):
        table = [[float(field) for field in row] for row in rows]
        if [len(row) for row in table] == [3, 3, 3] and table[2] == [0, 0, 1]:
            return Intrinsics(_numbers(table[0][0], table[1][1], table[0][2], table[1][2]), str(path))
        if len(table) == 1 and len(table[0]) in (4, 6, 7):
            return Intrinsics(_numbers(*table[0]), str(path))
    raise DatasetError(
        f"cannot understand {path}; expected lines such as 'fx 517.3' with fx, fy, cx, cy, width, height and "
        "depth_scale, or a 3x3 matrix, or one line 'fx fy cx cy'"
    )


def _keyed(path: Path, rows: list[list[str]]) -> dict[str, float]:
    values = {}
    for row in rows:
        if row[0] not in KEYS or len(row) != 2 or not _is_number(row[1]):
            raise DatasetError(
                f"{path}: cannot understand the line {' '.join(row)!r}; expected one of {', '.join(KEYS)} and a number"
            )
        values[row[0]] = float(row[1])
    missing = [key for key in KEYS[:4] if key not in values]
    if missing:
        raise DatasetError(f"{path} lacks {', '.join(missing)}")
    return values


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
