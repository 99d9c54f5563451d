"""Compare the surface of one map with another of the same place.

Every vertex is confirmed, denied, behind a surface, or not seen by the other map. It is denied if the other map has
free space there and no surface within the noise of both maps. The noise is one voxel plus three standard deviations of
the local noise, the larger of the sensor's and the spread of nearby distances.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from dudmap.core.geometry import se3
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.map import morton
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.saved_map import SavedMap
from dudmap.fleet.map_samples import EMPTY, OBSERVED, MapSamples, sample_map, transformed

UNKNOWN, CONFIRMED, DENIED, BEHIND = 0, 1, 2, 3
"""State of a vertex in the other map."""
DEVIATIONS = 3.0
"""Standard deviations within noise."""
MAX_VIEWS, VIEWS = 24, 3
"""Rendered poses of a visit, and how many must look through a place."""
CELL = 0.5
"""Cells of the noise between surfaces, metres: the size of furniture."""
MIN_CELL_POINTS = 50
"""Fewest vertices of a cell with its own noise."""
MAX_NOISE = 2.0
"""Largest local noise over the place's, against moved surface."""
EDGE_PIXELS = 2.0
"""Width of a depth edge, pixels and voxels."""
READINGS = 2
"""Observations of emptiness, each of the carving weight, that make a place free."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Surface of one map with its state in the other map.

    Attributes:
        mesh: Surface in the common frame.
        state: (V,) uint8.
        gap: (V,) float32, distance to the other surface, metres; 0 within the noise.
        tolerance: (V,) noise, metres.
        blur: (V,) width of a depth edge, metres: two pixels and two voxels, plus noise.
        weight: (V,) float32.
        min_weight: Smallest weight of the mesh.
        other_color: (V, 3) float32, at confirmed vertices, else 0.
        cameras: (k, 3) of the own visit, metres, common frame.
    """

    mesh: Mesh
    state: NDArray[np.uint8]
    gap: NDArray[np.float32]
    tolerance: NDArray[np.float32]
    blur: NDArray[np.float32]
    weight: NDArray[np.float32]
    min_weight: int
    other_color: NDArray[np.float32]
    cameras: NDArray[np.float64]

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """Vertices (V, 3), metres."""
        return self.mesh.vertices.astype(np.float64)

    @cached_property
    def areas(self) -> NDArray[np.float64]:
        """Surface area (V,) per vertex, square metres."""
        a, b, c = np.moveaxis(self.points[self.mesh.faces], 1, 0)
        thirds = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
        corners = self.mesh.faces.reshape(-1)
        return np.asarray(np.bincount(corners, np.repeat(thirds, 3), len(self.points)), np.float64)

    @cached_property
    def parts(self) -> NDArray[np.intp]:
        """Component (V,) of each vertex without confirmed faces."""
        faces = self.mesh.faces[np.all(self.state[self.mesh.faces] != CONFIRMED, axis=1)]
        return components(np.concatenate([faces[:, :2], faces[:, 1:]]), len(self.state))


@dataclass(frozen=True, eq=False)
class Visit:
    """A map placed in the common frame.

    Attributes:
        T_common_map: (4, 4).
        mesh: Its surface in the common frame.
        keyframes: (k, 4, 4) poses, common frame.
        views: (n, 4, 4) poses spread over the visit, common frame.
    """

    volume: TsdfVolume
    T_common_map: NDArray[np.float64]
    mesh: Mesh
    keyframes: NDArray[np.float64]
    views: NDArray[np.float64]

    @classmethod
    def of(cls, saved: SavedMap, T_common_map: NDArray[np.float64]) -> "Visit":
        """Place a saved map at a pose (4, 4).

        Raises:
            MapError: The map is empty.
            DatasetError: The trajectory in the folder of the map is damaged.
        """
        mesh, (R, t) = saved.volume.extract_mesh(), (T_common_map[:3, :3], T_common_map[:3, 3])
        vertices = (mesh.vertices.astype(np.float64) @ R.T + t).astype(np.float32)
        moved = Mesh(vertices, mesh.faces, mesh.colors, (mesh.normals @ R.T).astype(np.float32))
        keyframes = np.array([T_common_map @ keyframe.T_world_camera for keyframe in saved.keyframes])
        path, views = saved.folder / "trajectory.txt", keyframes
        if saved.folder != Path() and path.is_file():
            views = T_common_map @ Trajectory.load(path).Ts_world_camera
        chosen = np.unique(np.linspace(0, len(views) - 1, MAX_VIEWS).astype(int))
        return cls(saved.volume, T_common_map, moved, keyframes, views[chosen])

    def sample(self, points: NDArray[np.float64]) -> MapSamples:
        """Sample the map at points (n, 3) of the common frame."""
        return sample_map(self.volume, transformed(se3.inverse(self.T_common_map), points))


