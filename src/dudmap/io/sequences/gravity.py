"""The direction against gravity measured by a recording."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.trajectory import Trajectory

NEAR = 0.05
"""Largest time between a measurement and its pose, seconds."""


class Gravity(NamedTuple):
    """Directions against gravity in the axes of the depth camera.

    Attributes:
        timestamps: (N,) times of the measurements, seconds.
        ups: (N, 3) unit vectors against gravity, depth camera axes.
        source: A file or topic.
    """

    timestamps: NDArray[np.float64]
    ups: NDArray[np.float64]
    source: str

    @classmethod
    def of_rotations(
        cls, rotations: list[tuple[float, NDArray[np.float64]]], up: tuple[float, float, float], source: str
    ) -> "Gravity | None":
        """Measurements from timed rotations (3, 3) of the camera into a world with a known up."""
        if not rotations:
            return None
        ups = np.array([np.asarray(up) @ R for _, R in rotations])
        return cls(np.array([stamp for stamp, _ in rotations]), ups, source)

    def in_world(self, poses: Trajectory) -> "MeasuredUp | None":
        """Mean direction in the world of a run; None if no measurement is near one of them."""
        if not len(poses) or not len(self.timestamps):
            return None
        stamps = poses.timestamps
        after = np.clip(np.searchsorted(stamps, self.timestamps), 1, max(len(stamps) - 1, 1))
        before, after = after - 1, np.minimum(after, len(stamps) - 1)
        first = np.abs(stamps[before] - self.timestamps) < np.abs(stamps[after] - self.timestamps)
        nearest = np.where(first, before, after)
        near = np.abs(stamps[nearest] - self.timestamps) <= NEAR
        if not near.any():
            return None
        ups = np.einsum("nij,nj->ni", poses.Ts_world_camera[nearest[near], :3, :3], self.ups[near])
        mean, sigma_deg = mean_direction(ups)
        return None if mean is None else MeasuredUp(mean, sigma_deg, self.source, len(ups))


class MeasuredUp(NamedTuple):
    """Direction against gravity of a recording in the world of a run.

    Attributes:
        direction: (3,) unit vector.
        sigma_deg: Root mean square angle, degrees.
        readings: Number of measurements.
    """

    direction: NDArray[np.float64]
    sigma_deg: float
    source: str
    readings: int


def mean_direction(vectors: NDArray[np.float64]) -> tuple[NDArray[np.float64] | None, float]:
    """Mean (3,) of unit vectors (N, 3), None if they cancel out, and root mean square angle to it, degrees."""
    mean = vectors.mean(axis=0)
    length = float(np.linalg.norm(mean))
    if length < 1e-9:
        return None, 180.0
    angles = np.arccos(np.clip(vectors @ mean / length, -1, 1))
    return mean / length, float(np.degrees(np.sqrt(np.mean(angles**2))))
