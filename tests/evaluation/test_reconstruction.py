"""Surface scores against shapes whose distances are known, and against trimesh's closest points."""

import numpy as np
import pytest
import trimesh

from dudmap.core.geometry import se3
from dudmap.core.geometry.mesh import Mesh
from dudmap.errors import ConfigError, MapError
from dudmap.evaluation.reconstruction import compare_surfaces, distance_colors, error_mesh
from dudmap.evaluation.surface import Surface, moved, point_triangle_distances, register


def mesh_of(vertices, faces):
    vertices = np.asarray(vertices, np.float32)
    return Mesh(
        vertices, np.asarray(faces, np.int32), np.full((len(vertices), 3), 99, np.uint8), np.zeros_like(vertices)
    )


def from_trimesh(shape):
    return mesh_of(shape.vertices, shape.faces)


def plane(width=2.0, depth=2.0, z=0.0, cells=20, x=0.0):
    """A rectangle parallel to the xy plane from (x, 0) on."""
    across, along = np.meshgrid(np.linspace(x, x + width, cells + 1), np.linspace(0, depth, cells + 1), indexing="ij")
    vertices = np.stack([across, along, np.full_like(across, z)], axis=-1).reshape(-1, 3)
    a = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    b, c, d = a + 1, a + cells + 1, a + cells + 2
    return mesh_of(vertices, np.concatenate([np.stack([a, c, d], 1), np.stack([a, d, b], 1)]))


def together(*meshes):
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return mesh_of(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]),
    )


def test_point_to_triangle_is_that_of_trimesh():
    random = np.random.default_rng(3)
    corners = random.normal(0, 1, (4000, 3, 3)).astype(np.float32)
    corners[:500] *= [1, 1, 0.001]  # flat ones
    points = random.normal(0, 2, (4000, 3)).astype(np.float32)
    closest = trimesh.triangles.closest_point(corners.astype(np.float64), points.astype(np.float64))
    np.testing.assert_allclose(
        point_triangle_distances(points, corners), np.linalg.norm(points - closest, axis=1), atol=2e-5
    )


@pytest.mark.parametrize("kind", ["fine", "coarse", "mixed"])
def test_distance_to_a_surface_is_exact_whatever_its_triangles(kind):
    if kind == "fine":
        shape = trimesh.creation.icosphere(subdivisions=4, radius=0.35)
    elif kind == "coarse":
        shape = trimesh.creation.box((2.0, 1.0, 3.0))
    else:
        small = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
        small.apply_translation([0, 0, 2.0])
        shape = trimesh.util.concatenate([trimesh.creation.box((2.0, 1.0, 3.0)), small])
    points = np.random.default_rng(4).uniform(-2, 2, (800, 3)).astype(np.float32)
    brute = np.full(len(points), np.inf, np.float32)
    for triangle in shape.triangles.astype(np.float32):
        repeated = np.broadcast_to(triangle, (len(points), 3, 3))
        brute = np.minimum(brute, point_triangle_distances(points, repeated))
    found = Surface(from_trimesh(shape), "it").distances(points)
    assert np.all(found >= brute - 1e-6)
    np.testing.assert_allclose(found, brute, atol=1e-3)
    assert np.mean(found - brute) < 2e-5


def test_samples_are_spread_by_area():
    big, small = plane(3.0, 1.0, 0.0, cells=1), plane(1.0, 1.0, 1.0, cells=30)
    points = Surface(together(big, small), "it").samples(4000)
    assert np.mean(points[:, 2] > 0.5) == pytest.approx(0.25, abs=0.001)
    low = points[points[:, 2] < 0.5]
    counts, _, _ = np.histogram2d(low[:, 0], low[:, 1], bins=(6, 2))
    assert counts.min() > 0.8 * len(low) / 12


def test_parallel_planes_and_a_missing_half():
    reference = plane(2.0, 2.0, 0.0)
    result = compare_surfaces(plane(2.0, 2.0, 0.015), reference, samples=20_000)
    assert result.accuracy.mean == pytest.approx(0.015, rel=1e-4)
    assert result.completeness.rmse == pytest.approx(0.015, rel=1e-4)
    assert [score.precision for score in result.scores] == [0, 1, 1]
    assert [score.f_score for score in result.scores] == [0, 1, 1]
    assert result.area_m2 == pytest.approx(4.0, rel=1e-5)
    assert result.accuracy_histogram[7] == 1
    half = compare_surfaces(plane(1.0, 2.0, 0.0), reference, samples=20_000)
    assert half.accuracy.mean < 1e-5
    assert half.scores[-1].recall == pytest.approx(0.5 + 0.05 / 2, abs=0.002)
    assert half.missing_share == pytest.approx(0.475, abs=0.002)
    assert half.completeness.mean == pytest.approx(0.25, abs=0.003)
    observed = compare_surfaces(plane(1.0, 2.0, 0.0), reference, observed=plane(1.0, 2.0, 0.0), samples=20_000)
    assert observed.missing_share == 0


