"""Triangle mesh of the true static surface, and its observed part."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.mesh import Mesh, with_faces
from dudmap.lab.synthetic.kernels import raytracing as kernels
from dudmap.lab.synthetic.render import over_rows
from dudmap.lab.synthetic.scene import BOX, CAPSULE, CYLINDER, ELLIPSOID, TORUS, Primitive
from dudmap.lab.synthetic.textures import LEVELS, SIZE, TEXTURES

Points = NDArray[np.float64]
Faces = NDArray[np.int64]


def _grid_faces(rows: int, columns: int) -> Faces:
    a = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    return np.concatenate(
        [np.stack([a, a + 1, a + columns + 1], axis=1), np.stack([a, a + columns + 1, a + columns], axis=1)]
    )


def _box(half: tuple[float, float, float], detail: float) -> tuple[Points, Points, Faces]:
    vertices, normals, faces, count = [], [], [], 0
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        across = np.linspace(-half[i], half[i], int(np.ceil(2 * half[i] / detail)) + 1)
        down = np.linspace(-half[j], half[j], int(np.ceil(2 * half[j] / detail)) + 1)
        for side in (-1.0, 1.0):
            points = np.empty((len(across), len(down), 3))
            points[..., axis], points[..., i], points[..., j] = side * half[axis], across[:, None], down[None, :]
            normal = np.zeros(3)
            normal[axis] = side
            grid = _grid_faces(len(across), len(down))
            # (row, column) run along (i, j) and i x j = axis: a cell (a, a+1, a+columns+1) turns against +axis
            faces.append(count + (grid if side < 0 else grid[:, ::-1]))
            vertices.append(points.reshape(-1, 3))
            normals.append(np.tile(normal, (points.size // 3, 1)))
            count += points.size // 3
    return np.concatenate(vertices), np.concatenate(normals), np.concatenate(faces)


def _profile(primitive: Primitive, fine: float, detail: float) -> tuple[Points, Points]:
    hx, _, hz = primitive.half

    def arc(radius: float, start: float, stop: float) -> Points:
        angles = np.linspace(start, stop, max(int(np.ceil(abs(stop - start) * radius / fine)), 6) + 1)
        return np.stack([np.sin(angles), np.cos(angles)], axis=1)

    if primitive.kind == ELLIPSOID:
        unit = arc(max(primitive.half), 0.0, np.pi)
        return unit, unit
    steps = max(int(np.ceil(2 * hz / detail)), 1) + 1
    if primitive.kind == CAPSULE:
        top, bottom = arc(hx, 0.0, np.pi / 2), arc(hx, np.pi / 2, np.pi)
        points = np.concatenate([top * hx + (0, hz), bottom * hx - (0, hz)])
        pieces = np.ceil(np.linalg.norm(np.diff(points, axis=0), axis=1) / detail)  # the straight side is long
        return _divided(points, pieces), _divided(np.concatenate([top, bottom]), pieces)
    if primitive.kind == CYLINDER:
        across = np.linspace(0, hx, max(int(np.ceil(hx / detail)), 1) + 1)
        down = np.linspace(hz, -hz, steps)
        outline = ((across, np.full_like(across, hz)), (np.full_like(down, hx), down),
                   (across[::-1], np.full_like(across, -hz)))  # fmt: skip
        points = np.concatenate([np.stack(part, axis=1) for part in outline])
        normals = np.repeat([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0]], [len(across), len(down), len(across)], axis=0)
        return points, normals
    ring = arc(hz, 0.0, 2 * np.pi)
    return ring * hz + (hx, 0), ring


def _divided(values: Points, pieces: Points) -> Points:
    counts = np.maximum(pieces, 1).astype(int)
    at = np.repeat(np.arange(len(counts)), counts)
    share = (np.arange(len(at)) - (np.cumsum(counts) - counts)[at] + 1) / counts[at]
    return np.concatenate([values[:1], values[at] + share[:, None] * np.diff(values, axis=0)[at]])


def _revolved(primitive: Primitive, detail: float) -> tuple[Points, Points, Faces]:
    fine = max(min(detail, 0.35 * primitive.half[2 if primitive.kind == TORUS else 0]), 0.004)
    profile, slopes = _profile(primitive, fine, detail)
    widest = float(np.abs(profile[:, 0]).max()) * (max(primitive.half) if primitive.kind == ELLIPSOID else 1.0)
    turns = max(int(np.ceil(2 * np.pi * widest / fine)), 12)
    angles = np.linspace(0, 2 * np.pi, turns + 1)
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    shape = (len(profile), turns + 1, 3)
    points, normals = np.empty(shape), np.empty(shape)
    for target, source in ((points, profile), (normals, slopes)):
        target[..., :2] = source[:, None, :1] * directions[None]
        target[..., 2] = source[:, None, 1]
    if primitive.kind == ELLIPSOID:
        points *= primitive.half
        normals /= primitive.half
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    # rows go down, columns counter-clockwise: seen from outside (a, a+columns+1, a+1) is counter-clockwise
    faces = _grid_faces(len(profile), turns + 1)[:, ::-1]
    return points.reshape(-1, 3), normals.reshape(-1, 3), faces


def _colors(primitive: Primitive, local: Points, normals: Points, detail: float, atlas: NDArray[np.int32]) -> Points:
    material = primitive.material
    axis = np.abs(normals).argmax(axis=1)
    s = np.where(axis == 0, local[:, 1] * np.sign(normals[:, 0]), local[:, 0])
    s = np.where(axis == 1, -s * np.sign(normals[:, 1]), s)
    w = np.where(axis == 2, -local[:, 1], -local[:, 2])
    side = np.where(axis == 0, 0.37 * np.sign(normals[:, 0]), np.where(axis == 1, 0.71 * np.sign(normals[:, 1]), 0.0))
    u = s * material.scale[0] + material.offset[0] + side * float(material.faces)
    v = w * material.scale[1] + material.offset[1]
    level = int(np.clip(np.log2(max(detail * max(material.scale) * SIZE, 1.0)), 0, LEVELS - 1))
    size = SIZE >> level
    start = sum((SIZE >> finer) ** 2 for finer in range(level))
    texel = np.floor(v * size).astype(int) % size * size + np.floor(u * size).astype(int) % size
    packed = atlas[TEXTURES.index(material.texture), start + texel]
    rgb = np.stack([packed & 255, packed >> 8 & 255, packed >> 16 & 255], axis=1).astype(np.float64)
    return rgb * np.asarray(material.tint)


def tessellate(
    primitives: list[Primitive],
    detail: float,
    extent: tuple[tuple[float, float, float], tuple[float, float, float]],
    atlas: NDArray[np.int32],
) -> Mesh:
    """Mesh of all surfaces that border free space, without triangles inside solids or outside ``extent`` (two corners,
    m).

    Vertices and flat surfaces are exact, curved ones to about ``detail``^2 / (8 radius).
    """
    pieces: list[tuple[Points, Points, Points, Faces]] = []
    low, high = np.asarray(extent[0]) - 1e-3, np.asarray(extent[1]) + 1e-3
    boxes = [_world_bounds(primitive) for primitive in primitives]
    for number, primitive in enumerate(primitives):
        if primitive.kind == BOX:
            local, normals, faces = _box(primitive.half, detail)
        else:
            local, normals, faces = _revolved(primitive, detail)
        T = primitive.T_body_primitive
        vertices, directions = local @ T[:3, :3].T + T[:3, 3], normals @ T[:3, :3].T
        a, b, c = np.ascontiguousarray(vertices.T)[:, faces.T].transpose(1, 0, 2)
        cross = _cross(b - a, c - a)
        area = np.sqrt(cross[0] ** 2 + cross[1] ** 2 + cross[2] ** 2)
        keep = area > 1e-12
        front = (a + b + c) / 3 + 1e-3 * cross / np.maximum(area, 1e-12)
        keep &= _within(front, low, high)
        for other, (other_low, other_high) in enumerate(boxes):
            if other == number or np.any(other_low > boxes[number][1]) or np.any(other_high < boxes[number][0]):
                continue
            near = np.flatnonzero(keep & _within(front, other_low, other_high))
            keep[near[primitives[other].distance(np.ascontiguousarray(front[:, near].T)) < 0]] = False
        if keep.any():
            pieces.append((vertices, directions, _colors(primitive, local, normals, detail, atlas), faces[keep]))
    starts = np.cumsum([0, *(len(piece[0]) for piece in pieces)])
    mesh = Mesh(
        np.concatenate([piece[0] for piece in pieces]).astype(np.float32),
        np.concatenate([piece[3] + start for piece, start in zip(pieces, starts, strict=False)]).astype(np.int32),
        np.clip(np.rint(np.concatenate([piece[2] for piece in pieces])), 0, 255).astype(np.uint8),
        np.concatenate([piece[1] for piece in pieces]).astype(np.float32),
    )
    return with_faces(mesh, np.ones(len(mesh.faces), dtype=bool))


def _cross(a: Points, b: Points) -> Points:
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _within(points: Points, low: Points, high: Points) -> NDArray[np.bool_]:
    inside = np.ones(points.shape[1], dtype=bool)
    for values, least, most in zip(points, low, high, strict=True):
        inside &= (values > least) & (values < most)
    return inside


def _world_bounds(primitive: Primitive) -> tuple[Points, Points]:
    reach = np.abs(primitive.T_body_primitive[:3, :3]) @ primitive.bounds() + 2e-3
    center = primitive.T_body_primitive[:3, 3]
    return center - reach, center + reach


def count_views(
    mesh: Mesh,
    camera: Camera,
    views: Iterable[tuple[NDArray[np.float64], NDArray[np.float32]]],
    depth_range: tuple[float, float],
    grazing: float,
) -> NDArray[np.int32]:
    """Views (V,) in which each vertex of a mesh in the world frame is seen.

    Views are T_world_camera (4, 4) and ideal depth (H, W), metres. Depths within ``depth_range`` count, at a cosine of
    incidence of at least ``grazing``.
    """
    counts = np.zeros(len(mesh.vertices), dtype=np.int32)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    for T_world_camera, depth in views:
        T = se3.inverse(T_world_camera)
        view = (mesh.vertices, mesh.normals, T, intrinsics, depth, *depth_range, grazing, counts)
        over_rows(len(counts), kernels.count_views, *view)
    return counts
