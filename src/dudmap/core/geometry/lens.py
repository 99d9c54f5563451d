"""Lens distortion of rendered images, and reprojection of depth and masks into a second camera."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.camera import Camera

BEHIND = 0.03
"""Share by which a surface must be nearer to hide another: two standard deviations at 4 m, doubled."""


class Lens:
    """Geometry of the recorded images of a camera; ``straight`` is the same camera without distortion, used for
    rendered images."""

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
        """Recorded pixels (n, 2) and depths (n,) of points (n, 3); (-1, -1) for points behind the camera."""
        z = points[:, 2]
        if self.camera.distortion:
            import cv2

            lens = np.array(self.camera.distortion)
            uv = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.camera.K, lens)[0].reshape(-1, 2)
        else:
            uv = self.camera.project(points)
        uv = np.where((z > 0)[:, None] & np.isfinite(uv), uv, -1)
        return np.clip(uv, -1, 1e6).astype(np.float32), z


class OtherView:
    """Reprojection from the depth camera into a second camera."""

    def __init__(self, depth_lens: Lens, color_lens: Lens) -> None:
        self.depth_lens, self.color_lens = depth_lens, color_lens
        one, other = depth_lens.camera, color_lens.camera
        self._spread = max(1, int(np.ceil(max(other.fx / one.fx, other.fy / one.fy))))

    def depth(self, depth: NDArray[np.float32], T_color_depth: NDArray[np.float64]) -> NDArray[np.float32]:
        """Depth (h, w), metres, of a depth image (H, W) in the second camera, 0 = none. ``T_color_depth``: (4, 4)."""
        rows, columns = np.nonzero(depth > 0)
        return self._splatted(rows, columns, depth[rows, columns], T_color_depth)

    def mask(
        self, mask: NDArray[np.bool_], depth: NDArray[np.float32], T_color_depth: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Pixels (h, w) of the second camera that show the masked surface (H, W), unless hidden. Pixels without depth
        take the nearest marked pixel's."""
        from scipy.ndimage import binary_closing, distance_transform_edt

        marked = mask & (depth > 0)
        if not marked.any():
            return np.zeros(self.color_lens.camera.shape, bool)
        nearest = distance_transform_edt(~marked, return_distances=False, return_indices=True)
        filled = depth[tuple(np.asarray(nearest))]
        rows, columns = np.nonzero(mask)
        front = self._splatted(rows, columns, filled[rows, columns], T_color_depth)
        others = self.depth(np.where(mask, 0, depth).astype(np.float32), T_color_depth)
        shown = (front > 0) & ((others == 0) | (front < (1 + BEHIND) * others))
        return np.asarray(binary_closing(np.pad(shown, 2), np.ones((3, 3))))[2:-2, 2:-2].astype(np.bool_)

    def _splatted(
        self, rows: NDArray[np.intp], columns: NDArray[np.intp], z: NDArray[np.float32], T: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        points = self.depth_lens.points(rows, columns, z.astype(np.float64))
        uv, depths = self.color_lens.project(points @ T[:3, :3].T + T[:3, 3])
        order = np.argsort(-depths)  # the nearest is written last
        uv, depths = uv[order], depths[order]
        height, width = self.color_lens.camera.shape
        out = np.zeros((height, width), np.float32)
        corner = np.floor(uv - (self._spread - 1) / 2 + 0.5).astype(np.intp)
        for dv in range(self._spread):
            for du in range(self._spread):
                u, v = corner[:, 0] + du, corner[:, 1] + dv
                inside = (u >= 0) & (u < width) & (v >= 0) & (v < height) & (depths > 0)
                nearer = np.zeros((height, width), np.float32)
                nearer[v[inside], u[inside]] = depths[inside]
                out = np.where((nearer > 0) & ((out == 0) | (nearer < out)), nearer, out)
        return out
