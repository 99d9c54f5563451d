"""Fusion of a depth image into the blocks in view (thesis section 4.5, algorithm 1).

The arithmetic equals ``core/backends/cpu/integration.py``.
"""

import warp as wp

from dudmap.core.backends.warp.kernels.formulas import (
    Motion,
    fuse_color,
    fuse_voxel,
    is_occupied,
    project,
    transform,
)
from dudmap.core.backends.warp.kernels.structs import Camera, FusionParameters

wp.set_module_options({"enable_backward": False})

Indices = wp.array(dtype=wp.int32)


@wp.kernel
def integrate(
    slots: Indices, repeats: wp.array(dtype=wp.float32), coords: wp.array2d(dtype=wp.int32), t: Motion, camera: Camera,
    height: int, width: int, pixels: wp.array2d(dtype=wp.int32), geometry: wp.array2d(dtype=wp.int32),
    colors: wp.array2d(dtype=wp.int32), p: FusionParameters, occupied: Indices,
):  # fmt: skip
    """One voxel per thread: see ``integration.integrate_blocks``. Integer counts do not depend on the order.

    ``coords`` (n, 3) are the coordinates of ``slots`` (n,).
    """
    block, n = wp.tid()
    slot = slots[block]
    half, one = wp.float32(0.5), wp.float32(1.0)
    ox = wp.float32(coords[block, 0] * 8) * p.voxel_size
    oy = wp.float32(coords[block, 1] * 8) * p.voxel_size
    oz = wp.float32(coords[block, 2] * 8) * p.voxel_size
    x = wp.float32(n / 64) * p.voxel_size
    y = wp.float32((n / 8) % 8) * p.voxel_size
    z = wp.float32(n % 8) * p.voxel_size
    bx, by, bz = transform(t, ox, oy, oz)
    lx = t[0] * x + t[1] * y + t[2] * z
    ly = t[4] * x + t[5] * y + t[6] * z
    lz = t[8] * x + t[9] * y + t[10] * z
    depth = bz + lz
    by_z = one / max(depth, wp.float32(1.0e-3))
    u = wp.floor(project(bx + lx, by_z, camera.fx, camera.cx + half))
    v = wp.floor(project(by + ly, by_z, camera.fy, camera.cy + half))
    reading, color = int(0), int(0)
    if depth > 0.05 and u >= 0.0 and v >= 0.0 and u < wp.float32(width) and v < wp.float32(height):
        pixel = wp.int32(v) * width + wp.int32(u)
        reading = pixels[pixel, 0]
        color = pixels[pixel, 1]
    word, share = fuse_voxel(geometry[slot, n], reading, color, depth, repeats[block], one / p.sdf_unit, p)
    geometry[slot, n] = word
    if share != wp.float32(0.0):
        colors[slot, n] = fuse_color(colors[slot, n], color, share)
    if is_occupied(word, p):
        wp.atomic_add(occupied, block, 1)
