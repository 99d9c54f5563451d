"""Intrinsics of a recording: text, its file, or published; lenses. Bad numbers raise a ``DatasetError``."""

import math
import re
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.errors import DatasetError
from dudmap.input_files import read_text

DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3")
DEPTH_SCALE = 5000.0
"""Default depth units per metre in the TUM layout."""
KEYS = ("fx", "fy", "cx", "cy", "width", "height", "depth_scale", *DISTORTION_KEYS)
COLOR_PREFIX = "color_"
"""Prefix of keys of a separate colour camera."""
COLOR_REQUIRED = ("fx", "fy", "cx", "cy", "width", "height")
SAME_SHAPE = 0.01
"""Largest difference of aspect ratios of one view."""
MOTION_KEY = "T_depth_color"
"""Key of the motion colour to depth camera: 12 or 16 numbers, by rows."""


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics before the image size is known.

    Attributes:
        values: Numbers by key (``KEYS``); fx, fy, cx and cy always.
        source: Origin, for messages.
        color: Numbers of the colour camera, empty if the same.
        T_depth_color: (4, 4).
    """

    values: dict[str, float]
    source: str
    color: dict[str, float] = field(default_factory=dict)
    T_depth_color: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))

    def calibration(self) -> Calibration | None:
        """Calibration of the colour camera; None if it is the same as the depth camera."""
        if not self.color:
            return None
        return Calibration(_camera(self.color, 1000.0), se3.inverse(self.T_depth_color))

    def camera(self, width: int, height: int, depth_scale: float = DEPTH_SCALE) -> Camera:
        """Camera for images of the given size.

        Args:
            width, height: Size of the depth images.
            depth_scale: Default units per metre.
        """
        values = {"depth_scale": depth_scale, "width": width, "height": height} | self.values
        camera = _camera(values, values["depth_scale"])
        if camera.shape != (height, width):
            view = "fx,fy,cx,cy,w,h,depth_scale"
            if not camera.distortion and abs(width * camera.height / (height * camera.width) - 1) < SAME_SHAPE:
                other = from_camera(camera.resized(width, height)).values
                view = ",".join(f"{other[key]:.6g}" for key in KEYS[:7]) + " if they show the same view"
            raise DatasetError(
                f"{self.source} is for images of {camera.width}x{camera.height} pixels, but the recording's depth "
                f"images are {width}x{height}; give their intrinsics with --camera {view}"
            )
        return camera


def _camera(values: dict[str, float], depth_scale: float) -> Camera:
    distortion = tuple(values.get(key, 0.0) for key in DISTORTION_KEYS)
    size = int(values["width"]), int(values["height"])
    fx, fy, cx, cy = (values[key] for key in KEYS[:4])
    return Camera(fx, fy, cx, cy, *size, depth_scale, distortion if any(distortion) else ())


def camera_values(*numbers: float) -> dict[str, float]:
    """Numbers of a camera in the order of ``KEYS``."""
    return dict(zip(KEYS, map(float, numbers), strict=False))


BY_NAME = ", by name"
"""End of the source of intrinsics known by name or layout."""


def by_name(name: str, values: dict[str, float]) -> Intrinsics:
    """Published intrinsics of a data set."""
    return Intrinsics(dict(values), f"the {name} camera{BY_NAME}")


def given(camera: Camera | str) -> Intrinsics:
    """The user's intrinsics: a Camera, or ``fx,fy,cx,cy[,w,h[,depth_scale]]``."""
    if isinstance(camera, Camera):
        return from_camera(camera)
    try:
        numbers = [float(field) for field in camera.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (4, 6, 7) or not all(map(math.isfinite, numbers)):
        raise DatasetError(f"cannot understand the camera {camera!r}; expected fx,fy,cx,cy[,w,h[,depth_scale]]")
    return Intrinsics(camera_values(*numbers), f"--camera {camera}")


def from_camera(camera: Camera) -> Intrinsics:
    """Intrinsics of a camera."""
    values = {key: getattr(camera, key) for key in KEYS[:7]}
    return Intrinsics(values | dict(zip(DISTORTION_KEYS, camera.distortion, strict=False)), "the given camera")


def from_file(path: Path) -> Intrinsics:
    """Parse a text file: ``key value`` lines, a matrix of 9 or 16 numbers, or ``fx fy cx cy [w h [depth_scale]]``."""
    try:
        lines = read_text(path).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot read {path}: {error}") from error
    split = (re.sub(r"[,:=\[\];]", " ", line.partition("#")[0]).split() for line in lines)
    numbered = [(number, row) for number, row in enumerate(split, start=1) if row]
    rows = [row for _, row in numbered]
    if rows and not _is_number(rows[0][0]):
        return _keyed(path, rows)
    if any(not _is_number(field) for row in rows for field in row):
        raise DatasetError(
            f"cannot understand {path}; expected lines such as 'fx 517.3' with fx, fy, cx, cy, width, height and "
            "depth_scale, or a 3x3 matrix, or one line 'fx fy cx cy'"
        )
    numbers = np.array([float(field) for row in rows for field in row])
    if numbers.size in (4, 6, 7, 9, 16):
        return from_matrix(numbers, path)
    line, row = next(((line, row) for line, row in numbered if len(row) != 3), (len(lines), rows[-1] if rows else []))
    raise DatasetError(
        f"{path}, line {line}: {len(row)} numbers, of {numbers.size} in the file; expected the 9 of a 3x3 matrix K"
    )


def from_matrix(numbers: NDArray[np.float64], path: Path) -> Intrinsics:
    """Intrinsics of a 3x3 or 4x4 matrix by rows, or ``fx fy cx cy [w h [depth_scale]]``."""
    source = str(path)
    if numbers.size in (4, 6, 7):
        return Intrinsics(camera_values(*numbers.tolist()), source)
    if numbers.size not in (9, 16):
        raise DatasetError(f"{path} holds {numbers.size} numbers; expected the 9 of a 3x3 matrix K, row by row")
    K = numbers.reshape(math.isqrt(numbers.size), -1)
    if np.any(K[[1, 2, 2], [0, 0, 1]]) or K[2, 2] != 1:
        raise DatasetError(f"{path} holds {K[:3, :3].tolist()}; expected the rows fx 0 cx, 0 fy cy, 0 0 1")
    return Intrinsics(camera_values(*(float(K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))), source)


def _keyed(path: Path, rows: list[list[str]]) -> Intrinsics:
    values, color, T_depth_color = {}, {}, np.eye(4)
    color_keys = [COLOR_PREFIX + key for key in (*COLOR_REQUIRED, *DISTORTION_KEYS)]
    for key, *fields in rows:
        if key == MOTION_KEY:
            T_depth_color = _motion(path, fields)
        elif key not in (*KEYS, *color_keys) or len(fields) != 1 or not _is_number(fields[0]):
            raise DatasetError(
                f"{path}: cannot understand the line {' '.join((key, *fields))!r}; expected one of {', '.join(KEYS)} "
                "and a number"
            )
        elif key in KEYS:
            values[key] = float(fields[0])
        else:
            color[key.removeprefix(COLOR_PREFIX)] = float(fields[0])
    if missing := [key for key in KEYS[:4] if key not in values]:
        raise DatasetError(f"{path} lacks {', '.join(missing)}")
    missing = [COLOR_PREFIX + key for key in COLOR_REQUIRED if key not in color]
    if missing and (color or any(row[0] == MOTION_KEY for row in rows)):
        raise DatasetError(f"{path} lacks {', '.join(missing)}, which the second camera of the colour images needs")
    return Intrinsics(values, str(path), color, T_depth_color)


def _motion(path: Path, fields: list[str]) -> NDArray[np.float64]:
    T = np.eye(4)
    if len(fields) in (12, 16) and all(map(_is_number, fields)):
        T[:3] = np.array(fields[:12], dtype=np.float64).reshape(3, 4)
        if np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-3) and np.linalg.det(T[:3, :3]) > 0:
            T[:3, :3] = se3.nearest_rotation(T[:3, :3])
            return T
    raise DatasetError(f"{path}: {MOTION_KEY} is not a rigid motion of 12 or 16 numbers, row by row")


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


