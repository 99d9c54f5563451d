"""The point of a mesh under the mouse."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.mesh import Mesh


def first_hit(
    origin: NDArray[np.float64], direction: NDArray[np.float64], meshes: Iterable[Mesh]
) -> NDArray[np.float64] | None:
    """Nearest point (3,) of a ray on the front of a triangle; None if it hits none."""
    distances = [_distance(origin, direction, mesh) for mesh in meshes]
    nearest = min(distances, default=np.inf)
    return origin + nearest * direction if np.isfinite(nearest) else None


def _distance(origin: NDArray[np.float64], direction: NDArray[np.float64], mesh: Mesh) -> float:
    """Distance in ``direction`` units (Moeller and Trumbore 1997)."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    from_a, across = origin - a, np.cross(direction, c - a)
    det = np.einsum("ij,ij->i", b - a, across)  # positive if the triangle is seen from its front
    around = np.cross(from_a, b - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = np.einsum("ij,ij->i", from_a, across) / det, around @ direction / det
        t = np.einsum("ij,ij->i", c - a, around) / det
        hit = (det > 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return float(t[hit].min(initial=np.inf))
