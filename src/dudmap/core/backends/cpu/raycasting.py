"""Rendering of the map: sphere tracing (thesis eq. 4.12 and section 4.5).

Blocks are splatted into tiles with depth ranges (Prisacariu et al. 2017), which bound each ray.
"""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.octree_field import FinerLevels, blend, corner_gradient, load, sample
from dudmap.core.backends.parameters import RaycastParameters, RaycastResult, VoxelGrid
from dudmap.core.backends.threads import bands, kernel, run_bands, scalar
from dudmap.core.formulas.pixel import project, ray
from dudmap.core.formulas.voxel import sdf_steps

TILE = 8
BAND = 16
INFINITE = np.float32(1e9)
FAR = np.float32(2)
"""Distance from the surface, voxels, beyond which the nearest voxel's value suffices."""


@kernel
def _splat(start, stop, window, T, intrinsics, size, radius, depth_min, depth_max, near, far):
    """Extend the depth ranges of all tiles that the blocks with voxels in planes ``start`` to ``stop`` may cover.

    Args:
        start, stop: First and last plane of the window.
        window: (Wx, Wy, Wz) int32.
        T: (3, 4) float32, block indices of the window to metres in the camera frame; block centres at whole numbers.
        radius: Radius of the sphere around a block, metres.
        depth_min, depth_max: Limits of the view, metres.
        near, far: (tiles down, tiles across) float32, in and out.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    rows, columns = near.shape
    for i in range(start, stop):
        for j in range(window.shape[1]):
            line = window[i, j]
            highest = np.int32(-1)
            for k in range(line.size):
                highest = max(highest, line[k])
            if highest < 0:
                continue
            for k in range(line.size):
                if line[k] < 0:
                    continue
                fi, fj, fk = np.float32(i), np.float32(j), np.float32(k)
                z = T[2, 0] * fi + T[2, 1] * fj + T[2, 2] * fk + T[2, 3]
                if z + radius < depth_min or z - radius > depth_max:
                    continue
                first_row, last_row, first_column, last_column = 0, rows - 1, 0, columns - 1
                low = z - radius
                if low > np.float32(0.02):
                    x = T[0, 0] * fi + T[0, 1] * fj + T[0, 2] * fk + T[0, 3]
                    y = T[1, 0] * fi + T[1, 1] * fj + T[1, 2] * fk + T[1, 3]
                    # no point within the radius projects farther than this from the centre
                    du = fx * radius * np.sqrt(x * x + z * z) / (z * low) + np.float32(1)
                    dv = fy * radius * np.sqrt(y * y + z * z) / (z * low) + np.float32(1)
                    by_z = np.float32(1) / z
                    u, v = project(x, by_z, fx, cx), project(y, by_z, fy, cy)
                    if u + du < 0 or v + dv < 0 or u - du > size[1] or v - dv > size[0]:
                        continue
                    first_column = np.int64(max(u - du, np.float32(0))) // TILE
                    last_column = min(np.int64(u + du) // TILE, columns - 1)
                    first_row = np.int64(max(v - dv, np.float32(0))) // TILE
                    last_row = min(np.int64(v + dv) // TILE, rows - 1)
                for row in range(first_row, last_row + 1):
                    for column in range(first_column, last_column + 1):
                        near[row, column] = min(near[row, column], low)
                        far[row, column] = max(far[row, column], z + radius)


@scalar
def step_length(distance):
    """Step along a ray, voxels, at a signed distance (voxels): shorter, because a projective distance is an upper
    bound."""
    ahead, back = max(np.float32(0.8) * distance, np.float32(0.5)), max(np.float32(-0.8) * distance, np.float32(1))
    return ahead if distance > np.float32(0) else back


@scalar
def to_block_boundary(p, d, inverse):
    """Ray parameter from ``p`` to its block's boundary along an axis."""
    block = np.floor(p * np.float32(0.125)) * np.float32(8)
    return (block + np.float32(8) - p) * inverse if d >= np.float32(0) else (block - p) * inverse


@kernel
def inside_window(shape, o, d, t, end, nudge):
    """Part of the ray ``o + t d`` in the window, without last voxels and ``nudge``."""
    zero = np.float32(0)
    for axis in range(3):
        last = np.float32(8 * shape[axis] - 1)
        if d[axis] != zero:
            a, b = -o[axis] / d[axis], (last - o[axis]) / d[axis]
            t, end = max(t, min(a, b) + nudge), min(end, max(a, b) - nudge)
        elif o[axis] < zero or o[axis] >= last:
            end = -INFINITE
    return t, end