def test_a_ghost_is_counted_in_square_metres():
    """A tenth of a square metre floats 20 cm above a floor of four."""
    floor = plane(2.0, 2.0)
    ghost = plane(0.5, 0.2, 0.2, cells=3, x=0.7)
    result = compare_surfaces(together(floor, ghost), floor, samples=50_000)
    assert result.ghost_area_m2 == pytest.approx(0.1, rel=0.01)
    assert result.ghost_share == pytest.approx(0.1 / 4.1, rel=0.01)
    assert result.missing_share == 0
    assert compare_surfaces(together(floor, ghost), floor, ghost_distance=0.21, samples=1000).ghost_area_m2 == 0
    figures = result.figures()
    assert figures["accuracy_max_m"] == pytest.approx(0.2, abs=1e-5)
    assert figures["precision_50mm"] == pytest.approx(4 / 4.1, rel=1e-3)


def test_error_mesh_is_blue_where_right_and_red_where_wrong():
    both = together(plane(2.0, 2.0, 0.0, cells=4), plane(0.5, 0.5, 0.3, cells=2))
    colored = error_mesh(both, plane(2.0, 2.0))
    right, wrong = colored.colors[:25].astype(int), colored.colors[25:].astype(int)
    assert np.all(right[:, 2] > 180)
    assert np.all(right[:, 0] < 60)
    assert np.all(wrong[:, 0] > 180)
    assert np.all(wrong[:, 2] < 60)
    np.testing.assert_array_equal(colored.vertices, both.vertices)
    assert len(np.unique(distance_colors(np.linspace(0, 1, 5, dtype=np.float32), 1.0), axis=0)) == 5


def room():
    """Floor, two walls, and a box: determined in all six directions."""
    box = trimesh.creation.box((0.6, 0.5, 0.8))
    box.apply_translation([1.2, 0.9, 0.4])
    wall = moved(plane(2.0, 2.0), se3.exp(np.array([0, 0, 0, 0, -np.pi / 2, 0])))
    other = moved(plane(2.0, 2.0), se3.exp(np.array([0, 0, 0, np.pi / 2, 0, 0])))
    return together(plane(2.0, 2.0), wall, other, from_trimesh(box))


def test_registration_finds_a_known_motion_in_spite_of_ghosts():
    reference = room()
    T = se3.exp(np.array([0.06, -0.04, 0.05, 0.04, -0.03, 0.05]))
    estimate = moved(together(reference, plane(0.8, 0.8, 1.5, cells=4, x=0.6)), T)
    found = register(estimate, reference, samples=6000)
    error = found.T_reference_estimate @ T
    assert found.free_directions == 0
    assert np.linalg.norm(error[:3, 3]) < 5e-4
    assert se3.rotation_angle(error) < 5e-4
    assert found.rmse < 5e-4
    started = register(estimate, reference, se3.inverse(T), samples=6000)
    assert started.num_iterations < found.num_iterations


def test_registration_does_not_move_along_a_plane():
    T = se3.exp(np.array([0.03, 0.02, 0.04, 0.02, 0.01, 0]))
    found = register(moved(plane(), T), plane(), samples=3000)
    assert found.free_directions == 3
    assert abs((found.T_reference_estimate @ T @ [1, 1, 0, 1])[2]) < 1e-4


def test_errors_are_one_sentence():
    cloud = mesh_of(np.random.default_rng(0).random((200, 3)), np.empty((0, 3)))
    with pytest.raises(MapError, match="the estimate has 200 vertices but no faces with an area"):
        compare_surfaces(cloud, plane())
    with pytest.raises(MapError, match="the reference has 200 vertices but no faces"):
        compare_surfaces(plane(), cloud)
    with pytest.raises(MapError, match="no vertices"):
        compare_surfaces(plane(), mesh_of(np.empty((0, 3)), np.empty((0, 3))))
    with pytest.raises(MapError, match="NaN"):
        compare_surfaces(mesh_of([[0, 0, np.nan], [0, 1, 0], [1, 0, 0]], [[0, 1, 2]]), plane())
    with pytest.raises(MapError, match="damaged"):
        compare_surfaces(mesh_of(np.eye(3), [[0, 1, 3]]), plane())
    with pytest.raises(MapError, match="no faces with an area"):
        compare_surfaces(mesh_of(np.ones((3, 3)), [[0, 1, 2]]), plane())
    with pytest.raises(ConfigError, match="expected a positive number"):
        compare_surfaces(plane(), plane(), ghost_distance=0)
    with pytest.raises(ConfigError, match="a threshold is nan"):
        compare_surfaces(plane(), plane(), thresholds=(np.nan,))
    with pytest.raises(MapError, match="do not overlap where they start"):
        register(plane(z=5), plane())


def test_clouds_are_accepted_when_they_are_said_to_be_clouds():
    random = np.random.default_rng(1)
    cloud = mesh_of(np.c_[2 * random.random((4000, 2)), np.full(4000, 0.03)], np.empty((0, 3)))
    result = compare_surfaces(cloud, plane(), points=True, samples=4000)
    assert result.accuracy.mean == pytest.approx(0.03, rel=1e-4)
    assert result.area_m2 is None
    assert result.ghost_area_m2 is None
    assert result.ghost_share == 0
    back = compare_surfaces(plane(), cloud, points=True, samples=2000)
    assert back.accuracy.median == pytest.approx(np.hypot(0.03, 0.015), abs=0.004)
