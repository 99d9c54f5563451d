"""Level surfaces and floor of a map, and axes that stand on it. A zero direction raises a ``ConfigError``."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.mesh import Mesh
from dudmap.errors import ConfigError
from dudmap.io.exporting.mesh_editing import face_vectors

CONE = np.cos(np.radians(45))
"""Cosine of the largest angle between floor normal and mean up direction of the cameras."""
PARALLEL = np.cos(np.radians(5))
"""Cosine of the largest angle within one direction: noise at 1 cm voxels."""
CANDIDATES = 500
LEAST_SHARE = 0.02
"""Smallest share of the surface that faces up."""
LAYER = 0.05
"""Half the thickness of a layer, metres."""
FLOOR_SHARE = 0.1
"""Smallest share of upward surface in the layer of the floor, the lowest such layer."""


class Floor(NamedTuple):
    """The floor of a map.

    Attributes:
        up: (3,) unit vector against gravity, world frame.
        height: Of the floor along ``up``, metres.
    """

    up: NDArray[np.float64]
    height: float


def level_normal(mesh: Mesh, held: NDArray[np.float64], cone: float = CONE) -> NDArray[np.float64] | None:
    """Most frequent surface normal (3,) near a direction (3,), None if none is frequent; ``cone``: cosine of the
    largest angle."""
    vectors = face_vectors(mesh)
    areas = np.maximum(np.linalg.norm(vectors, axis=1), 1e-12)
    normals = vectors / areas[:, None]
    near = np.flatnonzero(normals @ held > cone)
    if len(near) == 0:
        return None
    normals, sizes = normals[near], areas[near]
    sums = np.cumsum(sizes)
    steps = np.searchsorted(sums, np.linspace(0, sums[-1], CANDIDATES, endpoint=False))
    tried = normals[np.minimum(steps, len(normals) - 1)]
    shares = [float(sizes[normals @ direction > PARALLEL].sum()) for direction in tried]
    best = tried[int(np.argmax(shares))]
    if max(shares) < LEAST_SHARE * areas.sum():
        return None
    for _ in range(3):
        around = normals @ best > PARALLEL
        best = unit((normals[around] * sizes[around, None]).sum(axis=0))
    return best


def floor_height(mesh: Mesh, up: NDArray[np.float64]) -> float | None:
    """Height of the floor along ``up`` (3,), metres; None if no surface faces up."""
    vectors = face_vectors(mesh)
    areas = np.maximum(np.linalg.norm(vectors, axis=1), 1e-12)
    level = vectors @ up > np.cos(np.radians(15)) * areas
    if not level.any():
        return None
    heights, sizes = mesh.vertices[mesh.faces[level]].mean(axis=1) @ up, areas[level]
    order = np.argsort(heights)
    heights, sums = heights[order], np.concatenate([[0.0], np.cumsum(sizes[order])])
    layer = sums[np.searchsorted(heights, heights + LAYER, "right")] - sums[np.searchsorted(heights, heights - LAYER)]
    lowest = heights[np.argmax(layer >= FLOOR_SHARE * sums[-1])]
    inside = (heights >= lowest - LAYER) & (heights <= lowest + 2 * LAYER)
    return float(np.median(heights[inside]))


def fitted(mesh: Mesh, floor: Floor) -> Floor:
    """Least-squares plane through the floor's vertices, in ever thinner layers, which exclude objects."""
    for half in (2 * LAYER, LAYER, LAYER / 2, LAYER / 2):
        facing = mesh.normals @ floor.up > np.cos(np.radians(15))
        points = mesh.vertices[facing & (np.abs(mesh.vertices @ floor.up - floor.height) < half)].astype(np.float64)
        if len(points) < 10:
            return floor
        centre = points.mean(axis=0)
        normal = np.linalg.eigh((points - centre).T @ (points - centre))[1][:, 0]
        normal = normal if normal @ floor.up > 0 else -normal
        floor = Floor(normal, float(centre @ normal))
    return floor


def y_up(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation (3, 3) from the world to y up and the first view towards -z."""
    back = -_across(up)
    return np.stack([np.cross(up, back), up, back])


def z_up(floor: Floor) -> NDArray[np.float64]:
    """Motion (4, 4) from the world to axes on the floor below the first camera: z up, x along its view (REP 103)."""
    forward = _across(floor.up)
    T = np.eye(4)
    T[:3, :3] = np.stack([forward, np.cross(floor.up, forward), floor.up])
    T[2, 3] = -floor.height
    return T


def _across(up: NDArray[np.float64]) -> NDArray[np.float64]:
    forward = np.array([0.0, 0.0, 1.0]) - up[2] * up
    if np.linalg.norm(forward) < 0.1:
        forward = np.array([1.0, 0.0, 0.0]) - up[0] * up
    return unit(forward)


def unit(vector: tuple[float, ...] | NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit vector."""
    values = np.asarray(vector, np.float64)
    length = float(np.linalg.norm(values))
    if not np.isfinite(length) or length < 1e-9:
        raise ConfigError(f"found the direction {tuple(vector)}; expected three numbers that are not all zero")
    return values / length
