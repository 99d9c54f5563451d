"""Views of shapes whose depth, normals and colours are known, and of noise against a slow ray marcher."""

import numpy as np
import pytest

from dudmap.core.backends.cpu.octree_field import FinerLevels
from dudmap.core.backends.cpu.raycasting import raycast
from dudmap.core.backends.parameters import RaycastParameters, VoxelGrid
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera

VOXEL = 0.01
UNIT = 0.3 / 32767
BAND = 0.04
CAMERA = Camera(90.0, 90.0, 39.5, 29.5, 80, 60)


def mapped(sdf, origin=(-5, -4, 3), shape=(10, 9, 12), shade=None, weight=None, band=BAND):
    """Window, origin, geometry and colours of a field given as function of points (..., 3) in metres.

    Only blocks with a voxel within the band get voxels, in shuffled slots; every third of the others counts as free.
    """
    rng = np.random.default_rng(0)
    window = np.full(shape, -1, dtype=np.int32)
    window[rng.random(shape) < 0.3] = -7
    cells = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)
    voxels = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    slots = rng.permutation(len(cells))
    geometry = np.zeros((len(cells), 512), np.int32)
    colors = np.zeros((len(cells), 512), np.int32)
    for cell, slot in zip(cells, slots, strict=True):
        points = VOXEL * (8 * (cell + np.array(origin)) + voxels)
        distance = sdf(points)
        if np.abs(distance).min() > band:
            continue
        window[tuple(cell)] = slot
        weights = np.where(distance < -band, 0, 5 if weight is None else weight(points)).astype(np.int32)
        steps = np.round(np.clip(distance, -band, band) / UNIT).astype(np.int32)
        geometry[slot] = steps << 16 | weights << 8
        paint = (np.full(512, 100.0) if shade is None else shade(points)) * 4
        paint = np.round(paint).astype(np.int32)
        colors[slot] = paint << 20 | (paint // 2) << 10 | (1020 - paint)
    return window, np.array(origin, dtype=np.int32), geometry, colors


def view(field, T=None, camera=CAMERA, depth_min=0.05, depth_max=3.0, min_weight=1):
    T = np.eye(4) if T is None else T
    window, origin, geometry, colors = field
    unused = np.empty((0, 3), np.int16), np.empty(0, np.uint8)
    grid = VoxelGrid(window.reshape(-1), np.array(window.shape), origin, geometry, colors, *unused, VOXEL, UNIT)
    return raycast(
        grid, T, camera.intrinsics, camera.shape, RaycastParameters(depth_min, depth_max, min_weight), FinerLevels()
    )


def pose(*twist):
    return se3.exp(np.array(twist, dtype=np.float64))


def rays(T, camera=CAMERA):
    """Origin (3,) and directions (H, W, 3) in the world, one metre of depth long."""
    return T[:3, 3], camera.backproject(np.ones(camera.shape)) @ T[:3, :3].T


CENTER, RADIUS = np.array([0.03, -0.02, 0.72]), 0.15


def sphere(points):
    return np.linalg.norm(points - CENTER, axis=-1) - RADIUS


@pytest.mark.parametrize("twist", [(0,) * 6, (0.1, 0.05, 0.1, 0.03, -0.1, 0.4), (-0.1, 0.1, 0.45, 0.3, 0.2, 0)])
def test_sphere(twist):
    T = pose(*twist)
    depth, color, normals = view(mapped(sphere), T)
    o, d = rays(T)
    a, b, c = (d * d).sum(-1), (d * (o - CENTER)).sum(-1), (o - CENTER) @ (o - CENTER) - RADIUS**2
    discriminant = b * b - a * c
    true = np.where(discriminant > 0, (-b - np.sqrt(np.maximum(discriminant, 0))) / a, 0)
    points = o + d * true[..., None]
    outward = (points - CENTER) / RADIUS
    facing = (discriminant > 0) & ((outward * d).sum(-1) / np.sqrt(a) < -0.3)
    assert facing.sum() > 100
    assert np.abs(depth - true)[facing].max() < 0.2 * VOXEL
    assert np.min((normals * outward).sum(-1)[facing]) > 0.97
    assert np.allclose(np.linalg.norm(normals, axis=-1)[depth > 0], 1, atol=1e-5)
    clear = (discriminant < 0) & (np.linalg.norm(np.cross(d, o - CENTER), axis=-1) / np.sqrt(a) > RADIUS + 0.01)
    assert np.all(depth[clear] == 0)
    assert np.all(normals[depth == 0] == 0)
    assert np.all(color[depth == 0] == 0)
    assert np.all(color[depth > 0] == (100, 50, 155))


def test_plane_with_colors():
    normal = np.array([0.3, 0.2, -0.933])
    normal /= np.linalg.norm(normal)

    def shade(points):
        return 128 + 200 * points[:, 0]

    depth, color, normals = view(mapped(lambda p: p @ normal + 0.62, shade=shade))
    _, d = rays(np.eye(4))
    true = -0.62 / (d @ normal)
    inside = (slice(4, -4), slice(4, -4))
    hit = depth[inside] > 0
    assert hit.mean() > 0.6
    assert np.abs(depth - true)[inside][hit].max() < 0.02 * VOXEL
    assert np.min((normals @ normal)[inside][hit]) > 0.999
    expected = 128 + 200 * depth * d[..., 0]
    assert np.abs(color[..., 0].astype(float) - expected)[inside][hit].max() < 1
    assert np.abs(color[..., 2].astype(float) - (255 - expected))[inside][hit].max() < 1


def test_back_sides_are_no_surface():
    """Seen from inside the solid, the surface is a change from negative to positive."""
    depth, _, _ = view(mapped(lambda p: 0.5 - p[..., 2]))
    assert (depth > 0).mean() > 0.5
    depth, _, _ = view(mapped(lambda p: p[..., 2] - 0.5))
    assert np.all(depth == 0)


def test_no_surface_behind_unknown():
    """Where the voxels in front of the surface were never seen, a ray meets the inside only."""

    def weight(points):
        return np.where((points[:, 2] < 0.5) & (points[:, 0] > 0), 0, 5)

    depth, _, normals = view(mapped(lambda p: 0.5 - p[..., 2], weight=weight))
    assert np.all(depth[:, 43:] == 0)
    assert np.all(normals[:, 43:] == 0)
    assert np.all(depth[20:40, 20:37] > 0)


def test_weight_and_depth_limits():
    field = mapped(lambda p: 0.5 - p[..., 2], weight=lambda p: np.where(p[:, 0] > 0, 5, 2))
    assert np.all(view(field, min_weight=6)[0] == 0)
    depth = view(field, min_weight=3)[0]
    assert np.all(depth[:, :36] == 0)
    assert np.all(depth[20:40, 43:55] > 0)
    assert np.all(view(field, depth_min=0.55)[0] == 0)
    assert np.all(view(field, depth_max=0.45)[0] == 0)


def test_camera_inside_and_outside_of_the_window():
    field = mapped(sphere)
    for twist in ((0, 0, 0.45, 0, 0, 0), (0.03, 0, -1.2, 0, 0, 0)):
        depth = view(field, pose(*twist))[0]
        hit = depth[28:32, 38:42]
        assert np.all(np.abs(hit - (CENTER[2] - RADIUS - twist[2])) < 0.02)
    assert np.all(view(field, pose(0, 0, 5, 0, 0, 0))[0] == 0)
    empty = (np.full((4, 4, 4), -1, np.int32), *field[1:])
    assert np.all(view(empty)[0] == 0)


def test_rays_along_an_axis():
    """With the principal point on a pixel and a pose along the axes, directions of rays have zeros."""
    camera = Camera(90.0, 90.0, 40.0, 30.0, 80, 60)
    depth = view(mapped(lambda p: 0.5 - p[..., 2]), camera=camera)[0]
    assert np.abs(depth[20:40, 20:60] - 0.5).max() < 0.02 * VOXEL


def marched(field, T, camera, depth_max, min_weight):
    """Depth by marching in steps of a hundredth of a voxel over the trilinear field, one ray at a time."""
    window, origin, geometry, _ = field
    words = np.zeros(tuple(8 * n for n in window.shape), dtype=np.int64)
    for cell in zip(*np.nonzero(window >= 0), strict=True):
        part = tuple(slice(8 * n, 8 * n + 8) for n in cell)
        words[part] = geometry[window[cell]].reshape(8, 8, 8)
    sdf, known = (words >> 16) * UNIT, ((words >> 8) & 0xFF) >= min_weight
    o, d = rays(T, camera)
    out = np.zeros(camera.shape)
    t = np.arange(0.05, depth_max, VOXEL / 100)
    for v, u in np.ndindex(camera.shape):
        p = (o + t[:, None] * d[v, u]) / VOXEL - 8 * origin
        base = np.floor(p).astype(int)
        ok = np.all((base >= 0) & (base < np.array(words.shape) - 1), axis=1)
        base = np.where(ok[:, None], base, 0)
        value = np.zeros(len(t))
        for k in range(8):
            corner = base + np.array([k >> 2, (k >> 1) & 1, k & 1])
            part = np.abs(1 - np.array([k >> 2, (k >> 1) & 1, k & 1]) - (p - base)).prod(axis=1)
            value += part * sdf[tuple(corner.T)]
            ok &= known[tuple(corner.T)]
        cross = ok[:-1] & ok[1:] & (value[:-1] > 0) & (value[1:] <= 0)
        if cross.any():
            out[v, u] = t[np.argmax(cross)]
    return out


def test_wavy_field_against_marching():
    """A bumpy wall with holes and weights at random, against the marcher, where the two agree that there is a wall."""
    rng = np.random.default_rng(5)
    phases = rng.uniform(0, 6, 4)

    def wall(p):
        wave = 0.02 * np.sin(30 * p[..., 0] + phases[0]) * np.sin(25 * p[..., 1] + phases[1])
        return 0.6 - p[..., 2] + wave + 0.015 * np.sin(20 * p[..., 0] + 15 * p[..., 1] + phases[2])

    field = mapped(wall, weight=lambda p: np.where(np.sin(40 * p[:, 0]) * np.sin(37 * p[:, 1]) > 0.8, 1, 4))
    camera = Camera(30.0, 30.0, 13.5, 9.5, 28, 20)
    T = pose(0.05, -0.03, 0.02, 0.1, -0.15, 0.3)
    depth = view(field, T, camera, depth_max=1.2, min_weight=3)[0]
    true = marched(field, T, camera, 1.2, 3)
    both = (depth > 0) & (true > 0)
    assert both.sum() > 150
    assert ((depth > 0) != (true > 0)).mean() < 0.03  # pixels at the rim of a hole
    assert np.quantile(np.abs(depth - true)[both], 0.98) < 0.1 * VOXEL


def test_any_content_gives_finite_views():
    rng = np.random.default_rng(9)
    window = rng.integers(-3, 60, (6, 6, 9), dtype=np.int32)
    geometry = rng.integers(-(2**31), 2**31, (60, 512), dtype=np.int64).astype(np.int32)
    field = (window, np.array([-3, -3, 2], np.int32), geometry, geometry)
    for twist in ((0,) * 6, (0, 0, 0.3, 0.5, 0.4, 1.0), (0, 0, 0, 0, np.pi / 2, 0)):
        depth, _, normals = view(field, pose(*twist))
        assert np.isfinite(depth).all()
        assert np.isfinite(normals).all()
        assert depth.min() >= 0
    first, second = view(field), view(field)
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