def evidence(own: Visit, other: Visit) -> Evidence:
    """Compare the surface of a visit with the map of the other."""
    points = own.mesh.vertices.astype(np.float64)
    samples, band = other.sample(points), other.volume.truncation
    sdf = np.where(samples.state == OBSERVED, samples.sdf, np.where(samples.state == EMPTY, band, np.nan))
    near = KDTree(own.views[:, :3, 3]).query(points)[0]
    sigma = own.volume.sensor.sigma(near)
    voxel = max(own.volume.voxel_size, other.volume.voxel_size)
    noise = sigma * noise_share(points, sdf / sigma, band / 2 / sigma)
    tolerance = (voxel + DEVIATIONS * noise).astype(np.float32)
    state = np.full(len(points), UNKNOWN, np.uint8)
    state[sdf >= -tolerance] = CONFIRMED
    state[sdf < -tolerance] = BEHIND
    gap = np.zeros(len(points), np.float32)
    away = np.flatnonzero((sdf > tolerance) | (samples.state == EMPTY) | np.isnan(sdf))
    gap[away] = surface_tree(other.mesh.vertices).query(points[away], workers=-1)[0]
    away = away[gap[away] > tolerance[away]]
    free = ~np.isnan(sdf[away]) & (samples.weight[away] >= READINGS * other.volume.config.carve_rate)
    state[away] = np.where(free, DENIED, UNKNOWN)
    doubtful = away[~free]
    state[doubtful[times_seen_through(other, points[doubtful], tolerance[doubtful]) >= VIEWS]] = DENIED
    blur = (EDGE_PIXELS * np.maximum(near / own.volume.camera.fx, voxel) + noise).astype(np.float32)
    color = np.where((state == CONFIRMED)[:, None], samples.color, 0)
    weight = own.sample(points).weight
    cameras = own.views[:, :3, 3]
    return Evidence(own.mesh, state, gap, tolerance, blur, weight, own.volume.config.min_weight, color, cameras)


def times_seen_through(visit: Visit, points: NDArray[np.float64], margin: NDArray[np.float32]) -> NDArray[np.int64]:
    """Views (n,) that look through points (n, 3), common frame, at a surface farther than twice a margin (n,), metres,
    in the pixel and its neighbours.

    Rendered, because the map has free space per block only.
    """
    import cv2

    counts, camera = np.zeros(len(points), np.int64), visit.volume.camera
    T_map = se3.inverse(visit.T_common_map)
    for T in visit.views if len(points) else ():
        depth = visit.volume.raycast(T_map @ T, camera).depth
        nearest = cv2.erode(depth, np.ones((3, 3), np.uint8))
        local = transformed(se3.inverse(T), points)
        rows, u, v = camera.nearest_pixels(local)
        counts[rows] += nearest[v, u] > (local[:, 2] + 2 * margin)[rows]
    return counts


def components(pairs: NDArray[np.integer], count: int) -> NDArray[np.intp]:
    """Connected component (count,) of each node of a graph (n, 2)."""
    graph = csr_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def surface_tree(points: NDArray[np.floating]) -> KDTree:
    """Unbalanced tree of points (n, 3), built in a third of the time."""
    return KDTree(points, balanced_tree=False, compact_nodes=False)


def noise_share(
    points: NDArray[np.float64], distances: NDArray[np.float64], limit: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Standard deviation (n,) of distances (n,) between surfaces around points (n, 3).

    It is 1.48 times a cell's median below a limit (n,), at least the place's.
    """
    near = np.abs(np.nan_to_num(distances, nan=np.inf)) < limit
    if not near.any():
        return np.ones(len(points))
    whole = 1.4826 * float(np.median(np.abs(distances[near])))
    _, cell = np.unique(morton.encode(np.floor(points / CELL).astype(np.int64)), return_inverse=True)
    values, cells = np.abs(distances[near]), cell[near]
    order = np.lexsort((values, cells))
    counts = np.bincount(cells, minlength=cell.max() + 1)
    middle = np.cumsum(counts) - counts + counts // 2
    medians = 1.4826 * values[order][np.minimum(middle, len(order) - 1)]
    return np.where(counts >= MIN_CELL_POINTS, np.clip(medians, whole, MAX_NOISE * whole), whole)[cell]
