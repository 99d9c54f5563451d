"""A map with several voxel sizes seen from a pose: sphere tracing as in ``raycasting.py``, by the finest voxels."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.finest import corners_at, finest_at, least_weight
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
    """Two finer levels of a map, as views read them; one that the map does not have holds no children.

    Attributes:
        children1, children2: (slots of the next coarser level, 8) int32: slot of the block with half the voxel size in
            each octant of a block, -1 = none. There may be fewer rows than slots: those have no children.
        geometry1, geometry2: (slots, 512) int32 packed voxels of the levels.
        colors1, colors2: (slots, 512) int32 packed colours.
    """

    children1: NDArray[np.int32]
    children2: NDArray[np.int32]
    geometry1: NDArray[np.int32]
    geometry2: NDArray[np.int32]
    colors1: NDArray[np.int32]
    colors2: NDArray[np.int32]


@scalar
def _value(window, shape, tree, voxels, x, y, z, least, corners):
    """Signed distance in stored steps at a lattice point by the finest voxels that are known, and their level; NaN
    where none are."""
    children1, children2 = tree
    level = finest_at(window, shape, children1, children2, x, y, z)
    while level >= 0:
        ax, ay, az = corners_at(
            level, window, shape, children1, children2, voxels[0], voxels[1], voxels[2], x, y, z, corners
        )
        if least_weight(corners) >= least:
            value, _, _, _ = trilinear(
                sdf_steps(corners[0, 0]), sdf_steps(corners[1, 0]), sdf_steps(corners[2, 0]), sdf_steps(corners[3, 0]),
                sdf_steps(corners[4, 0]), sdf_steps(corners[5, 0]), sdf_steps(corners[6, 0]), sdf_steps(corners[7, 0]),
                ax, ay, az,
            )  # fmt: skip
            return value, level
        level -= 1
    return f32(np.nan), 0


@scalar
def _trace(window, shape, tree, voxels, o, d, t, end, unit, least, corners):
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
        word = voxels[0][np.int64(slot) * 512 + (((i & 7) * 8 + (j & 7)) * 8 + (k & 7))]
        value = sdf_steps(word) * unit
        if ((word >> 8) & 0xFF) >= least and value > FAR:
            t_before, before = t, value
            t += (value - one) * per_voxel
            continue
        value, level = _value(window, shape, tree, voxels, x, y, z, least, corners)
        value *= unit
        scale = f32(1 << level)  # the least step is a share of the voxels that were read
        if value > zero:
            t_before, before = t, value
            t += step_length(value * scale) / scale * per_voxel
        elif value <= zero:
            if before > zero:
                return _refine(window, shape, tree, voxels, o, d, t_before, before, t, value, unit, least, corners)
            t += step_length(value * scale) / scale * per_voxel
        else:
            before = -one
            t += per_voxel
    return -one


@kernel
def _refine(window, shape, tree, voxels, o, d, a, at_a, b, at_b, unit, least, corners):
    """Zero between depths ``a`` (outside) and ``b`` (inside) by false position (Illinois variant)."""
    side = 0
    t = a + (b - a) * at_a / (at_a - at_b)
    for _ in range(5):
        x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
        value, _level = _value(window, shape, tree, voxels, x, y, z, least, corners)
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
def _shade(window, shape, tree, voxels, paint, x, y, z, least, corners, color, normal):
    """Colour (3,) uint8 and normal (3,) float32 at a lattice point on the surface; normal 0 where it has no slope."""
    children1, children2 = tree
    _, level = _value(window, shape, tree, voxels, x, y, z, least, corners)
    ax, ay, az = corners_at(
        level, window, shape, children1, children2, voxels[0], voxels[1], voxels[2], x, y, z, corners
    )
    gx, gy, gz = corner_gradient(
        sdf_steps(corners[0, 0]), sdf_steps(corners[1, 0]), sdf_steps(corners[2, 0]), sdf_steps(corners[3, 0]),
        sdf_steps(corners[4, 0]), sdf_steps(corners[5, 0]), sdf_steps(corners[6, 0]), sdf_steps(corners[7, 0]),
        ax, ay, az,
    )  # fmt: skip
    length = np.sqrt(gx * gx + gy * gy + gz * gz)
    scale = f32(1) / length if length > f32(0) else f32(0)
    normal[0], normal[1], normal[2] = gx * scale, gy * scale, gz * scale
    corners_at(level, window, shape, children1, children2, paint[0], paint[1], paint[2], x, y, z, corners)
    for channel in range(3):
        shift = 20 - 10 * channel
        value, _, _, _ = trilinear(
            f32((corners[0, 0] >> shift) & 1023), f32((corners[1, 0] >> shift) & 1023),
            f32((corners[2, 0] >> shift) & 1023), f32((corners[3, 0] >> shift) & 1023),
            f32((corners[4, 0] >> shift) & 1023), f32((corners[5, 0] >> shift) & 1023),
            f32((corners[6, 0] >> shift) & 1023), f32((corners[7, 0] >> shift) & 1023), ax, ay, az,
        )  # fmt: skip
        color[channel] = np.uint8(min(value * f32(0.25) + f32(0.5), f32(255)))


@kernel
def _trace_rows(
    row_start, row_stop, window, shape, tree, voxels, paint, intrinsics, T, near, far, depth_min, depth_max, unit,
    least, depth, color, normals,
):  # fmt: skip
    """Fill pixel rows ``row_start`` to ``row_stop`` of a view; see ``raycasting.trace_rows``."""
    corners = np.empty((8, 1), np.int32)
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
                t = _trace(window, shape, tree, voxels, o, d, start, end, unit, least, corners)
            if t > f32(0) and t <= depth_max:
                depth[v, u] = t
                _shade(
                    window, shape, tree, voxels, paint, o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2], least,
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
    tree = levels.children1, levels.children2
    low, high = f32(parameters.depth_min), f32(parameters.depth_max)
    near, far = tile_depths(grid, T_world_camera, intrinsics, size, low, high)
    _, to_lattice, _ = motions(grid, T_world_camera)
    depth = np.empty(size, dtype=np.float32)
    color = np.empty((*size, 3), dtype=np.uint8)
    normals = np.empty((*size, 3), dtype=np.float32)
    unit, least = f32(grid.sdf_unit / grid.voxel_size), max(int(parameters.min_weight), 1)
    voxels = (np.asarray(grid.geometry).reshape(-1), levels.geometry1, levels.geometry2)
    paint = (np.asarray(grid.colors).reshape(-1), levels.colors1, levels.colors2)
    run_bands(
        lambda start, stop: _trace_rows(
            start, stop, grid.window, grid.shape, tree, voxels, paint, intrinsics, to_lattice, near, far,
            low, high, unit, least, depth, color, normals,
        ),
        bands(size[0], BAND),
    )  # fmt: skip
    return RaycastResult(depth, color, normals)
