"""Triangle mesh with colours and normals."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import atomic_file, atomic_path
from dudmap.core.arrays import copied
from dudmap.errors import MapError
from dudmap.input_files import describe, foreign, open_plain

FORMATS = (".ply", ".obj", ".glb", ".stl")
_PLY_VERTEX = np.dtype([("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
_PLY_FACE = np.dtype([("count", "u1"), ("indices", "<i4", 3)])


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles over shared vertices.

    Attributes:
        vertices: (V, 3) float32, metres, world frame.
        faces: (F, 3) int32, counter-clockwise seen from free space.
        colors: (V, 3) uint8, red green blue.
        normals: (V, 3) float32, unit length, pointing to free space.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    colors: NDArray[np.uint8]
    normals: NDArray[np.float32]

    def __post_init__(self) -> None:
        for name in ("vertices", "faces", "colors", "normals"):
            object.__setattr__(self, name, copied(getattr(self, name), f"{name} of a mesh", dtype=None))

    def __repr__(self) -> str:
        return f"Mesh({len(self.vertices)} vertices, {len(self.faces)} triangles)"

    def area(self) -> float:
        """Surface area in square metres."""
        a, b, c = (self.vertices[self.faces[:, k]].astype(np.float64) for k in range(3))
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)

    def save(self, path: str | Path) -> None:
        """Write the mesh; the file's ending selects the format: .ply (binary), .obj, .glb or .stl.

        Raises:
            MapError: The ending is none of these, or the file cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() not in FORMATS:
            raise MapError(f"cannot write a mesh as {path.name!r}; the ending must be one of {', '.join(FORMATS)}")
        try:
            if path.suffix.lower() == ".ply":  # trimesh's exporter is three times slower on a million faces
                vertex, face = ply_arrays(self)
                with atomic_file(path) as file:
                    file.write(ply_header(len(vertex), len(face)).encode("ascii"))
                    file.write(vertex.tobytes())
                    file.write(face.tobytes())
            else:
                import trimesh  # takes 0.6 s

                mesh = trimesh.Trimesh(
                    self.vertices, self.faces, vertex_normals=self.normals, vertex_colors=self.colors, process=False
                )
                with atomic_path(path) as temporary:
                    mesh.export(temporary)
        except OSError as error:
            raise MapError(f"cannot write the mesh to {path}: {error}") from error

    @classmethod
    def _load_ply(cls, path: Path) -> "Mesh | None":
        """Read a file that ``save`` wrote, else None; faster than trimesh."""
        layout = ply_layout(path)
        if layout is None:
            return None
        vertex, face = layout
        if np.any(face["indices"] < 0) or np.any(face["indices"] >= len(vertex)):
            raise MapError(f"the mesh {path} is cut off or damaged")
        arrays = vertex["xyz"], face["indices"], vertex["rgb"], vertex["normal"]
        return cls(*(np.ascontiguousarray(array) for array in arrays))

    @classmethod
    def load(cls, path: str | Path) -> "Mesh":
        """Read a triangle mesh or point cloud file (PLY, OBJ, GLB, STL); a cloud has no faces.

        Raises:
            MapError: The file is missing, unreadable or empty.
        """
        path = Path(path)
        try:
            own = cls._load_ply(path) if path.suffix.lower() == ".ply" else None
        except OSError as error:
            raise MapError(f"cannot read the mesh {path}: {describe(error)}") from error
        if own is not None and len(own.vertices) > 0:
            return own
        if path.suffix.lower() not in FORMATS:  # other formats may be archives or refer to further files
            raise MapError(f"cannot read the mesh {path}; the ending must be one of {', '.join(FORMATS)}")
        with foreign(MapError, f"the mesh {path}"):
            return cls._load_foreign(path)

    @classmethod
    def _load_foreign(cls, path: Path) -> "Mesh":
        """Read another program's file without materials, which refer to further files."""
        import trimesh
        from trimesh.visual import ColorVisuals, TextureVisuals

        options: dict[str, Any] = {"skip_materials": True} if path.suffix.lower() == ".obj" else {}
        with open_plain(path) as file:
            loaded = trimesh.load(file, file_type=path.suffix.lower()[1:], process=False, force=None, **options)
        if isinstance(loaded, trimesh.Scene):
            loaded = loaded.to_geometry()
        vertices = np.asarray(getattr(loaded, "vertices", np.empty((0, 3))), dtype=np.float32)
        if len(vertices) == 0:
            raise MapError(f"the mesh {path} holds no vertices")
        faces = np.asarray(getattr(loaded, "faces", np.empty((0, 3))), dtype=np.int32).reshape(-1, 3)
        if vertices.shape != (len(vertices), 3) or (len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices)):
            raise MapError(f"the mesh {path} is damaged: vertices without three coordinates, or faces without vertices")
        if isinstance(loaded, trimesh.Trimesh):
            visual = loaded.visual.to_color() if isinstance(loaded.visual, TextureVisuals) else loaded.visual
            assert isinstance(visual, ColorVisuals)
            colors = np.asarray(visual.vertex_colors, dtype=np.uint8)[:, :3]
            normals = np.asarray(loaded.vertex_normals, dtype=np.float32)
        else:
            colors = np.asarray(getattr(loaded, "colors", np.empty((0, 4))), dtype=np.uint8)[:, :3]
            normals = np.zeros_like(vertices)
        if len(colors) != len(vertices):
            colors = np.full((len(vertices), 3), 128, dtype=np.uint8)
        return cls(vertices, faces, colors, normals)


