"""Meshes across several voxel sizes: without gaps, on the surface, with the edges of a box in their place."""

from collections import Counter

import numpy as np
import pytest
from scipy.spatial import KDTree

from dudmap.core.geometry import se3
from dudmap.core.geometry.mesh import Mesh, joined
from dudmap.core.map.incremental_mesh import IncrementalMesh
from dudmap.evaluation.surface import point_triangle_distances
from refined_maps import CAMERA, analytic_map, box, sphere
from triangles import triangles

VOXEL = 0.02
LOW, HIGH = (-2,) * 3, (2,) * 3
ROTATION = se3.exp(np.array([0, 0, 0, 0.4, -0.7, 0.5]))[:3, :3]
SHAPES = {
    "sphere": sphere((0.01, 0.013, -0.02), 0.21),
    "box": box((0.011, 0.013, -0.007), (0.19, 0.16, 0.15)),
    "turned box": box((0.011, 0.013, -0.007), (0.15, 0.13, 0.12), ROTATION),
}


def open_edges(faces):
    """Directed edges that are not run through as often in the other direction, with the vertices they join."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    count = Counter(map(tuple, pairs.tolist()))
    return [edge for edge, n in count.items() if count[edge[::-1]] != n]


def mixed(level, centres):
    """Half of the octants, so that all levels meet everywhere."""
    return np.random.default_rng(level).random(len(centres)) < 0.5


def distances_to(mesh, points):
    """Distances (n,) of points (n, 3) to the nearest of the triangles whose centres are near."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    near = KDTree(corners.mean(axis=1)).query(points, k=16)[1]
    found = point_triangle_distances(np.repeat(points, 16, axis=0), corners[near.ravel()])
    return found.reshape(-1, 16).min(axis=1)


def welded(mesh):
    """The mesh with one vertex at each place."""
    vertices, first, number = np.unique(mesh.vertices, axis=0, return_index=True, return_inverse=True)
    faces = number.reshape(-1)[mesh.faces].astype(np.int32)
    return Mesh(vertices, faces, mesh.colors[first], mesh.normals[first])


def gaps(mesh):
    """Distances (n,) of the middle of each open edge of a welded mesh to the nearest triangle without this edge."""
    edges = np.array(open_edges(mesh.faces)).reshape(-1, 2)
    middles = mesh.vertices[edges].mean(axis=1).astype(np.float64)
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    near = KDTree(corners.mean(axis=1)).query(middles, k=80)[1]
    distances = point_triangle_distances(np.repeat(middles, 80, axis=0), corners[near.ravel()]).reshape(-1, 80)
    own = (mesh.faces[near][..., None] == edges[:, None, None]).any(axis=2).all(axis=2)
    return np.where(own, np.inf, distances).min(axis=1)


@pytest.mark.parametrize("levels", [1, 2])
@pytest.mark.parametrize("shape", SHAPES)
def test_the_mesh_has_no_gaps_where_voxel_sizes_meet(shape, levels):
    distance = SHAPES[shape]
    volume = analytic_map(distance, LOW, HIGH, VOXEL, levels, mixed)
    assert all(level.blocks.num_voxel_blocks > 20 for level in volume.levels)
    mesh = welded(volume.extract_mesh())
    found = gaps(mesh)
    assert len(found) > 100  # the levels share the vertices on the edges of larger cells, not those in their faces
    assert found.mean() < 0.006 * VOXEL
    assert found.max() < (0.01 if (shape, levels) == ("sphere", 1) else 0.25) * VOXEL
    assert np.abs(distance(mesh.vertices.astype(np.float64))).max() < 0.35 * VOXEL
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    volume_of = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    grid = np.stack(np.meshgrid(*[np.linspace(-0.32, 0.32, 65)] * 3, indexing="ij"), axis=-1)
    expected = np.mean(distance(grid) < 0) * 0.65**3
    assert volume_of == pytest.approx(expected, rel=0.02)  # positive: the triangles face outwards


