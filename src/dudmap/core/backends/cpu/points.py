"""Trilinear samples of the whole map at any points, through the hash table."""

import numpy as np

from dudmap.core.backends.cpu.hashing import place_of
from dudmap.core.backends.threads import kernel

UNSEEN, OBSERVED, EMPTY = 0, 1, 2
"""State of a point: a voxel around it was never observed; all were observed; all lie in free blocks."""
SDF, WEIGHT, INTENSITY, RED = 0, 4, 5, 9
"""First columns of ``sample_points``: distance (steps) and gradient (per voxel), weight, intensity and gradient, colour
(quarters of a grey level)."""
COLUMNS = 12


@kernel
def sample_points(table, coords, slot_of, free_count, geometry, colors, points, motion, free_steps, free_weight):
    """Samples (n, COLUMNS) float32 and states (n,) uint8 of a map at points (n, 3), in voxels.

    - Points are first moved by a motion (3, 4).
    - Distance and intensity are trilinear, with gradients; the intensity is 0 if a voxel has none.
    - Colour is of the voxels that have one, else 0.
    - Weight is the smallest.
    - A block without voxels, empty k times, has ``free_steps`` and ``k free_weight``.
    """
    out = np.zeros((len(points), 12), np.float32)
    states = np.zeros(len(points), np.uint8)
    sdf = np.empty(8, np.float64)
    shade = np.empty(8, np.float64)
    word = np.empty(8, np.int64)
    for n in range(len(points)):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        x = motion[0, 0] * px + motion[0, 1] * py + motion[0, 2] * pz + motion[0, 3]
        y = motion[1, 0] * px + motion[1, 1] * py + motion[1, 2] * pz + motion[1, 3]
        z = motion[2, 0] * px + motion[2, 1] * py + motion[2, 2] * pz + motion[2, 3]
        fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
        ix, iy, iz = np.int64(fx), np.int64(fy), np.int64(fz)
        ax, ay, az = x - fx, y - fy, z - fz
        weight, empty, shaded, known = 1e9, 0, 0, True
        bx, by, bz, entry = np.int64(1 << 40), np.int64(0), np.int64(0), -1
        for corner in range(8):
            vx, vy, vz = ix + (corner >> 2), iy + ((corner >> 1) & 1), iz + (corner & 1)
            if vx >> 3 != bx or vy >> 3 != by or vz >> 3 != bz:
                bx, by, bz = vx >> 3, vy >> 3, vz >> 3
                entry = table[place_of(table, coords, bx, by, bz)]
            if entry < 0:
                known = False
                break
            slot = slot_of[entry]
            if slot < 0:
                if free_count[entry] == 0:
                    known = False
                    break
                sdf[corner], shade[corner], word[corner] = free_steps, 0.0, 0
                weight = min(weight, free_weight * free_count[entry])
                empty += 1
                continue
            voxel = ((vx & 7) * 8 + (vy & 7)) * 8 + (vz & 7)
            packed = geometry[slot, voxel]
            if (packed >> 8) & 0xFF == 0:
                known = False
                break
            sdf[corner], shade[corner], word[corner] = packed >> 16, packed & 0xFF, colors[slot, voxel]
            shaded += (packed & 0xFF) > 0
            weight = min(weight, (packed >> 8) & 0xFF)
        if not known:
            continue
        states[n] = 2 if empty == 8 else 1
        out[n, 4] = weight
        by_color = 0.0
        for corner in range(8):
            sx, sy, sz = corner >> 2, (corner >> 1) & 1, corner & 1
            wx, wy, wz = ax if sx else 1 - ax, ay if sy else 1 - ay, az if sz else 1 - az
            dx, dy, dz = 2.0 * sx - 1, 2.0 * sy - 1, 2.0 * sz - 1
            out[n, 0] += wx * wy * wz * sdf[corner]
            out[n, 1] += dx * wy * wz * sdf[corner]
            out[n, 2] += wx * dy * wz * sdf[corner]
            out[n, 3] += wx * wy * dz * sdf[corner]
            if shaded == 8:
                out[n, 5] += wx * wy * wz * shade[corner]
                out[n, 6] += dx * wy * wz * shade[corner]
                out[n, 7] += wx * dy * wz * shade[corner]
                out[n, 8] += wx * wy * dz * shade[corner]
            if word[corner] != 0:
                share = wx * wy * wz
                by_color += share
                out[n, 9] += share * ((word[corner] >> 20) & 0x3FF)
                out[n, 10] += share * ((word[corner] >> 10) & 0x3FF)
                out[n, 11] += share * (word[corner] & 0x3FF)
        for channel in range(9, 12):
            out[n, channel] = out[n, channel] / by_color if by_color > 1e-6 else 0.0
    return out, states
