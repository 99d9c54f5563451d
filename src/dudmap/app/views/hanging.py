"""Small pieces that hang in the air: remains of dynamic objects."""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.mesh import Mesh, component_of_vertices
from dudmap.core.map.volume import TsdfVolume
from dudmap.io.exporting.mesh_editing import face_areas

LARGEST = 25e-4
"""Largest removed piece, square metres; larger ones may be lamps."""
GAP = 0.02
"""Distance from any larger piece, metres, beyond cuts of a voxel or two."""


def remove_hanging_pieces(volume: TsdfVolume, mesh: Mesh) -> None:
    """Make voxels around hanging pieces unknown, in a map with one voxel size."""
    vertices = mesh.vertices[hanging(mesh)]
    offsets = np.stack(np.meshgrid(*3 * [np.arange(-1, 3)], indexing="ij"), axis=-1).reshape(-1, 1, 3)
    voxels = np.unique((np.floor(vertices / volume.voxel_size).astype(np.int32) + offsets).reshape(-1, 3), axis=0)
    slots = volume.blocks.slots_at(voxels >> 3)
    x, y, z = (voxels[slots >= 0] & 7).T
    changed, row = np.unique(slots[slots >= 0], return_inverse=True)
    geometry = volume.blocks.geometry[changed]
    geometry[row, 64 * x + 8 * y + z] = 0
    volume.blocks.write(changed, geometry, volume.blocks.colors[changed])


def hanging(mesh: Mesh) -> NDArray[np.bool_]:
    """Vertices (V,) of the pieces that hang in the air."""
    from scipy.spatial import KDTree

    piece = component_of_vertices(mesh)
    area = np.bincount(piece[mesh.faces[:, 0]], face_areas(mesh), minlength=piece.max(initial=0) + 1)
    small = area[piece] < LARGEST
    if small.all() or not small.any():
        return np.zeros_like(small)
    distance = np.full(len(area), np.inf)
    found, _ = KDTree(mesh.vertices[~small]).query(mesh.vertices[small])
    np.minimum.at(distance, piece[small], found)
    return small & (distance[piece] > GAP)
