"""Meshes larger than the memory: written and read in parts."""

import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from dudmap.atomic_file import atomic_file
from dudmap.core.geometry.mesh import Mesh, joined, ply_arrays, ply_header, ply_layout
from dudmap.core.geometry.mesh_simplification import clustered, mean_edge, simplified
from dudmap.errors import MapError

FACES_AT_ONCE = 500_000


def save_pieces(pieces: Iterable[Mesh], path: str | Path) -> tuple[int, int]:
    """Write the union of separate meshes as a binary PLY file, one in memory at a time.

    Returns:
        Numbers of vertices and faces.

    Raises:
        MapError: The file cannot be written.
    """
    vertices = faces = 0
    path = Path(path)
    try:
        with tempfile.TemporaryFile(dir=path.parent) as above, tempfile.TemporaryFile(dir=path.parent) as below:
            for piece in pieces:
                vertex, face = ply_arrays(piece, first=vertices)
                above.write(vertex.tobytes())
                below.write(face.tobytes())
                vertices, faces = vertices + len(vertex), faces + len(face)
            with atomic_file(path) as file:
                file.write(ply_header(vertices, faces).encode("ascii"))
                for part in (above, below):
                    part.seek(0)
                    shutil.copyfileobj(part, file, 1 << 20)
    except OSError as error:
        raise MapError(f"cannot write the mesh to {path}: {error}") from error
    return vertices, faces


def load_simplified(path: str | Path, max_triangles: int) -> Mesh:
    """Read a PLY file of this package in parts, as a mesh of at most ``max_triangles``.

    Vertex clustering reduces each part to four times its share of triangles, then their union.

    Raises:
        MapError: The file is missing, or not a PLY file of this package.
    """
    path = Path(path)
    share, parts = 1.0, []
    for piece, count in _read_pieces(path):
        share = min(1.0, 4 * max_triangles / count)
        parts.append(simplified(piece, max(int(share * len(piece.faces)), 1)))
    whole = joined(parts)
    if share < 1 and len(whole.faces):  # the parts share no vertices: merge them first
        whole = clustered(whole, mean_edge(whole) / 2)
    return simplified(whole, max_triangles)


def _read_pieces(path: Path) -> Iterator[tuple[Mesh, int]]:
    """Parts of at most ``FACES_AT_ONCE`` faces with their range of vertices, and the number of all faces."""
    try:
        layout = ply_layout(path)
    except OSError as error:
        raise MapError(f"cannot read the mesh {path}: {error}") from error
    if layout is None:
        raise MapError(f"{path} is no mesh file of this program")
    vertices, faces = layout
    for start in range(0, len(faces), FACES_AT_ONCE):
        indices = np.array(faces["indices"][start : start + FACES_AT_ONCE])
        first, last = int(indices.min()), int(indices.max())
        used = np.array(vertices[first : last + 1])
        yield Mesh(used["xyz"], indices - np.int32(first), used["rgb"], used["normal"]), len(faces)
