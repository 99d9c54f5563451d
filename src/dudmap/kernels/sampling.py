"""What the map says at the points of a depth image."""

import numpy as np

from dudmap.kernels.threads import kernel


@kernel
def sample_map(
    row_start,
    row_stop,
    depth,
    intensity,
    intrinsics,
    T,
    window,
    shape,
    geometry,
    unit,
    free_count,
    free_after,
    distance,
    difference,
    place,
):
    """What the map says at the points of a depth image.

    Args:
        row_start, row_stop: Rows of the band.
        depth: (h, w) float32.
        intensity: (h, w) float32 in [0, 1].
        intrinsics: (4,) float32.
        T: (3, 4) float32, camera to window lattice, voxel units.
        window: (cells,) int32.
        shape: (3,) int64.
        geometry: (slots * 512,) int32.
        unit: sdf_unit, metres.
        free_count: (entries,) uint8 observations of emptiness of blocks without voxels.
        free_after: Observations that make free space.
        distance: (h, w) float32 out, metres, NaN where the map has no distance.
        difference: (h, w) float32 out, map minus image intensity, NaN likewise.
        place: (h, w) uint8 out: 0 no reading or unknown space, 1 on the map, 2 in confirmed free space.
    """
    nan = np.float32(np.nan)
    for v in range(row_start, row_stop):
        for u in range(depth.shape[1]):
            z = depth[v, u]
            distance[v, u], difference[v, u], place[v, u] = nan, nan, 0
            if z <= 0:
                continue
            x = (np.float32(u) - intrinsics[2]) / intrinsics[0] * z
            y = (np.float32(v) - intrinsics[3]) / intrinsics[1] * z
            gx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            gy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            gz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            ix, iy, iz = np.int64(np.floor(gx)), np.int64(np.floor(gy)), np.int64(np.floor(gz))
            if ix < 0 or iy < 0 or iz < 0 or ix >= shape[0] * 8 - 1 or iy >= shape[1] * 8 - 1 or iz >= shape[2] * 8 - 1:
                continue
            slot = window[((ix >> 3) * shape[1] + (iy >> 3)) * shape[2] + (iz >> 3)]
            if slot < 0:
                if slot <= -2 and free_count[-2 - slot] >= free_after:
                    place[v, u] = 2
                continue
            sdf, shade, total = np.float32(0), np.float32(0), np.float32(0)
            ax, ay, az = gx - np.float32(ix), gy - np.float32(iy), gz - np.float32(iz)
            for k in range(8):
                i, j, m = ix + (k >> 2), iy + ((k >> 1) & 1), iz + (k & 1)
                other = window[((i >> 3) * shape[1] + (j >> 3)) * shape[2] + (m >> 3)]
                if other < 0:
                    continue
                word = geometry[np.int64(other) * 512 + (((i & 7) * 8 + (j & 7)) * 8 + (m & 7))]
                if (word & 0xFF00) == 0:
                    continue
                part = (ax if k >> 2 else 1 - ax) * (ay if (k >> 1) & 1 else 1 - ay) * (az if k & 1 else 1 - az)
                sdf += part * np.float32(word >> 16)
                shade += part * np.float32(word & 0xFF)
                total += part
            if total < np.float32(0.5):
                continue
            distance[v, u] = sdf / total * unit
            difference[v, u] = shade / total / np.float32(255) - intensity[v, u]
            place[v, u] = 1
