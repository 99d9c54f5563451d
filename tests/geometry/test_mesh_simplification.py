"""Coarser meshes keep to the surface, its colours, its sides and the number asked for."""

import numpy as np
import pytest

from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.mesh_simplification import clustered, simplified


def sheet(n=60, z=0.0, up=1.0):
    """Plane z of 1 m x 1 m with 2 (n - 1)^2 triangles that faces up or down; red grows with x."""
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij")
    vertices = np.stack([x, y, np.full_like(x, z)], axis=-1).reshape(-1, 3).astype(np.float32)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    faces = np.concatenate([
        np.stack([corner, corner + n, corner + 1], axis=1), np.stack([corner + 1, corner + n, corner + n + 1], axis=1),
    ])  # fmt: skip
    faces = faces if up > 0 else faces[:, ::-1]
    colors = np.zeros((n * n, 3), np.uint8)
    colors[:, 0] = np.rint(200 * vertices[:, 0])
    normals = np.tile(np.array([0, 0, up], np.float32), (n * n, 1))
    return Mesh(vertices, faces.astype(np.int32), colors, normals)


@pytest.mark.parametrize("wanted", [3000, 1000, 100])
def test_the_number_is_kept_and_nearly_used(wanted):
    coarse = simplified(sheet(), wanted)
    assert wanted / 3 < len(coarse.faces) <= wanted
    assert len(np.unique(np.sort(coarse.faces, axis=1), axis=0)) == len(coarse.faces)


def test_a_plane_stays_one_with_its_colours_and_orientation():
    coarse = simplified(sheet(z=0.3), 500)
    np.testing.assert_allclose(coarse.vertices[:, 2], 0.3, atol=1e-6)
    np.testing.assert_allclose(coarse.colors[:, 0], 200 * coarse.vertices[:, 0], atol=1)
    a, b, c = (coarse.vertices[coarse.faces[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()
    assert 0.85 < coarse.area() <= 1


def test_the_two_sides_of_a_thin_wall_stay_apart():
    front, back = sheet(z=0.001), sheet(z=0.0, up=-1)
    both = Mesh(
        np.concatenate([front.vertices, back.vertices]),
        np.concatenate([front.faces, back.faces + len(front.vertices)]),
        np.concatenate([front.colors, back.colors]),
        np.concatenate([front.normals, back.normals]),
    )
    coarse = clustered(both, 0.1)
    assert np.isclose(coarse.vertices[:, 2, None], [0, 0.001], atol=1e-6).any(axis=1).all()
    assert set(np.sign(coarse.normals[:, 2])) == {-1, 1}


def test_a_small_mesh_is_left_alone():
    mesh = sheet(5)
    assert simplified(mesh, 32) is mesh
