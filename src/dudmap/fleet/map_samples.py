"""Sample a map at points of its world."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from dudmap.core.backends.cpu.points import EMPTY, INTENSITY, OBSERVED, RED, SDF, UNSEEN, WEIGHT, sample_points
from dudmap.core.map.volume import TsdfVolume

__all__ = ["EMPTY", "OBSERVED", "UNSEEN", "MapSamples", "SurfacePoints", "sample_map", "surface_points"]

IN_BAND = 0.9
"""Share of the truncation beyond which a voxel is free space (``SURFACE_SHARE`` in ``core/formulas/voxel.py``)."""
NOISE_IN_BAND = 2.0
"""Standard deviations of noise within the truncation for free space to contradict a surface."""


@dataclass(frozen=True, eq=False)
class MapSamples:
    """A map at n points.

    Attributes:
        state: (n,) uint8, UNSEEN, OBSERVED, or EMPTY.
        sdf: (n,) float32, metres; the truncation distance in free space.
        sdf_gradient: (n, 3) float32, metres per metre.
        weight: (n,) float32, smallest around the point.
        intensity: (n,) float32, 0..1; 0 = unknown.
        intensity_gradient: (n, 3) float32, per metre.
        color: (n, 3) float32, red green blue, 0..255; 0 = unknown.
    """

    state: NDArray[np.uint8]
    sdf: NDArray[np.float32]
    sdf_gradient: NDArray[np.float32]
    weight: NDArray[np.float32]
    intensity: NDArray[np.float32]
    intensity_gradient: NDArray[np.float32]
    color: NDArray[np.float32]

    def is_free(self, distance: float | NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether points (n,) lie in free space, farther than ``distance`` (n,) (m) from surface."""
        return (self.state == EMPTY) | ((self.state == OBSERVED) & (self.sdf > distance))


def sample_map(volume: TsdfVolume, points: NDArray[np.float64]) -> MapSamples:
    """Trilinear samples of a map at points (n, 3) of its world, metres."""
    blocks, size = volume.blocks, volume.voxel_size
    rows, states = sample_points(
        blocks.table, blocks.coords, blocks.slot_of, blocks.free_count, blocks.geometry, blocks.colors,
        np.ascontiguousarray(points, dtype=np.float64) / size, np.eye(4)[:3],
        volume.truncation / volume.sdf_unit, float(volume.config.carve_rate),
    )  # fmt: skip
    metres, shade = np.float32(volume.sdf_unit), np.float32(1 / 255)
    return MapSamples(
        states,
        rows[:, SDF] * metres,
        rows[:, SDF + 1 : SDF + 4] * np.float32(volume.sdf_unit / size),
        rows[:, WEIGHT],
        rows[:, INTENSITY] * shade,
        rows[:, INTENSITY + 1 : INTENSITY + 4] * np.float32(1 / 255 / size),
        rows[:, RED : RED + 3] / np.float32(4),
    )


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points on the surface of a map.

    Attributes:
        points: (n, 3) float64, metres, map world.
        intensity: (n,) float32, 0..1, 0 = unknown.
        color: (n, 3) float32, red green blue, 0..255.
        near: (n,) bool, whether a camera was near enough for its noise to fit into the band.
    """

    points: NDArray[np.float64]
    intensity: NDArray[np.float32]
    color: NDArray[np.float32]
    near: NDArray[np.bool_]
    area_each: float

    def __len__(self) -> int:
        return len(self.points)


def surface_points(volume: TsdfVolume, cameras: NDArray[np.float64], count: int) -> SurfacePoints:
    """At most ``count`` random vertices of a map's mesh, evenly spread.

    ``cameras`` (k, 3): of its keyframes, metres.

    Raises:
        MapError: The map is empty.
    """
    mesh = volume.extract_mesh()
    chosen = np.arange(len(mesh.vertices))
    if len(chosen) > count:
        chosen = np.sort(np.random.default_rng(1).choice(len(chosen), count, replace=False))
    points = mesh.vertices[chosen].astype(np.float64)
    samples = sample_map(volume, points)
    distances = KDTree(cameras).query(points)[0] if len(cameras) else np.full(len(points), np.inf)
    near = NOISE_IN_BAND * volume.sensor.sigma(distances) < volume.truncation
    return SurfacePoints(points, samples.intensity, samples.color, near, mesh.area() / max(len(chosen), 1))


def transformed(T: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (n, 3) after a rigid motion (4, 4)."""
    return points @ T[:3, :3].T + T[:3, 3]
