"""Signed distance, intensity difference and occupancy of the map at a depth image's points."""

import numpy as np

from dudmap.core.backends.cpu.neighbors import AHEAD, last_corner, load_row, locate
from dudmap.core.backends.cpu.teams import NO_BAND, done, finish, first_band, take, wait_for_all
from dudmap.core.backends.cpu.vectors import wide_vectors
from dudmap.core.backends.parameters import FREE, SURFACE, UNKNOWN
from dudmap.core.backends.threads import kernel, scalar
from dudmap.core.formulas.pixel import elements, ray, transform
from dudmap.core.formulas.voxel import intensity_of, sdf_steps

f32, f64 = np.float32, np.float64


@scalar
def corner_weight(k, ax, ay, az):
    """Trilinear weight of corner k = 4 dx + 2 dy + dz at (ax, ay, az) in [0, 1]^3, float64."""
    one = f64(1)
    x, y, z = f64(ax), f64(ay), f64(az)
    return (x if k >> 2 != 0 else one - x) * (y if (k >> 1) & 1 != 0 else one - y) * (z if k & 1 != 0 else one - z)


@scalar
def sample_rows(
    row_start, row_stop, depth, intensity, intrinsics, T, window, shape, geometry, sdf_unit, free_count, free_after,
    distance, difference, occupancy,
):  # fmt: skip
    """Sample the map at the points of pixel rows; known corners need half of the weight. Rows are in stages, see
    ``registration.py``.

    Args:
        depth, intensity, intrinsics: See ``LevelImage``.
        T: (3, 4) float32, camera to the window's lattice, voxels.
        window, shape, geometry, sdf_unit, free_count: See ``VoxelGrid``; ``geometry`` is flat.
        free_after: Observations of free space.
        distance, difference, occupancy: Out, see ``MapSample``.
    """
    wide_vectors()
    w = depth.shape[1]
    nan, half, zero = f32(np.nan), f64(0.5), f64(0)
    cells, voxels, crossing = np.zeros(w + AHEAD, np.int32), np.zeros(w + AHEAD, np.int32), np.empty(w, np.int32)
    outer, words = np.empty(w, np.int32), np.empty((8, -(-w // 8) * 8), np.int32)
    slots = np.empty(w, np.int32)
    fractions, inside = np.empty((3, w), np.float32), np.empty(w, np.uint8)
    last, size_y, size_z = last_corner(shape), shape[1], shape[2]
    t = elements(T)
    for v in range(row_start, row_stop):
        row_y = ray(v, intrinsics[3], intrinsics[1])
        for u in range(w):
            z = depth[v, u]
            gx, gy, gz = transform(t, ray(u, intrinsics[2], intrinsics[0]) * z, row_y * z, z)
            cells[u], voxels[u], crosses, within, ax, ay, az = locate(gx, gy, gz, last, size_y, size_z)
            ok = within & (z > f32(0))
            crossing[u] = crosses if ok else np.int32(0)
            fractions[0, u], fractions[1, u], fractions[2, u] = ax, ay, az
            inside[u] = ok
        load_row(window, shape, geometry, cells, voxels, crossing, outer, words)
        for u in range(w):
            slots[u] = window[np.uintp(cells[u])] if inside[u] > 0 else np.int32(-1)
        for u in range(w):
            sdf, total, shade, shaded = zero, zero, zero, zero
            for k in range(8):
                word = words[k, u]
                part = corner_weight(k, fractions[0, u], fractions[1, u], fractions[2, u])
                part = part if (word & 0xFF00) != 0 else zero
                sdf += part * sdf_steps(word)
                total += part
                intensity_part = part if intensity_of(word) > f32(0) else zero
                shade += intensity_part * intensity_of(word)
                shaded += intensity_part
            near = (slots[u] >= 0) & (total >= half)
            distance[v, u] = f32(sdf / total * sdf_unit) if near else nan
            lit = near & (shaded > zero)
            difference[v, u] = f32(shade / shaded / f64(255) - intensity[v, u]) if lit else nan
            occupancy[v, u] = SURFACE if near else UNKNOWN
        for u in range(w):
            if slots[u] <= -2 and free_count[np.uintp(-2 - slots[u])] >= free_after:
                occupancy[v, u] = FREE


@kernel
def sample(
    leads, team, rows, depth, intensity, intrinsics, T, window, shape, geometry, sdf_unit, free_count, free_after,
    distance, difference, occupancy,
):  # fmt: skip
    """``sample_rows`` of an image, ``rows`` per band, for a team of threads."""
    wide_vectors()
    height = depth.shape[0]
    num_bands = -(-height // rows)
    band, _ = first_band(leads, team, 0, num_bands)
    while band != NO_BAND:
        sample_rows(
            band * rows, min(band * rows + rows, height), depth, intensity, intrinsics, T, window, shape, geometry,
            sdf_unit, free_count, free_after, distance, difference, occupancy,
        )  # fmt: skip
        done(team)
        band, _ = take(team, num_bands)
    if leads:
        wait_for_all(team, num_bands)
        finish(team)
