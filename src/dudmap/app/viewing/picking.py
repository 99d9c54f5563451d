"""The point of a mesh under the pointer."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.mesh import Mesh


def first_hit(
    origin: NDArray[np.float64], direction: NDArray[np.float64], meshes: Iterable[Mesh]
) -> NDArray[np.float64] | None:
    """Nearest intersection (3,) of a ray with the triangles of some meshes, None if it meets none.

    Args:
        origin: (3,) metres, frame of the meshes.
        direction: (3,) of any length.
        meshes: Those whose bounding box the ray misses cost next to nothing.
    """
    distances = [distance for mesh in meshes if (distance := _distance(origin, direction, mesh)) is not None]
    return origin + min(distances) * direction if distances else None


def _distance(origin: NDArray[np.float64], direction: NDArray[np.float64], mesh: Mesh) -> float | None:
    """Distance in units of ``direction`` to the nearest triangle (Moeller and Trumbore 1997)."""
    if len(mesh.faces) == 0 or not _meets_box(origin, direction, mesh):
        return None
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    edge_b, edge_c, from_a = b - a, c - a, origin - a
    p = np.cross(direction, edge_c)
    q = np.cross(from_a, edge_b)
    det = np.einsum("ij,ij->i", edge_b, p)
    with np.errstate(divide="ignore", invalid="ignore"):  # a ray in the plane of a triangle does not meet it
        u = np.einsum("ij,ij->i", from_a, p) / det
        v = q @ direction / det
        t = np.einsum("ij,ij->i", edge_c, q) / det
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return float(t[hit].min()) if hit.any() else None


def _meets_box(origin: NDArray[np.float64], direction: NDArray[np.float64], mesh: Mesh) -> bool:
    """Whether the ray passes through the bounding box of the mesh (slab test)."""
    low, high = mesh.vertices.min(axis=0) - 1e-6, mesh.vertices.max(axis=0) + 1e-6
    slope = np.where(direction == 0, 1e-300, direction)
    to_low, to_high = (low - origin) / slope, (high - origin) / slope
    enter, leave = np.minimum(to_low, to_high).max(), np.maximum(to_low, to_high).min()
    return bool(enter <= leave and leave > 0)
