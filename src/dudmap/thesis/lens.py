"""Lens distortion (thesis section 3.3)."""

import cv2
import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.camera import Camera

ITERATIONS = 20
"""Fixed-point iterations of the inverse."""


def distort(X: NDArray[np.float64], kappa: NDArray[np.float64], rho: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distorted normalised coordinates rho_o(X) (eq. 3.87; with kappa_4..6 = 0 eq. 3.88).

    Reading: the second line of eq. 3.88 has one x too many; eq. 3.87 is right.

    Args:
        X: (..., 2) normalised coordinates x, y.
        kappa: (6,) radial coefficients kappa_1..6.
        rho: (2,) tangential coefficients rho_1, rho_2.
    """
    x, y = X[..., 0], X[..., 1]
    r2 = x * x + y * y
    radial = (1 + r2 * (kappa[0] + r2 * (kappa[1] + r2 * kappa[2]))) / (
        1 + r2 * (kappa[3] + r2 * (kappa[4] + r2 * kappa[5]))
    )
    return np.stack(
        [
            x * radial + 2 * rho[0] * x * y + rho[1] * (r2 + 2 * x * x),
            y * radial + 2 * rho[1] * x * y + rho[0] * (r2 + 2 * y * y),
        ],
        axis=-1,
    )


class Lens:
    """Removes a camera's distortion from images, and restores it in masks.

    Args:
        camera: Its coefficients are k1, k2, p1, p2[, k3[, k4, k5, k6]].
    """

    def __init__(self, camera: Camera) -> None:
        self._maps = None
        if any(camera.distortion):
            k = np.zeros(8)
            k[: len(camera.distortion)] = camera.distortion
            self._kappa, self._rho = k[[0, 1, 4, 5, 6, 7]], k[2:4]
            v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
            straight = (np.stack([u, v], axis=-1) - camera.centre) / camera.focal
            bent = self._undistorted(straight)
            self._maps = [self._pixels(camera, distort(straight, self._kappa, self._rho)), self._pixels(camera, bent)]

    def undistort(self, image: NDArray, *, nearest: bool) -> NDArray:
        """Image (H, W[, 3]) without distortion, nearest or interpolated; 0 outside."""
        if self._maps is None:
            return image
        return np.asarray(cv2.remap(image, *self._maps[0], cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR))

    def distorted(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Mask (H, W) in the recorded image; False outside."""
        if self._maps is None:
            return mask
        return np.asarray(cv2.remap(mask.astype(np.uint8), *self._maps[1], cv2.INTER_NEAREST)) > 0

    def _undistorted(self, bent: NDArray[np.float64]) -> NDArray[np.float64]:
        X = bent
        for _ in range(ITERATIONS):
            X = X + bent - distort(X, self._kappa, self._rho)
        return X

    @staticmethod
    def _pixels(camera: Camera, X: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        u, v = np.moveaxis((X * camera.focal + camera.centre).astype(np.float32), -1, 0)
        return u, v
