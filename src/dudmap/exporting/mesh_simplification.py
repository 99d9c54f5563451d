"""Coarser meshes for viewers: vertices are merged by the cells of a grid (Rossignac and Borrel 1993)."""

import numpy as np

from dudmap.geometry.mesh import Mesh

FIRST_CELL = 0.02
"""Edge of the finest cells that are tried, metres."""


def simplified(mesh: Mesh, max_triangles: int) -> Mesh:
    """Mesh with at most so many triangles; cells grow by a factor of the square root of two until that is reached.

    Each cell keeps the mean of its vertices; triangles of which two corners fall into one cell are dropped.
    """
    cell, out = FIRST_CELL, mesh
    while len(out.faces) > max_triangles:
        out = _clustered(mesh, cell)
        cell *= np.sqrt(2)
    return out


def _clustered(mesh: Mesh, cell: float) -> Mesh:
    """Mesh whose vertices are those of cubes of an edge in metres."""
    keys = np.floor(mesh.vertices / cell).astype(np.int64)
    _, number, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    number = number.reshape(-1)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(number, values[:, axis]) for axis in range(3)], axis=1) / counts[:, None]

    faces = number[mesh.faces]
    kept = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    normals = mean(mesh.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    return Mesh(
        mean(mesh.vertices).astype(np.float32),
        np.unique(faces[kept], axis=0).astype(np.int32),
        np.rint(mean(mesh.colors)).astype(np.uint8),
        normals.astype(np.float32),
    )
