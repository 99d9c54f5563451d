"""Correction of depth readings whose inverse depth is off by a polynomial over the image."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.frames.observation import Observation
from dudmap.geometry.camera import Camera

ORDER = 4
"""Largest order of the polynomial."""


@dataclass(frozen=True, eq=False)
class DepthCorrection:
    """Adds ``c(x, y) = sum_ij coefficients[i, j] x^i y^j`` to the inverse depth of a reading along (x, y, 1).

    A triangulating sensor measures the disparity f b / z; what its optics get wrong is an error of the disparity that
    depends on the place in the image, not on the depth: 1 / z_true = 1 / z + c(x, y), as a multiplier
    m(x, y, z) = 1 / (1 + z c(x, y)).

    Attributes:
        coefficients: (ORDER + 1, ORDER + 1) float64, 1/m.
    """

    coefficients: NDArray[np.float64] = field(default_factory=lambda: np.zeros((ORDER + 1, ORDER + 1)))

    def change(self, camera: Camera) -> NDArray[np.float32]:
        """c(x, y) at the pixels (h, w) of ``camera``, 1/m."""
        x = (np.arange(camera.width) - camera.cx) / camera.fx
        y = (np.arange(camera.height) - camera.cy) / camera.fy
        rows = np.vander(y, ORDER + 1, increasing=True) @ self.coefficients.T
        return rows.astype(np.float32) @ np.vander(x, ORDER + 1, increasing=True).T.astype(np.float32)

    def depth(self, depth: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
        """Corrected depth (h, w) in metres of ``camera``: z / (1 + z c); 0 stays 0."""
        divisor = self.change(camera)
        divisor *= depth
        divisor += np.float32(1)
        return np.divide(depth, divisor, out=divisor)

    def observation(self, observation: Observation) -> Observation:
        """The observation with corrected depth, before it is halved."""
        if not self.coefficients.any():
            return observation
        return replace(observation, depth=self.depth(observation.depth, observation.camera))
