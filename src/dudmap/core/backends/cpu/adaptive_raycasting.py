"""A map with several voxel sizes seen from a pose: sphere tracing as in ``raycasting.py``, by the finest voxels."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.octree_field import child_of
from dudmap.core.backends.cpu.raycasting import (
    BAND,
    FAR,
    INFINITE,
    TILE,
    corner_gradient,
    inside_window,
    motions,
    step_length,
    tile_depths,
    to_block_boundary,
)
from dudmap.core.backends.parameters import RaycastParameters, RaycastResult, VoxelGrid
from dudmap.core.backends.threads import bands, kernel, run_bands, scalar
from dudmap.core.formulas.pixel import ray
from dudmap.core.formulas.residual import trilinear
from dudmap.core.formulas.voxel import sdf_steps

f32 = np.float32


class FinerLevels(NamedTuple):
    """Two finer levels of a map, as views and meshes read them; one that the map does not have holds no children.

    Attributes:
        children: Of each level (slots of the next coarser, 8) int32: slot of the block with half the voxel size in
            each octant of a block, -1 = none. There may be fewer rows than slots: those have no children.
        geometry, colors: Of each level (slots, 512) int32 packed voxels and colours.
    """

    children: tuple[NDArray[np.int32], ...]
    geometry: tuple[NDArray[np.int32], ...]
    colors: tuple[NDArray[np.int32], ...]


@kernel
def _block_at(window, shape, children, level, i, j, k):
    """Slot of the block of a level that holds voxel (i, j, k) of that level's lattice; negative = none."""
    bits = level + 3
    bx, by, bz = i >> bits, j >> bits, k >> bits
    if bx < 0 or by < 0 or bz < 0 or bx >= shape[0] or by >= shape[1] or bz >= shape[2]:
        return np.int32(-1)
    slot = window[(bx * shape[1] + by) * shape[2] + bz]
    for finer in range(level):
        bit = bits - 1 - finer
        slot = child_of(children[finer], slot, 4 * ((i >> bit) & 1) + 2 * ((j >> bit) & 1) + ((k >> bit) & 1))
    return slot


@kernel
def _words_at(level, window, shape, children, voxels, x, y, z, corners):
    """Words (8,) int32 of the voxels of a level around a point of the window's lattice (coarsest voxels, inside of it),
    number 4 dx + 2 dy + dz, 0 = none; returns the place of the point between them, in [0, 1)."""
    scale = f32(1 << level)
    x, y, z = x * scale, y * scale, z * scale
    lx, ly, lz = np.floor(x), np.floor(y), np.floor(z)
    for m in range(8):
        i, j, k = np.int64(lx) + (m >> 2), np.int64(ly) + ((m >> 1) & 1), np.int64(lz) + (m & 1)
        slot = _block_at(window, shape, children, level, i, j, k)
        corners[m] = voxels[level][slot, ((i & 7) * 8 + (j & 7)) * 8 + (k & 7)] if slot >= 0 else np.int32(0)
    return x - lx, y - ly, z - lz


@scalar
def _value(window, shape, children, voxels, x, y, z, least, corners):
    """Signed distance in stored steps at a lattice point by the finest voxels that are known, and their level; NaN
    where none are."""
    for above in range(3):
        level = 2 - above
        scale = f32(1 << level)
        i, j, k = np.int64(np.floor(x * scale)), np.int64(np.floor(y * scale)), np.int64(np.floor(z * scale))
        if level > 0 and _block_at(window, shape, children, level, i, j, k) < 0:
            continue
        ax, ay, az = _words_at(level, window, shape, children, voxels, x, y, z, corners)
        known = np.int32(255)
        for m in range(8):
            known = min(known, (corners[m] >> 8) & 0xFF)
        if known >= least:
            value, _, _, _ = trilinear(
                sdf_steps(corners[0]), sdf_steps(corners[1]), sdf_steps(corners[2]), sdf_steps(corners[3]),
                sdf_steps(corners[4]), sdf_steps(corners[5]), sdf_steps(corners[6]), sdf_steps(corners[7]), ax, ay, az,
            )  # fmt: skip
            return value, level
    return f32(np.nan), 0


@scalar
def _trace(window, shape, children, voxels, o, d, t, end, unit, least, corners):
    """First crossing from outside to inside along lattice ray ``o + t d``; -1 = none. See ``raycasting.py``."""
    zero, half, one = f32(0), f32(0.5), f32(1)
    per_voxel = one / np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    nudge = f32(1e-2) * per_voxel
    inverse = (
        one / d[0] if d[0] != zero else INFINITE, one / d[1] if d[1] != zero else INFINITE,
        one / d[2] if d[2] != zero else INFINITE,
    )  # fmt: skip
    t, end = inside_window(shape, o, d, t, end, nudge)
    t_before, before = -one, -one
    while t < end:
        x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
        i, j, k = np.int64(x + half), np.int64(y + half), np.int64(z + half)
        slot = window[((i >> 3) * shape[1] + (j >> 3)) * shape[2] + (k >> 3)]
        if slot < 0:
            steps = min(to_block_boundary(x + half, d[0], inverse[0]), to_block_boundary(y + half, d[1], inverse[1]))
            t += min(steps, to_block_boundary(z + half, d[2], inverse[2])) + nudge
            before = -one
            continue
        word = voxels[0][slot, ((i & 7) * 8 + (j & 7)) * 8 + (k & 7)]
        value = sdf_steps(word) * unit
        if ((word >> 8) & 0xFF) >= least and value > FAR:
            t_before, before = t, value
            t += (value - one) * per_voxel
            continue
        value, level = _value(window, shape, children, voxels, x, y, z, least, corners)
        value *= unit
        scale = f32(1 << level)  # the least step is a share of the voxels that were read
        if value > zero:
            t_before, before = t, value
            t += step_length(value * scale) / scale * per_voxel
        elif value <= zero:
            if before > zero:
                return _refine(window, shape, children, voxels, o, d, t_before, before, t, value, unit, least, corners)
            t += step_length(value * scale) / scale * per_voxel
        else:
            before = -one
            t += per_voxel
    return -one