@scalar
def _trace_ray(window, shape, children, voxels, o, d, t, end, unit, least, corners, values):
    """First crossing to the inside along lattice ray ``o + t d``; -1 = none. The field is interpolated only within FAR.

    Args:
        window: (Wx * Wy * Wz,) int32; blocks with negative entries are skipped.
        shape: (3,) int64 blocks of the window.
        children, voxels: As for ``trace_rows``.
        o, d: (3,) float32, voxels, and voxels per metre of depth.
        t, end: Depths, metres.
        unit: Voxels per step of the stored distance.
        least: Smallest trusted weight.
        corners, values: (8, 1) int32 and (8,) float32 work space.
    """
    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    ox, oy, oz, dx, dy, dz = o[0], o[1], o[2], d[0], d[1], d[2]
    speed = np.sqrt(dx * dx + dy * dy + dz * dz)
    per_voxel = one / speed
    nudge = np.float32(1e-2) * per_voxel
    t, end = inside_window(shape, o, d, t, end, nudge)
    rx = one / dx if dx != zero else INFINITE
    ry = one / dy if dy != zero else INFINITE
    rz = one / dz if dz != zero else INFINITE
    size_y, size_z = shape[1], shape[2]
    t_before, before = -one, -one
    while t < end:
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        i, j, k = np.int64(x + half), np.int64(y + half), np.int64(z + half)
        slot = window[np.uintp(((i >> 3) * size_y + (j >> 3)) * size_z + (k >> 3))]
        if slot < 0:
            steps = min(to_block_boundary(x + half, dx, rx), to_block_boundary(y + half, dy, ry))
            t += min(steps, to_block_boundary(z + half, dz, rz)) + nudge
            before = -one
            continue
        word = voxels[0][np.uintp(np.int64(slot) * 512 + (((i & 7) * 8 + (j & 7)) * 8 + (k & 7)))]
        trusted = ((word >> 8) & 0xFF) >= least
        if len(voxels) == 1 and not trusted:
            before = -one
            t += per_voxel
            continue
        value = sdf_steps(word) * unit
        if trusted and value > FAR:
            t_before, before = t, value
            t += (value - one) * per_voxel
            continue
        value, level = sample(window, shape, children, voxels, x, y, z, least, corners, values)
        value *= unit
        scale = np.float32(1 << level)  # the smallest step is a share of the voxel size that was read
        if value > zero:
            t_before, before = t, value
            t += step_length(value * scale) / scale * per_voxel
        elif value <= zero:
            if before > zero:
                ends = t_before, before, t, value
                return _refine(window, shape, children, voxels, o, d, ends, unit, least, corners, values)
            t += step_length(value * scale) / scale * per_voxel
        else:
            before = -one
            t += per_voxel
    return -one


@scalar
def _refine(window, shape, children, voxels, o, d, ends, unit, least, corners, values):
    a, at_a, b, at_b = ends
    side = 0
    t = a + (b - a) * at_a / (at_a - at_b)
    for _ in range(4):
        x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
        value, _level = sample(window, shape, children, voxels, x, y, z, least, corners, values)
        value *= unit
        if np.isnan(value) or abs(value) < np.float32(0.01):
            break
        if value > np.float32(0):
            a, at_a = t, value
            if side > 0:
                at_b *= np.float32(0.5)
            side = 1
        else:
            b, at_b = t, value
            if side < 0:
                at_a *= np.float32(0.5)
            side = -1
        t = a + (b - a) * at_a / (at_a - at_b)
    return t


@scalar
def _shade(window, shape, children, voxels, colors, x, y, z, least, corners, values, color, normal):
    one, level = np.float32(1), 0
    if len(voxels) > 1:
        _, level = sample(window, shape, children, voxels, x, y, z, least, corners, values)
    fx, fy, fz = load(window, shape, children, voxels, level, x, y, z, corners)
    s0, s1 = sdf_steps(corners[0, 0]), sdf_steps(corners[1, 0])
    s2, s3 = sdf_steps(corners[2, 0]), sdf_steps(corners[3, 0])
    s4, s5 = sdf_steps(corners[4, 0]), sdf_steps(corners[5, 0])
    s6, s7 = sdf_steps(corners[6, 0]), sdf_steps(corners[7, 0])
    gx, gy, gz = corner_gradient(s0, s1, s2, s3, s4, s5, s6, s7, fx, fy, fz)
    length = np.sqrt(gx * gx + gy * gy + gz * gz)
    scale = one / length if length > np.float32(0) else np.float32(0)
    normal[0], normal[1], normal[2] = gx * scale, gy * scale, gz * scale
    load(window, shape, children, colors, level, x, y, z, corners)
    for channel in range(3):
        for k in range(8):
            values[k] = np.float32((corners[k, 0] >> (20 - 10 * channel)) & 1023)
        value = blend(values, fx, fy, fz) * np.float32(0.25) + np.float32(0.5)
        color[channel] = np.uint8(min(value, np.float32(255)))


