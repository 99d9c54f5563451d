"""Triangle mesh with colours and normals."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import atomic_file, atomic_path
from dudmap.errors import MapError

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

    def area(self) -> float:
        """Surface in square metres."""
        a, b, c = (self.vertices[self.faces[:, k]].astype(np.float64) for k in range(3))
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)

    def save(self, path: str | Path) -> None:
        """Write the mesh in the format that the file's ending names: .ply (binary), .obj, .glb or .stl.

        Raises:
            MapError: The ending is none of these, or the file cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() not in FORMATS:
            raise MapError(f"cannot write a mesh as {path.name!r}; the ending must be one of {', '.join(FORMATS)}")
        try:
            if path.suffix.lower() == ".ply":
                with atomic_file(path) as file:
                    self._save_ply(file)
            else:
                with atomic_path(path) as temporary:
                    self._as_trimesh().export(temporary)
        except OSError as error:
            raise MapError(f"cannot write the mesh to {path}: {error}") from error

    def _as_trimesh(self):  # noqa: ANN202 - trimesh is imported here: the import takes 0.6 s
        import trimesh

        return trimesh.Trimesh(
            self.vertices, self.faces, vertex_normals=self.normals, vertex_colors=self.colors, process=False
        )

    def _save_ply(self, file: IO[bytes]) -> None:
        """Binary PLY with float32 normals; trimesh's exporter is three times slower on a million faces."""
        vertex = np.empty(len(self.vertices), _PLY_VERTEX)
        vertex["xyz"], vertex["normal"], vertex["rgb"] = self.vertices, self.normals, self.colors
        face = np.empty(len(self.faces), _PLY_FACE)
        face["count"], face["indices"] = 3, self.faces
        file.write(_ply_header(len(vertex), len(face)).encode("ascii"))
        file.write(vertex.tobytes())
        file.write(face.tobytes())

    @classmethod
    def _load_ply(cls, path: Path) -> "Mesh | None":
        """Read a file that ``save`` wrote, None for any other: trimesh takes 2 s for a million triangles."""
        with path.open("rb") as file:
            head = file.read(1024)
            counts = re.findall(rb"element (?:vertex|face) (\d+)", head)
            header = _ply_header(*(int(count) for count in [*counts, 0][:2])).encode("ascii") if counts else b""
            if not header or not head.startswith(header):
                return None
            file.seek(len(header))
            vertex = np.fromfile(file, _PLY_VERTEX, int(counts[0]))
            face = np.fromfile(file, _PLY_FACE, int(counts[1]) if len(counts) > 1 else 0)
        whole = len(vertex) == int(counts[0]) and (len(counts) == 1 or len(face) == int(counts[1]))
        if not whole or np.any(face["indices"] < 0) or np.any(face["indices"] >= len(vertex)):
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
            raise MapError(f"cannot read the mesh {path}: {error}") from error
        if own is not None and len(own.vertices) > 0:
            return own
        import trimesh
        from trimesh.visual import ColorVisuals, TextureVisuals

        try:
            loaded = trimesh.load(path, process=False, force=None)
        except (OSError, ValueError, NotImplementedError, LookupError, TypeError) as error:  # trimesh on broken headers
            raise MapError(f"cannot read the mesh {path}: {error}") from error
        if isinstance(loaded, trimesh.Scene):
            loaded = loaded.to_geometry()
        vertices = np.asarray(getattr(loaded, "vertices", np.empty((0, 3))), dtype=np.float32)
        if len(vertices) == 0:
            raise MapError(f"the mesh {path} holds no vertices")
        faces = np.asarray(getattr(loaded, "faces", np.empty((0, 3))), dtype=np.int32).reshape(-1, 3)
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


def _ply_header(vertices: int, faces: int) -> str:
    """Header of a binary PLY file as ``Mesh.save`` writes it; a point cloud has no element ``face``."""
    lines = ["ply", "format binary_little_endian 1.0", "comment dudmap", f"element vertex {vertices}"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    if faces:
        lines += [f"element face {faces}", "property list uchar int vertex_indices"]
    return "\n".join([*lines, "end_header"]) + "\n"
