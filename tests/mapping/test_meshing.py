"""Marching cubes: tables, shapes with a known surface, random fields, and a slow dictionary-based oracle."""

import itertools
from collections import Counter

import numpy as np
import pytest
from scipy.spatial import KDTree

from dudmap.core.backends.cpu import meshing, tables
from dudmap.core.backends.parameters import MeshParameters

UNIT = 0.3 / 32767


def blocks_of(sdf, weight, shade, origin=(0, 0, 0)):
    """Arrays of ``extract`` from dense fields (8a, 8b, 8c): sdf (voxel units), weight, shade 0..255; slots shuffled."""
    shape = np.array(sdf.shape) // 8
    coords = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)
    order = np.random.default_rng(0).permutation(len(coords))
    coords = coords[order]
    words = np.clip(np.round(sdf * 1000), -32767, 32767).astype(np.int32) << 16 | weight.astype(np.int32) << 8
    paint = shade.astype(np.int32) * 4
    paint = paint << 20 | paint << 10 | (1020 - paint)

    def cut(dense):
        parts = dense.reshape(shape[0], 8, shape[1], 8, shape[2], 8).transpose(0, 2, 4, 1, 3, 5).reshape(-1, 512)
        return np.ascontiguousarray(parts[order])

    geometry, colors = np.zeros((len(coords) + 5, 512), np.int32), np.zeros((len(coords) + 5, 512), np.int32)
    slots = np.arange(5, len(coords) + 5).astype(np.int32)  # the first five slots belong to nobody
    geometry[slots], colors[slots] = cut(words), cut(paint)
    all_coords = np.zeros((len(geometry), 3), np.int32)
    all_coords[slots] = coords + np.array(origin)
    slot_at = {tuple(c): s for c, s in zip(coords.tolist(), slots.tolist(), strict=True)}
    neighbours = np.array(
        [
            [slot_at.get((c[0] + i, c[1] + j, c[2] + k), -1) for i, j, k in itertools.product((-1, 0, 1), repeat=3)]
            for c in coords.tolist()
        ],
        dtype=np.int32,
    )
    return geometry, colors, slots, all_coords, neighbours


def lattice(n):
    return np.stack(np.meshgrid(*[np.arange(n, dtype=np.float64)] * 3, indexing="ij"), axis=-1)


def extract(*arguments):
    """Vertices, faces, colours and normals."""
    return extract_chunks(*arguments, np.zeros(len(arguments[2]), int))[0]


def extract_chunks(*arguments):
    return [tuple(vars(mesh).values()) for mesh in meshing.extract_chunks(*arguments)]


def extracted(sdf, weight=None, shade=None, voxel_size=0.01, min_weight=1, origin=(0, 0, 0)):
    weight = np.full(sdf.shape, 9) if weight is None else weight
    shade = np.full(sdf.shape, 128) if shade is None else shade
    return extract(*blocks_of(sdf, weight, shade, origin), MeshParameters(voxel_size, UNIT, min_weight))


def edge_counts(faces):
    """How often each directed edge occurs."""
    return Counter(itertools.chain.from_iterable(((a, b), (b, c), (c, a)) for a, b, c in faces.tolist()))


def oracle(sdf, weight, min_weight):
    """Vertices (voxel units) by the pair of voxels they lie between, and the number of cells with triangles.

    One trusted cell at a time, over all its corner pairs; knows neither tables nor blocks.
    """
    points, cells = {}, 0
    n = sdf.shape[0]
    for i, j, k in itertools.product(range(n - 1), repeat=3):
        corner = [(i + a, j + b, k + c) for a, b, c in itertools.product((0, 1), repeat=3)]
        if min(weight[c] for c in corner) < min_weight or len({sdf[c] < 0 for c in corner}) == 1:
            continue
        cells += 1
        for p, q in itertools.combinations(corner, 2):
            if sum(abs(a - b) for a, b in zip(p, q, strict=True)) == 1 and (sdf[p] < 0) != (sdf[q] < 0):
                t = min(max(sdf[p] / (sdf[p] - sdf[q]), 1e-3), 1 - 1e-3)
                points[p, q] = tuple(a + (b - a) * t for a, b in zip(p, q, strict=True))
    return points, cells


def sphere(n=32, radius=9.3, center=(15.2, 16.1, 14.7)):
    return np.linalg.norm(lattice(n) - np.array(center), axis=-1) - radius, np.array(center), radius