def joined(parts: Sequence[Mesh]) -> Mesh:
    """Concatenate meshes without sharing vertices between them."""
    if not parts:
        empty = np.zeros((0, 3), dtype=np.float32)
        return Mesh(empty, np.zeros((0, 3), dtype=np.int32), np.zeros((0, 3), dtype=np.uint8), empty)
    counts = np.array([len(part.vertices) for part in parts])
    first = (np.cumsum(counts) - counts).astype(np.int32)
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, first, strict=True)]),
        np.concatenate([part.colors for part in parts]),
        np.concatenate([part.normals for part in parts]),
    )


def component_of_vertices(mesh: Mesh) -> NDArray[np.int32]:
    """Connected component (V,) of each vertex."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    a, b, c = mesh.faces.T
    pairs = np.concatenate([a, b]), np.concatenate([b, c])
    n = len(mesh.vertices)
    return connected_components(coo_array((np.ones(len(pairs[0]), bool), pairs), shape=(n, n)), directed=False)[1]


def with_faces(mesh: Mesh, kept: NDArray[np.bool_]) -> Mesh:
    """Mesh of some of the triangles (F,) and the vertices that they use."""
    faces = mesh.faces[kept]
    used = np.zeros(len(mesh.vertices), bool)
    used[faces] = True
    number = np.cumsum(used, dtype=np.int32) - 1
    return Mesh(mesh.vertices[used], number[faces].astype(np.int32), mesh.colors[used], mesh.normals[used])


def ply_arrays(mesh: Mesh, first: int = 0) -> tuple[NDArray, NDArray]:
    """Vertices and faces in the layout of a PLY file; vertices begin at number ``first``."""
    vertex = np.empty(len(mesh.vertices), _PLY_VERTEX)
    vertex["xyz"], vertex["normal"], vertex["rgb"] = mesh.vertices, mesh.normals, mesh.colors
    face = np.empty(len(mesh.faces), _PLY_FACE)
    face["count"], face["indices"] = 3, mesh.faces + np.int32(first)
    return vertex, face


def ply_layout(path: Path) -> tuple[NDArray, NDArray] | None:
    """Vertices and faces of a PLY file of ``Mesh.save``, mapped into memory; None for any other file.

    Raises:
        MapError: The file is cut off.
        OSError: It cannot be read.
    """
    with open_plain(path) as file:
        head = file.read(1024)
    counts = [int(count) for count in re.findall(rb"element (?:vertex|face) (\d+)", head)[:2]]
    vertices, faces = (*counts, 0, 0)[:2]
    header = ply_header(vertices, faces).encode("ascii")
    if not counts or not head.startswith(header):
        return None
    end = len(header) + vertices * _PLY_VERTEX.itemsize
    if path.stat().st_size < end + faces * _PLY_FACE.itemsize:
        raise MapError(f"the mesh {path} is cut off or damaged")

    def mapped(kind: np.dtype, offset: int, count: int) -> NDArray:
        return np.memmap(path, kind, "r", offset, count) if count else np.empty(0, kind)

    return mapped(_PLY_VERTEX, len(header), vertices), mapped(_PLY_FACE, end, faces)


def ply_header(vertices: int, faces: int) -> str:
    """Header of a binary PLY file of ``Mesh.save``; a point cloud has no element ``face``."""
    lines = ["ply", "format binary_little_endian 1.0", "comment dudmap", f"element vertex {vertices}"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    if faces:
        lines += [f"element face {faces}", "property list uchar int vertex_indices"]
    return "\n".join([*lines, "end_header"]) + "\n"
