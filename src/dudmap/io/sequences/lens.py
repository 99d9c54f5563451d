"""Lenses whose distortion has more coefficients than ``Camera`` holds: images are rectified when they are read."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.camera import Camera
from dudmap.errors import DatasetError

BROWN, RATIONAL, FISHEYE = "plumb_bob", "rational_polynomial", "equidistant"
"""Models of distortion by their names in ROS: Brown-Conrady, its rational extension (both Brown 1971, as OpenCV
implements them), and the angle polynomial of Kannala and Brandt (2006)."""
INVERSE = "inverse_brown_conrady"
"""Brown's polynomial from distorted to undistorted coordinates, which RealSense uses for colour."""
OTHER_NAMES = {"brown_conrady": BROWN, "modified_brown_conrady": BROWN, "kannala_brandt4": FISHEYE, "": BROWN}
"""Names that librealsense gives to the same models."""
GRID = 24
"""Points across and down the image to which an inverse model is fitted."""


@dataclass(frozen=True)
class Lens:
    """Camera of recorded images.

    Attributes:
        camera: Camera of the images after ``rectify``.
        model: Model of the distortion that ``rectify`` removes, empty if it does nothing.
        coefficients: Of this model, in the order of OpenCV.
    """

    camera: Camera
    model: str = ""
    coefficients: tuple[float, ...] = ()

    @classmethod
    def of(cls, camera: Camera, model: str, coefficients: "tuple[float, ...]") -> "Lens":
        """Lens with up to five Brown coefficients in the camera itself, or others that are removed at reading.

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
        """Image (H, W[, C]) without distortion, with the same intrinsics; depth is not interpolated."""
        import cv2

        if not self.model:
            return image
        kind = cv2.INTER_NEAREST if depth else cv2.INTER_LINEAR
        us, vs = self._pixels
        return np.asarray(cv2.remap(image, us, vs, kind, borderMode=cv2.BORDER_CONSTANT), image.dtype)

    @cached_property
    def _pixels(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Recorded pixel coordinates (H, W) of every pixel without distortion."""
        import cv2

        size, D = (self.camera.width, self.camera.height), np.array(self.coefficients)
        K = self.camera.K
        if self.model == FISHEYE:
            maps = cv2.fisheye.initUndistortRectifyMap(K, D[:4], np.eye(3), K, size, cv2.CV_32FC1)
        else:
            maps = cv2.initUndistortRectifyMap(K, D, np.eye(3), K, size, cv2.CV_32FC1)
        return np.asarray(maps[0], np.float32), np.asarray(maps[1], np.float32)


def brown_of_inverse(camera: Camera, inverse: "tuple[float, ...]") -> tuple[float, ...]:
    """Coefficients k1 k2 p1 p2 k3 of the lens whose inverse is Brown's polynomial with the given coefficients.

    With distorted coordinates d and undistorted ones u = d + B(d; inverse), they solve u + B(u; c) = d in the least
    squares over the image; B is linear in its coefficients.
    """
    us, vs = np.meshgrid(np.linspace(0, camera.width - 1, GRID), np.linspace(0, camera.height - 1, GRID))
    d = np.stack([(us.ravel() - camera.cx) / camera.fx, (vs.ravel() - camera.cy) / camera.fy])
    u = d + (_brown_terms(d) @ np.array(inverse[:5])).reshape(2, -1)
    return tuple(np.linalg.lstsq(_brown_terms(u), (d - u).ravel(), rcond=None)[0].tolist())


def _brown_terms(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivatives (2 n, 5) of the displacements, first x then y, of points (2, n) by k1 k2 p1 p2 k3."""
    x, y = points
    r2 = x * x + y * y
    return np.concatenate(
        [
            np.stack([x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3], axis=1),
            np.stack([y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3], axis=1),
        ]
    )
