"""Images with and without lens distortion."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.camera import Camera


class Lens:
    """Geometry of the recorded images of a camera.

    Args:
        camera: With its distortion.

    Attributes:
        camera: As given.
        straight: The same camera without distortion, which rendered images have.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.straight = replace(camera, distortion=())
        self._pixels: NDArray[np.float32] | None = None
        if camera.distortion:
            import cv2

            v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
            grid = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
            lens = np.array(camera.distortion, np.float64)
            self._pixels = cv2.undistortPoints(grid, camera.K, lens, P=camera.K).reshape(*camera.shape, 2).astype("f4")

    def distorted(self, image: NDArray, *, nearest: bool = False) -> NDArray:
        """Rendered image (H, W[, 3]) in the geometry of the recorded one; 0 outside of it."""
        if self._pixels is None:
            return image
        import cv2

        how = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
        return cv2.remap(image, self._pixels[..., 0], self._pixels[..., 1], how, borderMode=cv2.BORDER_CONSTANT)

    def points(self, rows: NDArray[np.intp], columns: NDArray[np.intp], z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (n, 3), metres, camera frame, at recorded pixels (n,) with depths (n,)."""
        if self._pixels is None:
            return self.camera.points(columns, rows, z)
        u, v = self._pixels[rows, columns].astype(np.float64).T
        return self.camera.points(u, v, z)

    def project(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Recorded pixels (n, 2) and depths (n,) of points (n, 3); behind the camera the pixels are (-1, -1)."""
        z = points[:, 2]
        if self.camera.distortion:
            import cv2

            none = np.zeros(3)
            uv = cv2.projectPoints(points, none, none, self.camera.K, np.array(self.camera.distortion))[0].reshape(
                -1, 2
            )
        else:
            uv = self.camera.project(points)
        uv = np.where((z > 0)[:, None] & np.isfinite(uv), uv, -1)
        return np.clip(uv, -1, 1e6).astype(np.float32), z