@kernel
def trace_rows(
    row_start, row_stop, window, shape, children, voxels, colors, intrinsics, T, near, far, depth_min, depth_max, unit,
    least, depth, color, normals,
):  # fmt: skip
    """Render rows of a view.

    ``voxels``, ``colors``: (slots * 512,) int32 per level, larger voxels first; ``children`` links levels
    (``FinerLevels``); ``T``: (3, 4) float32, metres in the camera frame to the window's lattice.
    """
    corners = np.empty((8, 1), np.int32)
    values = np.empty(8, np.float32)
    o = T[:, 3].copy()
    d = np.empty(3, np.float32)
    for v in range(row_start, row_stop):
        y = ray(v, intrinsics[3], intrinsics[1])
        for u in range(depth.shape[1]):
            start = max(near[v // TILE, u // TILE], depth_min)
            end = min(far[v // TILE, u // TILE], depth_max)
            t = np.float32(-1)
            if start < end:
                x = ray(u, intrinsics[2], intrinsics[0])
                for axis in range(3):
                    d[axis] = T[axis, 0] * x + T[axis, 1] * y + T[axis, 2]
                t = _trace_ray(window, shape, children, voxels, o, d, start, end, unit, least, corners, values)
            if t > np.float32(0) and t <= depth_max:
                depth[v, u] = t
                _shade(
                    window, shape, children, voxels, colors, o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2], least,
                    corners, values, color[v, u], normals[v, u],
                )  # fmt: skip
            else:
                depth[v, u] = 0
                color[v, u, :] = 0
                normals[v, u, :] = 0


def raycast(
    grid: VoxelGrid,
    T_world_camera: NDArray[np.float64],
    intrinsics: NDArray[np.float32],
    size: tuple[int, int],
    parameters: RaycastParameters,
    finer: FinerLevels,
) -> RaycastResult:
    """Depth, colour and normals of the first surface at each pixel (H, W): a change of the distance from positive to
    negative between trusted voxels, not from unknown space.

    ``grid``: largest voxel size; the smallest known voxels are used.
    """
    grid = grid.on_host()
    shape = grid.shape
    low, high = np.float32(parameters.depth_min), np.float32(parameters.depth_max)
    near, far = tile_depths(grid, T_world_camera, intrinsics, size, low, high)
    _, to_lattice, _ = motions(grid, T_world_camera)
    height = size[0]
    depth = np.empty(size, dtype=np.float32)
    color = np.empty((*size, 3), dtype=np.uint8)
    normals = np.empty((*size, 3), dtype=np.float32)
    unit, least = np.float32(grid.sdf_unit / grid.voxel_size), max(int(parameters.min_weight), 1)
    voxels = tuple(np.asarray(level).reshape(-1) for level in (grid.geometry, *finer.geometry))
    colors = tuple(np.asarray(level).reshape(-1) for level in (grid.colors, *finer.colors))
    run_bands(
        lambda start, stop: trace_rows(
            start, stop, grid.window, shape, finer.children, voxels, colors, intrinsics, to_lattice, near, far, low,
            high, unit, least, depth, color, normals,
        ),
        bands(height, BAND),
    )  # fmt: skip
    return RaycastResult(depth, color, normals)


def tile_depths(
    grid: VoxelGrid,
    T_world_camera: NDArray[np.float64],
    intrinsics: NDArray[np.float32],
    size: tuple[int, int],
    low: np.float32,
    high: np.float32,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Nearest and farthest depth at which each tile may meet a block, between ``low`` and ``high``, m."""
    to_camera, _, radius = motions(grid, T_world_camera)
    tiles = (-(-size[0] // TILE), -(-size[1] // TILE))
    window = np.asarray(grid.window).reshape(tuple(grid.shape))
    ranges = bands(len(window), -(-len(window) // 8))
    nears = np.full((len(ranges), *tiles), INFINITE, dtype=np.float32)
    fars = np.zeros((len(ranges), *tiles), dtype=np.float32)
    image_size = np.array(size, dtype=np.int64)
    run_bands(
        lambda start, stop, near, far: _splat(
            start, stop, window, to_camera, intrinsics, image_size, radius, low, high, near, far
        ),
        ranges,
        nears,
        fars,
    )
    return nears.min(axis=0), fars.max(axis=0)


def motions(
    grid: VoxelGrid, T_world_camera: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32], np.float32]:
    """Motions (3, 4) window blocks to metres in the camera frame, and from there to the lattice; radius around a block,
    metres."""
    voxel_size = grid.voxel_size
    corner = 8 * voxel_size * grid.origin.astype(np.float64)  # of the window, world frame
    rotation, position = T_world_camera[:3, :3], T_world_camera[:3, 3]
    to_camera = np.empty((3, 4), dtype=np.float32)
    to_camera[:, :3] = rotation.T * (8 * voxel_size)
    to_camera[:, 3] = rotation.T @ (corner + 4 * voxel_size - position)
    to_lattice = np.empty((3, 4), dtype=np.float32)
    to_lattice[:, :3] = rotation / voxel_size
    to_lattice[:, 3] = (position - corner) / voxel_size
    return to_camera, to_lattice, np.float32(4 * np.sqrt(3) * voxel_size)