@kernel
def _refine(window, shape, children, voxels, o, d, a, at_a, b, at_b, unit, least, corners):
    """Zero between depths ``a`` (outside) and ``b`` (inside) by false position (Illinois variant)."""
    side = 0
    t = a + (b - a) * at_a / (at_a - at_b)
    for _ in range(5):
        x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
        value, _level = _value(window, shape, children, voxels, x, y, z, least, corners)
        value *= unit
        if np.isnan(value) or abs(value) < f32(0.005):
            break
        if value > f32(0):
            a, at_a = t, value
            if side > 0:
                at_b *= f32(0.5)
            side = 1
        else:
            b, at_b = t, value
            if side < 0:
                at_a *= f32(0.5)
            side = -1
        t = a + (b - a) * at_a / (at_a - at_b)
    return t


@kernel
def _shade(window, shape, children, voxels, paint, x, y, z, least, corners, color, normal):
    """Colour (3,) uint8 and normal (3,) float32 at a lattice point on the surface; normal 0 where it has no slope."""
    _, level = _value(window, shape, children, voxels, x, y, z, least, corners)
    ax, ay, az = _words_at(level, window, shape, children, voxels, x, y, z, corners)
    gx, gy, gz = corner_gradient(
        sdf_steps(corners[0]), sdf_steps(corners[1]), sdf_steps(corners[2]), sdf_steps(corners[3]),
        sdf_steps(corners[4]), sdf_steps(corners[5]), sdf_steps(corners[6]), sdf_steps(corners[7]),
        ax, ay, az,
    )  # fmt: skip
    length = np.sqrt(gx * gx + gy * gy + gz * gz)
    scale = f32(1) / length if length > f32(0) else f32(0)
    normal[0], normal[1], normal[2] = gx * scale, gy * scale, gz * scale
    _words_at(level, window, shape, children, paint, x, y, z, corners)
    for channel in range(3):
        shift = 20 - 10 * channel
        value, _, _, _ = trilinear(
            f32((corners[0] >> shift) & 1023), f32((corners[1] >> shift) & 1023),
            f32((corners[2] >> shift) & 1023), f32((corners[3] >> shift) & 1023),
            f32((corners[4] >> shift) & 1023), f32((corners[5] >> shift) & 1023),
            f32((corners[6] >> shift) & 1023), f32((corners[7] >> shift) & 1023), ax, ay, az,
        )  # fmt: skip
        color[channel] = np.uint8(min(value * f32(0.25) + f32(0.5), f32(255)))


@kernel
def _trace_rows(
    row_start, row_stop, window, shape, children, voxels, paint, intrinsics, T, near, far, depth_min, depth_max, unit,
    least, depth, color, normals,
):  # fmt: skip
    """Fill pixel rows ``row_start`` to ``row_stop`` of a view; see ``raycasting.trace_rows``."""
    corners = np.empty(8, np.int32)
    o, d = T[:, 3].copy(), np.empty(3, f32)
    for v in range(row_start, row_stop):
        y = ray(v, intrinsics[3], intrinsics[1])
        for u in range(depth.shape[1]):
            start = max(near[v // TILE, u // TILE], depth_min)
            end = min(far[v // TILE, u // TILE], depth_max)
            t = f32(-1)
            if start < end:
                x = ray(u, intrinsics[2], intrinsics[0])
                for axis in range(3):
                    d[axis] = T[axis, 0] * x + T[axis, 1] * y + T[axis, 2]
                t = _trace(window, shape, children, voxels, o, d, start, end, unit, least, corners)
            if t > f32(0) and t <= depth_max:
                depth[v, u] = t
                _shade(
                    window, shape, children, voxels, paint, o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2], least,
                    corners, color[v, u], normals[v, u],
                )  # fmt: skip
            else:
                depth[v, u] = 0
                color[v, u, :] = 0
                normals[v, u, :] = 0


def raycast(
    grid: VoxelGrid,
    levels: FinerLevels,
    T_world_camera: NDArray[np.float64],
    intrinsics: NDArray[np.float32],
    size: tuple[int, int],
    parameters: RaycastParameters,
) -> RaycastResult:
    """View of a map by its finest voxels; ``grid`` is the coarsest level, other arguments as of ``Backend.raycast``."""
    grid = grid.on_host()
    low, high = f32(parameters.depth_min), f32(parameters.depth_max)
    near, far = tile_depths(grid, T_world_camera, intrinsics, size, low, high)
    _, to_lattice, _ = motions(grid, T_world_camera)
    depth = np.empty(size, dtype=np.float32)
    color = np.empty((*size, 3), dtype=np.uint8)
    normals = np.empty((*size, 3), dtype=np.float32)
    unit, least = f32(grid.sdf_unit / grid.voxel_size), max(int(parameters.min_weight), 1)
    voxels, paint = (np.asarray(grid.geometry), *levels.geometry), (np.asarray(grid.colors), *levels.colors)
    run_bands(
        lambda start, stop: _trace_rows(
            start, stop, grid.window, grid.shape, levels.children, voxels, paint, intrinsics, to_lattice, near, far,
            low, high, unit, least, depth, color, normals,
        ),
        bands(size[0], BAND),
    )  # fmt: skip
    return RaycastResult(depth, color, normals)