def test_every_case_is_closed_in_its_faces():
    """The border of a case's triangles runs through the faces only, and complementary faces agree."""
    for case in range(256):
        triangles = tables.triangles(case)
        directed = Counter(e for a, b, c in triangles for e in ((a, b), (b, c), (c, a)))
        assert all(count == 1 for count in directed.values())
        border = [(a, b) for a, b in directed if (b, a) not in directed]
        for a, b in border:
            assert len(tables.EDGE_FACES[a] & tables.EDGE_FACES[b]) == 1
        inner = [(a, b) for a, b in directed if (b, a) in directed]
        for a, b in inner:
            assert not tables.EDGE_FACES[a] & tables.EDGE_FACES[b]
        crossed = {
            n
            for n, (corner, axis) in enumerate(tables.EDGES)
            if (case >> corner & 1) != (case >> (corner | 4 >> axis) & 1)
        }
        assert {e for triangle in triangles for e in triangle} == crossed
        assert len(triangles) <= 5


def test_sphere():
    import trimesh

    sdf, center, radius = sphere()
    vertices, faces, colors, normals = extracted(sdf)
    error = np.linalg.norm(vertices / 0.01 - center, axis=1) - radius
    assert np.abs(error).max() < 0.05  # voxels
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.euler_number == 2
    assert mesh.volume * 1e6 == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.01)  # positive: counter-clockwise
    outward = (vertices / 0.01 - center) / np.linalg.norm(vertices / 0.01 - center, axis=1)[:, None]
    assert np.min(np.sum(outward * normals, axis=1)) > 0.995
    assert np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    assert vertices.dtype == normals.dtype == np.float32
    assert (faces.dtype, colors.dtype) == (np.int32, np.uint8)


def test_plane_is_exact():
    normal = np.array([0.2, -0.3, 0.933])
    normal /= np.linalg.norm(normal)
    sdf = lattice(24) @ normal - 8.17
    vertices, faces, _, normals = extracted(sdf, origin=(-3, 100, 7))
    assert np.abs((vertices / 0.01 - 8 * np.array([-3, 100, 7])) @ normal - 8.17).max() < 0.005
    assert np.abs(normals - normal).max() < 0.003
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    facing = np.cross(b - a, c - a) @ normal
    assert np.all(facing > -1e-9)


def test_colors_are_interpolated():
    x = lattice(16)[..., 0]
    _, _, colors, _ = extracted(x - 5.25, shade=np.round(10 * x))
    assert np.all(np.abs(colors[:, 0].astype(float) - 52.5) <= 1)
    assert np.all(np.abs(colors[:, 2].astype(float) - (255 - 52.5)) <= 1)


@pytest.mark.parametrize("seed", range(3))
def test_random_field_is_watertight_and_shares_vertices(seed):
    """White noise has every case and every ambiguous face; inside a border of free voxels the mesh must be closed."""
    rng = np.random.default_rng(seed)
    sdf = np.round(rng.uniform(-1, 1, (24, 24, 24)), 1)  # rounding puts many voxels on exactly 0
    sdf[[0, -1]] = sdf[:, [0, -1]] = sdf[:, :, [0, -1]] = 1
    vertices, faces, _, normals = extracted(sdf)
    directed = edge_counts(faces)
    assert max(directed.values()) == 1
    assert all((b, a) in directed for a, b in directed)
    assert len(np.unique(vertices, axis=0)) == len(vertices)
    assert len(np.unique(faces)) == len(vertices)
    assert np.isfinite(vertices).all()
    assert np.isfinite(normals).all()
    a, b, c = (vertices[faces[:, k]].astype(np.float64) / 0.01 for k in range(3))
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 1e-7


@pytest.mark.parametrize("min_weight", [1, 3])
def test_random_field_against_oracle(min_weight):
    rng = np.random.default_rng(7)
    sdf = np.round(rng.uniform(-1, 1, (16, 16, 16)), 3)
    weight = rng.choice([0, 1, 2, 3, 200], sdf.shape, p=[0.03, 0.03, 0.04, 0.4, 0.5])
    vertices, faces, _, _ = extracted(sdf, weight, voxel_size=1.0, min_weight=min_weight)
    points, cells = oracle(sdf, weight, min_weight)
    wanted = np.array(sorted(points.values()))
    found = np.array(sorted(map(tuple, vertices.astype(np.float64))))
    assert found.shape == wanted.shape
    assert KDTree(wanted).query(found)[0].max() < 1e-5
    middles = vertices[faces].mean(axis=1)
    assert len(np.unique(np.floor(middles), axis=0)) == cells


def test_triangles_separate_inside_from_outside():
    """In every cell of a random field the signs at the corners are those that the triangles' orientation says."""
    rng = np.random.default_rng(11)
    sdf = rng.uniform(0.2, 1, (16, 16, 16)) * rng.choice([-1, 1], (16, 16, 16))
    sdf[[0, -1]] = sdf[:, [0, -1]] = sdf[:, :, [0, -1]] = 1
    vertices, faces, _, _ = extracted(sdf, voxel_size=1.0)
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    some = np.random.default_rng(12).choice(16**3, 300, replace=False)
    points = lattice(16).reshape(-1, 3)[some]
    winding = np.zeros(len(points))
    for triangle in mesh.triangles:  # solid angles, van Oosterom and Strackee 1983
        a, b, c = (corner - points for corner in triangle)
        la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
        top = np.einsum("ij,ij->i", a, np.cross(b, c))
        bottom = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        winding += 2 * np.arctan2(top, bottom)
    inside = winding / (4 * np.pi)
    assert np.array_equal(inside > 0.5, sdf.reshape(-1)[some] < 0)


