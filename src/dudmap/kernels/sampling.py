"""Loop over the points of a depth image: signed distance, intensity difference and occupancy of the map there."""

import numpy as np

from dudmap.kernels.parameters import FREE, SURFACE, UNKNOWN
from dudmap.kernels.pixel import elements, ray, transform
from dudmap.kernels.threads import kernel
from dudmap.kernels.voxel import intensity_of, sdf_steps

f64 = np.float64


@kernel
def corner_weight(k, ax, ay, az):
    """Trilinear weight, float64, of corner k = 4 dx + 2 dy + dz at (ax, ay, az) in [0, 1]^3."""
    one = f64(1)
    x, y, z = f64(ax), f64(ay), f64(az)
    return (x if k >> 2 != 0 else one - x) * (y if (k >> 1) & 1 != 0 else one - y) * (z if k & 1 != 0 else one - z)


@kernel
def sample_rows(
    row_start, row_stop, depth, intensity, intrinsics, T, window, shape, geometry, sdf_unit, free_count, free_after,
    distance, difference, occupancy,
):  # fmt: skip
    """Sample the map at the points of pixel rows ``row_start`` to ``row_stop``.

    Corners without an observation are left out of the interpolation; a point needs half of the weight.

    Args:
        row_start, row_stop: Rows of the band.
        depth: (h, w) float32, metres, 0 = none.
        intensity: (h, w) float32 in [0, 1].
        intrinsics: (4,) float32.
        T: (3, 4) float32, camera to the window's lattice, voxels.
        window: (cells,) int32.
        shape: (3,) int64 blocks of the window.
        geometry: (slots * 512,) int32.
        sdf_unit: Metres per step of the stored distance.
        free_count: (entries,) uint8 observations of emptiness of blocks without voxels.
        free_after: Observations that make free space.
        distance: (h, w) float32 out, metres, NaN where the map has no distance.
        difference: (h, w) float32 out, map minus image intensity, NaN where the map has none.
        occupancy: (h, w) uint8 out: UNKNOWN (also without a reading), SURFACE or FREE.
    """
    nan = np.float32(np.nan)
    t = elements(T)
    for v in range(row_start, row_stop):
        for u in range(depth.shape[1]):
            z = depth[v, u]
            distance[v, u], difference[v, u], occupancy[v, u] = nan, nan, UNKNOWN
            if z <= 0:
                continue
            x, y = ray(u, intrinsics[2], intrinsics[0]) * z, ray(v, intrinsics[3], intrinsics[1]) * z
            gx, gy, gz = transform(t, x, y, z)
            ix, iy, iz = np.int64(np.floor(gx)), np.int64(np.floor(gy)), np.int64(np.floor(gz))
            if ix < 0 or iy < 0 or iz < 0 or ix >= shape[0] * 8 - 1 or iy >= shape[1] * 8 - 1 or iz >= shape[2] * 8 - 1:
                continue
            slot = window[((ix >> 3) * shape[1] + (iy >> 3)) * shape[2] + (iz >> 3)]
            if slot < 0:
                if slot <= -2 and free_count[-2 - slot] >= free_after:
                    occupancy[v, u] = FREE
                continue
            sdf, shade, total, shaded = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            ax, ay, az = gx - np.float32(ix), gy - np.float32(iy), gz - np.float32(iz)
            for k in range(8):
                i, j, m = ix + (k >> 2), iy + ((k >> 1) & 1), iz + (k & 1)
                other = window[((i >> 3) * shape[1] + (j >> 3)) * shape[2] + (m >> 3)]
                if other < 0:
                    continue
                word = geometry[np.int64(other) * 512 + (((i & 7) * 8 + (j & 7)) * 8 + (m & 7))]
                if (word & 0xFF00) == 0:
                    continue
                part = corner_weight(k, ax, ay, az)
                sdf += part * sdf_steps(word)
                total += part
                intensity_part = part if intensity_of(word) > 0 else np.float32(0)
                shade += intensity_part * intensity_of(word)
                shaded += intensity_part
            if total < np.float32(0.5):
                continue
            distance[v, u] = sdf / total * sdf_unit
            difference[v, u] = shade / shaded / np.float32(255) - intensity[v, u] if shaded > 0 else nan
            occupancy[v, u] = SURFACE
