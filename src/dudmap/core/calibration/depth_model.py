"""What is known of the static distortion of a depth camera."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.polynomial.legendre import leg2poly, legvander
from numpy.typing import NDArray

from dudmap.atomic_file import atomic_file
from dudmap.core.frames.depth_correction import FARTHEST, MIDDLE, NEAREST, ORDER, DepthCorrection
from dudmap.core.geometry.camera import Camera
from dudmap.errors import DatasetError
from dudmap.input_files import DAMAGE, open_arrays

PLACES = [(i, order - i) for order in range(2, ORDER + 1) for i in range(order + 1)]
"""Orders (i, j) of the products of Legendre polynomials P_i(x / X) P_j(y / Y), X and Y the edges of the image. They are
orthogonal to 1, x and y over the image, which turn planes into planes and which the motion of the camera imitates."""
TERMS = [(k, i, j) for k in (0, 1) for i, j in PLACES]
"""Orders of (z - MIDDLE)^k P_i(x / X) P_j(y / Y)."""
SIGNIFICANT = 3.0
"""Standard deviations below which a term is not applied at all."""


@dataclass(frozen=True, eq=False)
class DepthModel:
    """Distortion ``1 / z_true = 1 / z + sum_k state_k term_k(x, y, z)``.

    Attributes:
        state: (K,) coefficients of TERMS, 1/m and 1/m^2.
        covariance: (K, K).
        extent: (2,) X and Y, directions of the edges of the image.
        views: Number of images from which it was estimated.
    """

    state: NDArray[np.float64]
    covariance: NDArray[np.float64]
    extent: NDArray[np.float64]
    views: int

    @property
    def sigma(self) -> NDArray[np.float64]:
        """Standard deviations (K,) of the state."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correction(self) -> DepthCorrection:
        """The significant part: each term is shrunk by max(0, 1 - (3 sigma / s)^2)."""
        ratio = SIGNIFICANT * self.sigma / np.maximum(np.abs(self.state), 1e-12)
        coefficients = np.zeros((2, ORDER + 1, ORDER + 1))
        for (k, i, j), value in zip(TERMS, self.state * np.maximum(0, 1 - ratio**2), strict=True):
            powers_x, powers_y = (leg2poly([0.0] * n + [1.0]) for n in (i, j))
            scaled_x, scaled_y = (
                powers / edge ** np.arange(len(powers))
                for powers, edge in zip((powers_x, powers_y), self.extent, strict=True)
            )
            coefficients[k, : j + 1, : i + 1] += value * np.outer(scaled_y, scaled_x)
        return DepthCorrection(coefficients)

    def largest(self, camera: Camera) -> float:
        """Largest significant error of the inverse depth at 2 m in the image of a camera, 1/m."""
        return float(np.abs(self.correction.change(camera)[0]).max())

    def save(self, path: Path) -> None:
        """Write it as NumPy archive: ``terms`` (K, 3), ``state`` (K,), ``covariance`` (K, K),
        ``extent`` (2,), ``views``.

        Raises:
            OSError: The file cannot be written.
        """
        values = {"state": self.state, "covariance": self.covariance, "extent": self.extent, "views": self.views}
        with atomic_file(path) as file:
            np.savez(file, terms=TERMS, **values)

    @classmethod
    def load(cls, path: Path) -> "DepthModel":
        """What ``save`` wrote.

        Raises:
            DatasetError: The file is missing or not such a file.
        """
        try:
            with open_arrays(path) as data:
                if not np.array_equal(data["terms"], TERMS):
                    raise DatasetError(f"{path} holds a depth model of other terms than this version")
                state, covariance = (np.asarray(data[key], np.float64) for key in ("state", "covariance"))
                extent = np.asarray(data["extent"], np.float64)
                views = int(data["views"])
        except DAMAGE as error:
            raise DatasetError(f"{path} is not a readable depth model: {error}") from error
        if state.shape != (len(TERMS),) or covariance.shape != (len(TERMS),) * 2 or extent.shape != (2,):
            raise DatasetError(f"{path} is not a readable depth model: its arrays have other shapes than its terms")
        if not (np.isfinite(state).all() and np.isfinite(covariance).all() and np.all(np.diag(covariance) >= 0)):
            raise DatasetError(f"{path} is not a readable depth model: its covariance is not one")
        return cls(state, covariance, extent, views)


def image_extent(camera: Camera) -> NDArray[np.float64]:
    """Directions (2,) of the edges of the image of a camera that are farthest from its axis."""
    across = max(camera.cx + 0.5, camera.width - 0.5 - camera.cx) / camera.fx
    down = max(camera.cy + 0.5, camera.height - 0.5 - camera.cy) / camera.fy
    return np.array([across, down])


def terms(xy: NDArray[np.float64], z: NDArray[np.float64], extent: NDArray[np.float64]) -> NDArray[np.float64]:
    """Terms (n, K) at image directions (n, 2) and depths (n,) in metres, for an image that ends at ``extent`` (2,)."""
    across, down = (legvander(axis, ORDER) for axis in (xy / extent).T)
    places = np.stack([across[:, i] * down[:, j] for i, j in PLACES], axis=1)
    return np.hstack([places, places * (np.clip(z, NEAREST, FARTHEST) - MIDDLE)[:, None]])
