"""Surfaces for sampling and distances, and registration of two surfaces."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.geometry.mesh import Mesh
from dudmap.errors import MapError

if TYPE_CHECKING:
    from scipy.spatial import KDTree

Points = NDArray[np.float32]

CANDIDATES = 4
ANCHORS = 400_000
"""Additional anchors on large triangles."""
BATCH = 200_000
OVERLAP, REACH, ITERATIONS = 0.8, 0.3, 60
"""Registration: share of the estimate with a counterpart, largest distance of a pair (m), iterations."""


class Surface:
    """A triangle mesh, or point cloud if allowed.

    Args:
        mesh: Faces without area are ignored.

    Attributes:
        area: Square metres; None for a point cloud.

    Raises:
        MapError: Empty, NaN, or no faces and not ``points``.
    """

    def __init__(self, mesh: Mesh, name: str, *, points: bool = False) -> None:
        if not len(mesh.vertices):
            raise MapError(f"{name} holds no vertices; nothing can be compared")
        if not np.all(np.isfinite(mesh.vertices)):
            raise MapError(f"{name} holds vertices that are NaN or infinite; remove them")
        if len(mesh.faces) and (mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices)):
            raise MapError(f"{name} has faces that name vertices it does not have; the file is damaged")
        self._vertices = mesh.vertices.astype(np.float32)
        corners = self._vertices[mesh.faces]  # (F, 3, 3)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.linalg.norm(cross, axis=1) / 2
        real = areas > 0
        if not real.any() and not points:
            raise MapError(
                f"{name} has {len(self._vertices)} vertices but no faces with an area; "
                "give a triangle mesh, or say that it is a point cloud (--points)"
            )
        self._corners = corners[real]
        self._areas = areas[real].astype(np.float64)
        self._normals = cross[real] / (2 * areas[real, None])
        self.area = float(self._areas.sum()) if real.any() else None

    @property
    def is_cloud(self) -> bool:
        """Whether the surface is a point cloud."""
        return self.area is None

    def samples(self, count: int, seed: int = 0) -> Points:
        """Points (count, 3), one per equal share of the area; of a point cloud, ``count`` of its points."""
        random = np.random.default_rng(seed)
        if self.is_cloud:
            chosen = random.choice(len(self._vertices), count, replace=count > len(self._vertices))
            return self._vertices[chosen]
        cumulated = np.cumsum(self._areas)
        steps = (np.arange(count) + random.random(count)) / count * cumulated[-1]  # stratified: one draw per equal area
        face = np.minimum(np.searchsorted(cumulated, steps), len(cumulated) - 1)
        return _inside(self._corners[face], random)

    def distances(self, points: Points) -> NDArray[np.float32]:
        """Distances (N,) of points (N, 3) to the surface, metres.

        Exact for the triangles of the nearest anchors: centroids, and more on large triangles. A nearer one is missed
        by less than the anchor spacing.
        """
        out = np.empty(len(points), np.float32)
        for start in range(0, len(points), BATCH):
            batch = points[start : start + BATCH]
            if self.is_cloud:
                out[start : start + BATCH] = self._tree.query(batch, workers=-1)[0]
                continue
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
        if self.is_cloud:
            return self._vertices, np.arange(len(self._vertices))
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

    def nearest_planes(self, points: Points) -> tuple[NDArray[np.float64], Points, Points]:
        """Distance (N,) to the nearest anchor, the anchor (N, 3) and its normal (N, 3)."""
        distance, nearest = self._tree.query(points, workers=-1)
        anchors, faces = self._anchors
        normals = self._normals[faces[nearest]] if not self.is_cloud else np.zeros_like(points)
        return distance, anchors[nearest], normals.astype(np.float32)


def _inside(corners: Points, random: np.random.Generator) -> Points:
    a, b = np.sqrt(random.random(len(corners), np.float32)), random.random(len(corners), np.float32)
    weights = np.stack([1 - a, a * (1 - b), a * b], axis=1)
    return np.einsum("nk,nkd->nd", weights, corners)


def point_triangle_distances(points: Points, corners: Points) -> NDArray[np.float32]:
    """Distance (N,) of each point (N, 3) to its triangle (N, 3, 3), metres."""
    from trimesh.triangles import closest_point

    return np.linalg.norm(points - closest_point(corners, points), axis=1).astype(np.float32)


@dataclass(frozen=True, eq=False)
class SurfaceAlignment:
    """Result of the registration of two surfaces.

    Attributes:
        T_reference_estimate: (4, 4).
        rmse: Point-to-plane, of the last inliers, metres.
        free_directions: Undetermined degrees of freedom, which stay fixed.
    """

    T_reference_estimate: NDArray[np.float64]
    rmse: float
    num_iterations: int
    free_directions: int


def register(
    estimate: Mesh, reference: Mesh, T_reference_estimate: NDArray[np.float64] | None = None, *, samples: int = 30_000
) -> SurfaceAlignment:
    """Trimmed point-to-plane ICP (Chen and Medioni 1992; trimming: Chetverikov et al. 2002) of the share ``OVERLAP``
    within ``REACH``, without ghosts and missing parts.

    Raises:
        MapError: No faces, or too few points within ``REACH``.
    """
    target = Surface(reference, "the reference")
    points = Surface(estimate, "the estimate").samples(samples).astype(np.float64)
    T = np.eye(4) if T_reference_estimate is None else T_reference_estimate.copy()
    rmse, free, steps = float("nan"), 0, 0
    while steps < ITERATIONS:
        steps += 1
        at = points @ T[:3, :3].T + T[:3, 3]
        distance, anchor, normal = target.nearest_planes(at.astype(np.float32))
        count = distance <= min(REACH, float(np.quantile(distance, OVERLAP)))
        if np.count_nonzero(count) < 100:
            raise MapError(
                f"only {np.count_nonzero(count)} of {samples} points of the estimate lie within {REACH:g} m of the "
                "reference; the two meshes do not overlap where they start: bring them into one frame first"
            )
        p, n = at[count], normal[count].astype(np.float64)
        center = p.mean(axis=0)
        residual = np.einsum("nd,nd->n", p - anchor[count], n)
        J = np.concatenate([n, np.cross(p - center, n)], axis=1)  # twist about the centre, for a well-scaled system
        values, vectors = np.linalg.eigh(J.T @ J)
        determined = values > 1e-5 * values[-1]
        xi = -(vectors[:, determined] / values[determined]) @ (vectors[:, determined].T @ (J.T @ residual))
        about = np.eye(4)
        about[:3, 3] = center
        T = about @ se3.exp(xi) @ se3.inverse(about) @ T
        rmse, free = float(np.sqrt(np.mean(residual**2))), int(np.count_nonzero(~determined))
        if np.linalg.norm(xi[:3]) < 1e-6 and np.linalg.norm(xi[3:]) < 1e-6:
            break
    return SurfaceAlignment(T, rmse, steps, free)


def moved(mesh: Mesh, T: NDArray[np.float64]) -> Mesh:
    """Mesh after the rigid motion ``T`` (4, 4)."""
    return Mesh(
        (mesh.vertices @ T[:3, :3].T + T[:3, 3]).astype(np.float32),
        mesh.faces,
        mesh.colors,
        (mesh.normals @ T[:3, :3].T).astype(np.float32),
    )