def test_untrusted_and_missing_blocks_make_a_border():
    sdf, _, _ = sphere()
    weight = np.full(sdf.shape, 5)
    weight[:, :, 20:] = 2
    vertices, faces, _, normals = extracted(sdf, weight, min_weight=3)
    assert vertices[:, 2].max() / 0.01 <= 19
    assert len(np.unique(faces)) == len(vertices)
    assert np.isfinite(normals).all()
    geometry, colors, slots, coords, neighbours = blocks_of(sdf, weight, weight)
    some = coords[slots][:, 0] != 1
    part = extract(geometry, colors, slots[some], coords, neighbours[some], MeshParameters(0.01, UNIT, 3))
    x = part[0][:, 0] / 0.01
    assert not np.any((x > 7.001) & (x < 15.999))
    assert len(np.unique(part[1])) == len(part[0])


def triangle_soup(vertices, faces):
    """Sorted triangles (F, 9), each starting with its smallest corner: equal for equal surfaces."""
    corners = vertices[faces]
    turned = np.stack([np.roll(corners, -k, axis=1).reshape(-1, 9) for k in range(3)])
    smallest = np.array([min(map(tuple, turned[:, n])) for n in range(turned.shape[1])])
    return smallest[np.lexsort(smallest.T)]


def test_chunks_make_up_the_whole():
    rng = np.random.default_rng(3)
    sdf = rng.uniform(-1, 1, (24, 24, 24))
    weight = rng.choice([0, 9], sdf.shape, p=[0.03, 0.97])
    arrays = blocks_of(sdf, weight, 100 + 0 * weight)
    whole = extract(*arrays, MeshParameters(0.01, UNIT, 3))
    _, _, slots, coords, _ = arrays
    chunks = coords[slots] @ np.array([1, 0, 1])  # 0 to 4
    parts = extract_chunks(*arrays, MeshParameters(0.01, UNIT, 3), chunks)
    assert len(parts) == 5
    for vertices, faces, _, normals in parts:
        assert np.array_equal(np.unique(faces), np.arange(len(vertices)))
        assert len(np.unique(vertices, axis=0)) == len(vertices)
        assert len(normals) == len(vertices)
    soups = np.concatenate([part[0][part[1]].reshape(-1, 3, 3) for part in parts])
    joined = triangle_soup(soups.reshape(-1, 3), np.arange(3 * len(soups)).reshape(-1, 3))
    assert np.array_equal(joined, triangle_soup(*whole[:2]))


def test_changed_chunk_alone_equals_the_same_chunk_of_all():
    """The places of a chunk's triangles need its own blocks and those at +(dx, dy, dz); all others may be left out."""
    rng = np.random.default_rng(8)
    sdf = rng.uniform(-1, 1, (32, 32, 32))
    geometry, colors, slots, coords, neighbours = blocks_of(sdf, 9 + 0 * sdf, 100 + 0 * sdf)
    places = coords[slots]
    chunks = (places // 2) @ np.array([4, 2, 1])
    parts = extract_chunks(geometry, colors, slots, coords, neighbours, MeshParameters(0.01, UNIT, 3), chunks)
    wanted = 2  # blocks (0..1, 2..3, 0..1)
    needed = np.all((places >= [0, 2, 0]) & (places <= [2, 4, 2]), axis=1)
    only = np.where(chunks == wanted, 0, -1)[needed]
    alone = extract_chunks(
        geometry, colors, slots[needed], coords, neighbours[needed], MeshParameters(0.01, UNIT, 3), only
    )  # fmt: skip
    assert len(alone) == 1
    assert np.array_equal(triangle_soup(*alone[0][:2]), triangle_soup(*parts[wanted][:2]))


def test_nothing_to_mesh():
    vertices, faces, colors, normals = extracted(np.ones((16, 16, 16)))
    assert (len(vertices), len(faces), len(colors), len(normals)) == (0, 0, 0, 0)
    empty = np.empty((0, 27), np.int32)
    geometry = np.zeros((4, 512), np.int32)
    assert (
        extract_chunks(
            geometry, geometry, empty[:, 0], geometry[:, :3], empty, MeshParameters(0.01, UNIT, 1), empty[:, 0]
        )
        == []
    )


def test_deterministic():
    rng = np.random.default_rng(2)
    sdf = rng.uniform(-1, 1, (40, 40, 40))
    for a, b in zip(extracted(sdf), extracted(sdf), strict=True):
        assert np.array_equal(a, b)
