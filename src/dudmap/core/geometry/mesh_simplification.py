"""Mesh simplification by vertex clustering (Rossignac and Borrel 1993), which keeps texture on flat walls."""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.mesh import Mesh


def simplified(mesh: Mesh, max_triangles: int) -> Mesh:
    """The mesh, or a coarser one of at most ``max_triangles``."""
    count, cell, out = len(mesh.faces), mean_edge(mesh), mesh
    while count > max_triangles:
        # the number of triangles of a surface falls with the square of the cell size; 2 % as a margin
        cell *= 1.02 * np.sqrt(count / max_triangles)
        out = clustered(mesh, cell)
        count = len(out.faces)
    return out


def clustered(mesh: Mesh, cell: float) -> Mesh:
    """Mesh in which vertices in one cube of edge ``cell`` (metres) with normals in one octant become their mean.
    Degenerate triangles are dropped."""
    lowest = mesh.vertices.min(axis=0, initial=np.inf)
    cells = np.floor((mesh.vertices - lowest) / cell).astype(np.int64)
    octant = (mesh.normals > 0) @ np.array([4, 2, 1])
    extent = cells.max(axis=0, initial=0) + 1
    keys = np.ravel_multi_index((*cells.T, octant), (*extent, 8))
    _, cluster, counts = np.unique(keys, return_inverse=True, return_counts=True)

    def mean(values: NDArray) -> NDArray[np.float64]:
        return np.stack([np.bincount(cluster, column) for column in values.T], axis=1) / counts[:, None]

    faces = cluster.reshape(-1)[mesh.faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    turned = (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3  # smallest corner first, to find duplicates
    faces = np.take_along_axis(faces, turned, axis=1)
    faces = faces[np.lexsort(faces.T[::-1])]
    faces = faces[np.any(np.diff(faces, axis=0, prepend=-1) != 0, axis=1)]
    normals = mean(mesh.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    return Mesh(
        mean(mesh.vertices).astype(np.float32),
        faces.astype(np.int32),
        np.rint(mean(mesh.colors)).astype(np.uint8),
        normals.astype(np.float32),
    )


def mean_edge(mesh: Mesh) -> float:
    """Mean length of the first edge of the triangles, metres."""
    if len(mesh.faces) == 0:
        return 1.0
    a, b = mesh.vertices[mesh.faces[:, 0]], mesh.vertices[mesh.faces[:, 1]]
    return max(float(np.linalg.norm(a - b, axis=1).mean()), 1e-6)
