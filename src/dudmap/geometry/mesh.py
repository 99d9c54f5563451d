"""Triangle mesh with colours and normals."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import MapError

FORMATS = (".ply", ".obj", ".glb", ".stl")


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
                self._save_ply(path)
            else:
                self._as_trimesh().export(path)
        except OSError as error:
            raise MapError(f"cannot write the mesh to {path}: {error}") from error

    def _as_trimesh(self):  # noqa: ANN202 - trimesh is imported here: the import takes 0.6 s
        import trimesh

        return trimesh.Trimesh(
            self.vertices, self.faces, vertex_normals=self.normals, vertex_colors=self.colors, process=False
        )

    def _save_ply(self, path: Path) -> None:
        """Binary PLY with float32 normals; trimesh's exporter is three times slower on a million faces."""
        vertex = np.empty(
            len(self.vertices),
            dtype=[("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)],
        )
        vertex["xyz"], vertex["normal"], vertex["rgb"] = self.vertices, self.normals, self.colors
        face = np.empty(len(self.faces), dtype=[("count", "u1"), ("indices", "<i4", 3)])
        face["count"], face["indices"] = 3, self.faces
        properties = [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
        properties += [f"property uchar {name}" for name in ("red", "green", "blue")]
        header = ["ply", "format binary_little_endian 1.0", "comment dudmap", f"element vertex {len(vertex)}"]
        header += [*properties, f"element face {len(face)}", "property list uchar int vertex_indices", "end_header"]
        with path.open("wb") as file:
            file.write(("\n".join(header) + "\n").encode("ascii"))
            file.write(vertex.tobytes())
            file.write(face.tobytes())

    @classmethod
    def load(cls, path: str | Path) -> "Mesh":
        """Read a triangle mesh or point cloud file (PLY, OBJ, GLB, STL); a cloud has no faces.

        Raises:
            MapError: The file is missing, unreadable or empty.
        """
        import trimesh
        from trimesh.visual import ColorVisuals, TextureVisuals

        path = Path(path)
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
