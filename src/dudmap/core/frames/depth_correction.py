"""Correction of depth readings whose inverse depth is off by a polynomial over the image and the depth."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.observation import Observation
from dudmap.core.geometry.camera import Camera

ORDER = 4
"""Largest order of the polynomial over the image."""
MIDDLE, NEAREST, FARTHEST = 2.0, 0.5, 5.0
"""Depth from which on the change with the depth counts, and the depths beyond which it no longer changes, metres."""


@dataclass(frozen=True, eq=False)
class DepthCorrection:
    """Adds ``c(x, y, z) = sum_kij coefficients[k, j, i] (z - MIDDLE)^k x^i y^j`` to the inverse depth of a reading z
    along (x, y, 1).

    A triangulating sensor measures the disparity f b / z; what its optics get wrong is an error of the disparity that
    depends on the place in the image and hardly on the depth: 1 / z_true = 1 / z + c, a multiplier 1 / (1 + z c).

    Attributes:
        coefficients: (2, ORDER + 1, ORDER + 1) float64, 1/m and 1/m^2.
    """

    coefficients: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, ORDER + 1, ORDER + 1)))

    def change(self, camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """At the pixels (h, w) of ``camera``: c at the depth MIDDLE, 1/m, and its growth with the depth, 1/m^2."""
        x = (np.arange(camera.width) - camera.cx) / camera.fx
        y = (np.arange(camera.height) - camera.cy) / camera.fy
        powers_x, powers_y = (np.vander(axis, ORDER + 1, increasing=True) for axis in (x, y))
        constant, growth = (powers_y @ part @ powers_x.T for part in self.coefficients)
        return constant.astype(np.float32), growth.astype(np.float32)

    def depth(self, depth: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
        """Corrected depth (h, w) in metres of ``camera``: z / (1 + z c); 0 stays 0."""
        constant, growth = self.change(camera)
        c = constant + growth * (np.clip(depth, NEAREST, FARTHEST) - np.float32(MIDDLE))
        return np.asarray(depth / (1 + depth * c), np.float32)

    def observation(self, observation: Observation) -> Observation:
        """The observation with corrected depth, before it is halved."""
        if not self.coefficients.any():
            return observation
        return replace(observation, depth=self.depth(observation.depth, observation.camera))
