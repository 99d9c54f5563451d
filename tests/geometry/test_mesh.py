"""Mesh files: what is written is read again."""

import numpy as np
import pytest

from dudmap.core.geometry.mesh import Mesh
from dudmap.errors import MapError


def tetrahedron() -> Mesh:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    normals = vertices - np.float32(0.25)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 8, 7]], np.uint8)
    return Mesh(vertices, faces, colors, normals)


def test_area_is_that_of_the_triangles():
    assert tetrahedron().area() == pytest.approx(1.5 + np.sqrt(3) / 2)


def test_ply_keeps_everything(tmp_path):
    mesh = tetrahedron()
    mesh.save(tmp_path / "mesh.ply")
    loaded = Mesh.load(tmp_path / "mesh.ply")
    assert np.array_equal(loaded.vertices, mesh.vertices)
    assert np.array_equal(loaded.faces, mesh.faces)
    assert np.array_equal(loaded.colors, mesh.colors)
    assert np.allclose(loaded.normals, mesh.normals, atol=1e-6)


@pytest.mark.parametrize("ending", [".obj", ".glb", ".stl", ".PLY"])
def test_every_format_keeps_the_surface(tmp_path, ending):
    tetrahedron().save(tmp_path / f"mesh{ending}")
    loaded = Mesh.load(tmp_path / f"mesh{ending}")
    assert len(loaded.faces) == 4
    assert loaded.area() == pytest.approx(tetrahedron().area(), rel=1e-5)


def test_what_cannot_be_written_or_read_is_said(tmp_path):
    with pytest.raises(MapError, match="ending must be one of"):
        tetrahedron().save(tmp_path / "mesh.xyz")
    with pytest.raises(MapError, match="cannot write"):
        tetrahedron().save(tmp_path / "missing" / "mesh.ply")
    with pytest.raises(MapError, match="cannot read"):
        Mesh.load(tmp_path / "none.ply")
