"""Parts of a mesh, closed holes and fewer triangles.

A wrong option raises a ``ConfigError``, an empty result a ``MapError``.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.mesh import Mesh, component_of_vertices, with_faces
from dudmap.errors import ConfigError, MapError
from dudmap.extras import extra
from dudmap.io.exporting.run_content import SPECK, Box, ExportOptions

PART = 65536


def edited(mesh: Mesh, options: ExportOptions) -> Mesh:
    """Mesh after crop, pieces, holes and triangles, in this order."""
    if options.crop is not None:
        mesh = cropped(mesh, options.crop)
    mesh = without_small_pieces(mesh, options.drop_pieces_below)
    if options.fill_holes is not None:
        mesh = with_filled_holes(mesh, options.fill_holes)
    if options.max_triangles is not None:
        mesh = decimated(mesh, options.max_triangles)
    if len(mesh.faces) == 0:
        raise MapError("no triangle of the mesh is left; choose a larger --crop or smaller --drop-pieces-below")
    return mesh


def cropped(mesh: Mesh, box: Box) -> Mesh:
    """The triangles whose three corners lie in a box."""
    low, high = np.array(box[:3]), np.array(box[3:])
    if not np.all(low < high):
        raise ConfigError(f"the box of --crop is empty: {box}; expected x0,y0,z0,x1,y1,z1 with x0 < x1 and so on")
    inside = np.all((mesh.vertices >= low) & (mesh.vertices <= high), axis=1)
    return with_faces(mesh, np.all(inside[mesh.faces], axis=1))


def without_small_pieces(mesh: Mesh, area: float = SPECK) -> Mesh:
    """Mesh without connected pieces below ``area``, square metres."""
    piece = component_of_vertices(mesh)[mesh.faces[:, 0]]
    kept = np.bincount(piece, face_areas(mesh))[piece] >= area
    return mesh if kept.all() else with_faces(mesh, kept)


def with_filled_holes(mesh: Mesh, longest: float) -> Mesh:
    """Mesh whose holes with a border of at most ``longest`` metres are closed."""
    loops = [loop for loop in border_loops(mesh.faces) if _length(mesh.vertices[loop]) <= longest]
    if not loops:
        return mesh
    vertices, normals, colors, faces = [mesh.vertices], [mesh.normals], [mesh.colors], [mesh.faces]
    for number, loop in enumerate(loops, start=len(mesh.vertices)):
        normal = mesh.normals[loop].mean(axis=0, dtype=np.float64)
        vertices.append(mesh.vertices[loop].mean(axis=0, keepdims=True))
        normals.append((normal / max(np.linalg.norm(normal), 1e-9)).astype(np.float32)[None])
        colors.append(np.rint(mesh.colors[loop].mean(axis=0, keepdims=True)).astype(np.uint8))
        faces.append(np.stack([np.roll(loop, -1), loop, np.full(len(loop), number)], axis=1).astype(np.int32))
    return Mesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(colors), np.concatenate(normals))


def border_loops(faces: NDArray[np.int32]) -> list[NDArray[np.int32]]:
    """Closed borders of the surface, as vertices in the direction of the triangles' edges, except borders that touch
    themselves."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    size = int(edges.max(initial=0)) + 1
    keys = edges[:, 0] * size + edges[:, 1]
    border = edges[~np.isin(keys, edges[:, 1] * size + edges[:, 0])]
    starts, counts = np.unique(border[:, 0], return_counts=True)
    following = dict(border[np.isin(border[:, 0], starts[counts == 1])].tolist())
    loops = []
    while following:
        first, at = following.popitem()
        loop = [first]
        while at != first and at in following:
            loop.append(at)
            at = following.pop(at)
        if at == first and len(loop) > 2:
            loops.append(np.array(loop, np.int32))
    return sorted(loops, key=lambda loop: int(loop[0]))


def decimated(mesh: Mesh, max_triangles: int) -> Mesh:
    """Mesh with at most ``max_triangles`` triangles, by quadric edge collapse (Garland and Heckbert 1997).

    Vertices take colour and normal of the nearest given one.
    """
    if len(mesh.faces) <= max_triangles:
        return mesh
    with extra("export", "--max-triangles"):
        from fast_simplification import simplify
    from scipy.spatial import KDTree

    vertices, faces, *_ = simplify(mesh.vertices.astype(np.float64), mesh.faces, target_count=max_triangles)
    _, nearest = KDTree(mesh.vertices).query(vertices)
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32), mesh.colors[nearest], mesh.normals[nearest])


def rotated(mesh: Mesh, R: NDArray[np.float64]) -> Mesh:
    """Mesh in the axes to which ``R`` (3, 3) leads."""
    turned = R.T.astype(np.float32)
    return replace(mesh, vertices=mesh.vertices @ turned, normals=mesh.normals @ turned)


def face_areas(mesh: Mesh) -> NDArray[np.float64]:
    """Surface (F,) of each triangle, square metres."""
    parts = (mesh.faces[first : first + PART] for first in range(0, max(len(mesh.faces), 1), PART))
    return np.concatenate([np.linalg.norm(face_vectors(replace(mesh, faces=part)), axis=1) for part in parts])


def face_vectors(mesh: Mesh) -> NDArray[np.float64]:
    """Normal (F, 3) of each triangle, of the length of its surface, square metres."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return np.cross(b - a, c - a) / 2


def _length(points: NDArray[np.float32]) -> float:
    return float(np.linalg.norm(points - np.roll(points, -1, axis=0), axis=1).sum())