BROWN, RATIONAL, FISHEYE = "plumb_bob", "rational_polynomial", "equidistant"
"""Distortion models in ROS: Brown-Conrady, its rational extension (Brown 1971; OpenCV), angle polynomial (Kannala and
Brandt 2006)."""
INVERSE = "inverse_brown_conrady"
"""Brown's polynomial from distorted to undistorted, for RealSense colour."""
OTHER_NAMES = {"brown_conrady": BROWN, "modified_brown_conrady": BROWN, "kannala_brandt4": FISHEYE, "": BROWN}
GRID = 24
"""Points across and down for fitting an inverse model."""


@dataclass(frozen=True)
class Lens:
    """Camera of recorded images.

    Attributes:
        camera: After ``rectify``.
        model: Removed by ``rectify``, empty for none.
        coefficients: In OpenCV's order.
    """

    camera: Camera
    model: str = ""
    coefficients: tuple[float, ...] = ()

    @classmethod
    def of(cls, camera: Camera, model: str, coefficients: "tuple[float, ...]") -> "Lens":
        """Lens with up to five Brown coefficients in the camera; others are removed on reading.

        Raises:
            DatasetError: The model is not known.
        """
        model = model.strip().lower().replace(" ", "_")
        model = OTHER_NAMES.get(model, model)
        if not any(coefficients) or model == "none":
            return cls(camera)
        if model == INVERSE:
            return cls(replace(camera, distortion=brown_of_inverse(camera, coefficients)))
        if model in (BROWN, RATIONAL) and not any(coefficients[5:]):
            return cls(replace(camera, distortion=tuple(coefficients[:5])))
        if model in (BROWN, RATIONAL, FISHEYE):
            return cls(camera, model, coefficients)
        raise DatasetError(
            f"the distortion model {model!r} is not known; expected {BROWN}, {RATIONAL} or {FISHEYE}, or "
            "rectified images"
        )

    def rectify(self, image: NDArray[Any], *, depth: bool) -> NDArray[Any]:
        """Undistorted image (H, W[, C]); depth is not interpolated."""
        import cv2

        if not self.model:
            return image
        kind = cv2.INTER_NEAREST if depth else cv2.INTER_LINEAR
        us, vs = self._pixels
        return np.asarray(cv2.remap(image, us, vs, kind, borderMode=cv2.BORDER_CONSTANT), image.dtype)

    @cached_property
    def _pixels(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        import cv2

        size, D = (self.camera.width, self.camera.height), np.array(self.coefficients)
        K = self.camera.K
        if self.model == FISHEYE:
            maps = cv2.fisheye.initUndistortRectifyMap(K, D[:4], np.eye(3), K, size, cv2.CV_32FC1)
        else:
            maps = cv2.initUndistortRectifyMap(K, D, np.eye(3), K, size, cv2.CV_32FC1)
        return np.asarray(maps[0], np.float32), np.asarray(maps[1], np.float32)


def brown_of_inverse(camera: Camera, inverse: "tuple[float, ...]") -> tuple[float, ...]:
    """Coefficients k1 k2 p1 p2 k3 of a lens whose inverse is Brown's polynomial: u + B(u; c) = d by least squares over
    the image, with u = d + B(d; inverse)."""
    us, vs = np.meshgrid(np.linspace(0, camera.width - 1, GRID), np.linspace(0, camera.height - 1, GRID))
    d = np.stack([(us.ravel() - camera.cx) / camera.fx, (vs.ravel() - camera.cy) / camera.fy])
    u = d + (_brown_terms(d) @ np.array(inverse[:5])).reshape(2, -1)
    return tuple(np.linalg.lstsq(_brown_terms(u), (d - u).ravel(), rcond=None)[0].tolist())


def _brown_terms(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivatives (2 n, 5) of displacements, x then y, of points (2, n) by k1 k2 p1 p2 k3."""
    x, y = points
    r2 = x * x + y * y
    return np.concatenate(
        [
            np.stack([x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3], axis=1),
            np.stack([y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3], axis=1),
        ]
    )
