"""Pinhole camera with optional lens distortion."""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import DatasetError

Scalar = TypeVar("Scalar", bound=np.floating)
LARGEST_PIXELS = 2**26
"""Pixels of an image, 8192x8192."""
SMALLEST_FOCAL, LARGEST_COORDINATE = 1e-2, 1e6
"""Smallest focal length, and largest focal length and principal point, pixels."""
SMALLEST_SCALE, LARGEST_SCALE = 1e-3, 1e9
"""Units of depth per metre, from kilometres to nanometres."""


@dataclass(frozen=True)
class Camera:
    """Intrinsics of a pinhole camera; x right, y down, z forward; pixel centres at whole numbers (thesis eq. 4.1).

    Attributes:
        fx, fy: Focal lengths in pixels.
        cx, cy: Principal point in pixels.
        width, height: Image size in pixels.
        depth_scale: Units of 16-bit depth images per metre; 1000 = millimetres.
        distortion: k1, k2, p1, p2[, k3[, k4, k5, k6]] of the Brown-Conrady model (thesis eq. 3.87, 3.88); empty for
            none.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    depth_scale: float = 1000.0
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "distortion", tuple(map(float, self.distortion)))
        numbers = (self.fx, self.fy, self.cx, self.cy, self.depth_scale, *self.distortion)
        if not np.all(np.isfinite(numbers)) or min(self.fx, self.fy, self.depth_scale) <= 0:
            raise DatasetError(
                f"camera has fx={self.fx}, fy={self.fy}, cx={self.cx}, cy={self.cy}, depth_scale={self.depth_scale}; "
                "focal lengths and depth scale must be positive finite numbers"
            )
        if min(self.fx, self.fy) < SMALLEST_FOCAL or max(map(abs, numbers[:4])) > LARGEST_COORDINATE:
            raise DatasetError(
                f"camera has fx={self.fx}, fy={self.fy}, cx={self.cx}, cy={self.cy}; expected focal lengths of "
                f"{SMALLEST_FOCAL} pixels or more, and all of them up to {LARGEST_COORDINATE:.0e}"
            )
        if not SMALLEST_SCALE <= self.depth_scale <= LARGEST_SCALE:
            raise DatasetError(
                f"camera has depth_scale={self.depth_scale}; expected units per metre from {SMALLEST_SCALE} to "
                f"{LARGEST_SCALE:.0e}, such as 1000 for millimetres"
            )
        if self.width < 16 or self.height < 16:
            raise DatasetError(f"camera image is {self.width}x{self.height}; at least 16x16 pixels are needed")
        if self.width * self.height > LARGEST_PIXELS:
            raise DatasetError(f"camera image is {self.width}x{self.height}; at most {LARGEST_PIXELS} pixels are read")
        if len(self.distortion) not in (0, 4, 5, 8):
            raise DatasetError(
                f"camera has {len(self.distortion)} distortion coefficients; expected none, "
                "4 (k1 k2 p1 p2), 5 (k3) or 8 (k4 k5 k6)"
            )

    @property
    def K(self) -> NDArray[np.float64]:
        """Intrinsic matrix (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @cached_property
    def intrinsics(self) -> NDArray[np.float32]:
        """(4,) float32 fx, fy, cx, cy in pixels, for kernels."""
        return np.array([self.fx, self.fy, self.cx, self.cy], dtype=np.float32)

    @cached_property
    def focal(self) -> NDArray[np.float64]:
        """(2,) fx, fy in pixels."""
        return np.array([self.fx, self.fy])

    @cached_property
    def centre(self) -> NDArray[np.float64]:
        """(2,) cx, cy in pixels."""
        return np.array([self.cx, self.cy])

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (height, width) of an image array."""
        return self.height, self.width

    def scaled(self, level: int) -> "Camera":
        """Camera of the image halved ``level`` times by 2x2 blocks."""
        return _scaled(self, level)

    def resized(self, width: int, height: int) -> "Camera":
        """Camera of the same view in an image of another size."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
            width=width,
            height=height,
        )

    def backproject(self, depth: NDArray[np.floating]) -> NDArray[np.float32]:
        """Points (H, W, 3), metres, camera frame, of a depth image (H, W); the origin without depth."""
        u = (np.arange(depth.shape[1], dtype=np.float32) - np.float32(self.cx)) / np.float32(self.fx)
        v = (np.arange(depth.shape[0], dtype=np.float32) - np.float32(self.cy)) / np.float32(self.fy)
        z = depth.astype(np.float32)
        return np.stack([z * u[None, :], z * v[:, None], z], axis=-1).astype(np.float32, copy=False)

    def points(self, u: NDArray[Any], v: NDArray[Any], z: NDArray[Scalar]) -> NDArray[Scalar]:
        """Points (n, 3), metres, camera frame, at pixels u, v (n,) with depths z (n,)."""
        out = np.empty((len(z), 3), z.dtype)
        out[:, 0], out[:, 1], out[:, 2] = (u - self.cx) / self.fx * z, (v - self.cy) / self.fy * z, z
        return out

    def project(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Pixels (..., 2) of points (..., 3), camera frame; NaN for z <= 0 (eq. 4.4)."""
        points = np.asarray(points, dtype=np.float64)
        z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
        return np.stack(
            [points[..., 0] / z * self.fx + self.cx, points[..., 1] / z * self.fy + self.cy],
            axis=-1,
        )

    def nearest_pixels(
        self, points: NDArray[np.floating], border: int = 0
    ) -> tuple[NDArray[np.intp], NDArray[np.int64], NDArray[np.int64]]:
        """Indices of points (n, 3), camera frame, that project inside ``border`` pixels, and their nearest pixels u,
        v."""
        pixels = np.rint(self.project(points))
        inside = np.all((pixels >= border) & (pixels < (self.width - border, self.height - border)), axis=1)
        u, v = pixels[inside].astype(np.int64).T
        return np.flatnonzero(inside), u, v


@lru_cache(maxsize=32)  # used in every frame
def _scaled(camera: Camera, level: int) -> Camera:
    factor = 1.0 / (1 << level)
    return replace(
        camera,
        fx=camera.fx * factor,
        fy=camera.fy * factor,
        cx=(camera.cx + 0.5) * factor - 0.5,
        cy=(camera.cy + 0.5) * factor - 0.5,
        width=camera.width >> level,
        height=camera.height >> level,
    )