def test_a_surface_that_leaves_the_map_is_open_there_only():
    distance = lambda points: points @ np.array([0.36, 0.48, 0.8]) - 0.017  # noqa: E731
    mesh = welded(analytic_map(distance, LOW, HIGH, VOXEL, 2, mixed).extract_mesh())
    ends = np.unique(np.array(open_edges(mesh.faces))[gaps(mesh) > 0.02 * VOXEL])
    inside = mesh.vertices[ends]
    border = np.minimum(np.abs(inside + 0.32), np.abs(inside - 0.31)).min(axis=1)  # the last voxels of the blocks
    assert len(ends) > 50
    assert border.max() < 1.01 * VOXEL
    assert np.abs(distance(mesh.vertices.astype(np.float64))).max() < 0.01 * VOXEL
    np.testing.assert_allclose(mesh.normals, np.tile([0.36, 0.48, 0.8], (len(mesh.normals), 1)), atol=0.02)


def test_smaller_voxels_bring_the_mesh_nearer_to_a_sphere():
    distance, errors = SHAPES["sphere"], []
    for levels, refine in ((1, None), (1, lambda level, centres: np.ones(len(centres), bool)),
                           (2, lambda level, centres: np.ones(len(centres), bool))):  # fmt: skip
        mesh = analytic_map(distance, LOW, HIGH, VOXEL, levels, refine).extract_mesh()
        centres = mesh.vertices[mesh.faces].astype(np.float64).mean(axis=1)
        errors.append(np.abs(distance(centres)).mean())
    assert errors[1] < 0.4 * errors[0]
    assert errors[2] < 0.4 * errors[1]


@pytest.mark.parametrize("shape", ["box", "turned box"])
def test_smaller_voxels_halve_what_is_cut_off_the_edges_of_a_box(shape):
    half, rotation = ((0.19, 0.16, 0.15), np.eye(3)) if shape == "box" else ((0.15, 0.13, 0.12), ROTATION)
    points = []
    for axis in range(3):
        for signs in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            line = np.zeros((150, 3))
            line[:, axis] = np.linspace(-1, 1, 150) * half[axis]
            line[:, (axis + 1) % 3], line[:, (axis + 2) % 3] = np.array(signs) * np.take(half, [axis - 2, axis - 1])
            points.append(line)
    points = np.concatenate(points) @ rotation.T + (0.011, 0.013, -0.007)
    assert np.abs(SHAPES[shape](points)).max() < 1e-9
    coarse, fine = (
        distances_to(analytic_map(SHAPES[shape], LOW, HIGH, VOXEL, 1, refine).extract_mesh(), points)
        for refine in (None, lambda level, c: np.ones(len(c), bool))
    )
    assert fine.max() < 0.45 * VOXEL
    assert fine.mean() < 0.5 * coarse.mean()


def test_chunks_are_parts_of_the_whole():
    volume = analytic_map(SHAPES["turned box"], LOW, HIGH, VOXEL, 2, mixed)
    whole, parts = volume.extract_mesh(), IncrementalMesh(volume)
    parts.update()
    assert len(parts.chunks) > 1

    def triangles(mesh):
        return sorted(map(tuple, np.round(mesh.vertices[mesh.faces].mean(axis=1), 6).tolist()))

    np.testing.assert_allclose(triangles(parts.mesh()), triangles(whole), atol=2e-6)


@pytest.mark.parametrize("shape", SHAPES)
def test_pieces_of_a_map_on_disk_meet_as_the_whole_does(shape):
    """The shape lies in eight regions, each a piece; their triangles together are those of the whole, bit for bit."""
    whole = analytic_map(SHAPES[shape], LOW, HIGH, VOXEL, 2, mixed)
    expected = triangles(whole.extract_mesh())
    paged = whole.for_camera(CAMERA, max_blocks=10)
    paged.page_out()
    assert paged.blocks.num_entries == 0
    pieces = list(paged.extract_pieces())
    assert len(pieces) == 8
    np.testing.assert_array_equal(triangles(joined(pieces)), expected)
