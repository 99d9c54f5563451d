"""Surfaces that points are sampled on and measured to."""

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.mesh import Mesh
from dudmap.errors import MapError

if TYPE_CHECKING:
    from scipy.spatial import KDTree

Points = NDArray[np.float32]

CANDIDATES = 4
"""Number of nearest anchors whose triangles are measured exactly."""
ANCHORS = 400_000
"""Number of additional anchors that large triangles get, over the whole surface."""
BATCH = 200_000
"""Points measured at a time; bounds the memory."""


class Surface:
    """A triangle mesh that points can be sampled on and measured to.

    Args:
        mesh: The mesh; faces without area are ignored.
        name: Name of the surface in error messages.

    Attributes:
        area: Square metres.

    Raises:
        MapError: The mesh is empty, holds NaN, or has no faces.
    """

    def __init__(self, mesh: Mesh, name: str) -> None:
        if not len(mesh.vertices):
            raise MapError(f"{name} holds no vertices; nothing can be compared")
        if not np.all(np.isfinite(mesh.vertices)):
            raise MapError(f"{name} holds vertices that are NaN or infinite; remove them")
        if len(mesh.faces) and (mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices)):
            raise MapError(f"{name} has faces that name vertices it does not have; the file is damaged")
        corners = mesh.vertices.astype(np.float32)[mesh.faces]  # (F, 3, 3)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.linalg.norm(cross, axis=1) / 2
        real = areas > 0
        if not real.any():
            raise MapError(f"{name} has {len(mesh.vertices)} vertices but no faces with an area; give a triangle mesh")
        self._corners = corners[real]
        self._areas = areas[real].astype(np.float64)
        self.area = float(self._areas.sum())

    def samples(self, count: int, seed: int = 0) -> Points:
        """Points (count, 3) distributed uniformly over the area.

        Stratified: one point per equal share of the area. ``trimesh.sample`` draws independently, which has more
        variance, and took ten times as long (0.27 s for 100,000 points).
        """
        random = np.random.default_rng(seed)
        cumulated = np.cumsum(self._areas)
        steps = (np.arange(count) + random.random(count)) / count * cumulated[-1]  # stratified: one draw per equal area
        face = np.minimum(np.searchsorted(cumulated, steps), len(cumulated) - 1)
        return _inside(self._corners[face], random)

    def distances(self, points: Points) -> NDArray[np.float32]:
        """Distances (N,) of points (N, 3) to the surface, metres.

        Exact for the triangles of the nearest anchors. Every triangle has an anchor at its centroid, and large ones
        have more, at the spacing at which ``ANCHORS`` of them cover the surface. A nearer triangle is missed only
        where all the nearest anchors lie on its neighbours, and then by less than the spacing of the anchors.
        """
        out = np.empty(len(points), np.float32)
        for start in range(0, len(points), BATCH):
            batch = points[start : start + BATCH]
            nearest = np.full(len(batch), np.inf, np.float32)
            _, anchors = self._tree.query(batch, k=min(CANDIDATES, len(self._anchor_faces)), workers=-1)
            for column in anchors.reshape(len(batch), -1).T:
                nearest = np.minimum(
                    nearest, point_triangle_distances(batch, self._corners[self._anchor_faces[column]])
                )
            out[start : start + BATCH] = nearest
        return out

    @cached_property
    def _anchors(self) -> tuple[Points, NDArray[np.intp]]:
        spacing2 = self._areas.sum() / ANCHORS
        extra = np.minimum(self._areas / spacing2, ANCHORS).astype(np.intp)  # in addition to the centroid
        faces = np.repeat(np.arange(len(extra)), extra)
        middle = self._corners.mean(axis=1)
        spread = _inside(self._corners[faces], np.random.default_rng(0))
        return np.concatenate([middle, spread]), np.concatenate([np.arange(len(extra)), faces])

    @property
    def _anchor_faces(self) -> NDArray[np.intp]:
        return self._anchors[1]

    @cached_property
    def _tree(self) -> "KDTree":
        from scipy.spatial import KDTree

        return KDTree(self._anchors[0], balanced_tree=False, compact_nodes=False)


def _inside(corners: Points, random: np.random.Generator) -> Points:
    """One point per triangle (N, 3, 3), uniform over its area (Turk 1990)."""
    a, b = np.sqrt(random.random(len(corners), np.float32)), random.random(len(corners), np.float32)
    weights = np.stack([1 - a, a * (1 - b), a * b], axis=1)
    return np.einsum("nk,nkd->nd", weights, corners)


def point_triangle_distances(points: Points, corners: Points) -> NDArray[np.float32]:
    """Distance (N,) of each point (N, 3) to its triangle (N, 3, 3), metres."""
    from trimesh.triangles import closest_point

    return np.linalg.norm(points - closest_point(corners, points), axis=1).astype(np.float32)


def moved(mesh: Mesh, T: NDArray[np.float64]) -> Mesh:
    """Mesh after the rigid motion ``T`` (4, 4)."""
    return Mesh(
        (mesh.vertices @ T[:3, :3].T + T[:3, 3]).astype(np.float32),
        mesh.faces,
        mesh.colors,
        (mesh.normals @ T[:3, :3].T).astype(np.float32),
    )
