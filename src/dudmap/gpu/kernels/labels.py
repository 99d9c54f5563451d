"""Loops over the label image: histogram of residuals, log odds, comparison with older frames, opening of a mask.

One thread per pixel; the loops are those of ``kernels/evidence.py`` and ``kernels/segmentation.py``.
"""

import warp as wp

from dudmap.gpu.kernels.formulas import (
    Motion,
    noise_limit,
    project,
    ray,
    residual_bin,
    surface_log_odds,
    transform,
)
from dudmap.gpu.kernels.structs import Camera, EvidenceParameters
from dudmap.kernels import evidence, parameters, segmentation

wp.set_module_options({"enable_backward": False})

BINS = wp.constant(evidence.BINS)
UNKNOWN, SURFACE, FREE = (wp.constant(n) for n in (parameters.UNKNOWN, parameters.SURFACE, parameters.FREE))
NEAREST = wp.constant(wp.float32(float(segmentation.NEAREST)))
LEAST_WEIGHT = wp.constant(wp.float32(float(segmentation.LEAST_WEIGHT)))
FAR = wp.constant(wp.float32(1.0e9))
Image = wp.array2d(dtype=wp.float32)
Bytes = wp.array2d(dtype=wp.uint8)
Counts = wp.array(dtype=wp.int32)


@wp.kernel
def count_residuals(distance: Image, occupancy: Bytes, depth: Image, sigma: Image, counts: Counts):
    """Histogram of the residuals at surfaces, then the number of readings, then that of those in unknown space."""
    v, u = wp.tid()
    space = wp.int32(occupancy[v, u])
    if space == SURFACE:
        wp.atomic_add(counts, residual_bin(distance[v, u], sigma[v, u]), 1)
    if depth[v, u] > wp.float32(0.0):
        wp.atomic_add(counts, BINS, 1)
        if space == UNKNOWN:
            wp.atomic_add(counts, BINS + 1, 1)


@wp.kernel
def log_odds(
    distance: Image, occupancy: Bytes, sigma: Image, p: EvidenceParameters, free_space: int, seen: int,
    seen_free: Bytes, out: Image,
):  # fmt: skip
    """Log odds of each pixel alone: see ``evidence.log_odds``; ``seen_free`` counts where ``seen`` is not 0."""
    v, u = wp.tid()
    space = wp.int32(occupancy[v, u])
    odds = wp.float32(0.0)
    if space == SURFACE:
        s = sigma[v, u]
        noise = noise_limit(s, p.noise_floor, p.noise_sigmas)
        odds = surface_log_odds(distance[v, u], s, noise, p.offset, p.slope, p.limit)
    if free_space != 0:
        if space == FREE:
            odds = -p.limit
        elif seen != 0:
            if seen_free[v, u] != wp.uint8(0):
                odds = -p.limit
    out[v, u] = odds


@wp.func
def older(z: wp.float32, v: int, u: int, camera: Camera, t: Motion, depth: Image, intensity: Image, marks: Bytes):
    """Gap to an older frame, its intensity and its mark at a point, as of ``segmentation.Reprojection``; the gap is NaN
    where there is none."""
    zero, one = wp.float32(0.0), wp.float32(1.0)
    gap, grey, total, mark = float(wp.nan), float(0.0), float(0.0), int(0)
    x, y = ray(u, camera.cx, camera.fx) * z, ray(v, camera.cy, camera.fy) * z
    qx, qy, qz = transform(t, x, y, z)
    by_z = one / max(qz, NEAREST)
    pu, pv = project(qx, by_z, camera.fx, camera.cx), project(qy, by_z, camera.fy, camera.cy)
    fu, fv = wp.floor(pu), wp.floor(pv)
    last_u, last_v = wp.float32(depth.shape[1] - 1), wp.float32(depth.shape[0] - 1)
    if z > zero and qz > NEAREST and fu >= zero and fv >= zero and fu < last_u and fv < last_v:
        best = float(FAR)
        for k in range(4):
            across, down = k & 1, k >> 1
            y0, x0 = wp.int32(fv) + down, wp.int32(fu) + across
            reading = depth[y0, x0]
            if reading > zero:
                part = wp.where(across == 1, pu - fu, one - (pu - fu)) * wp.where(down == 1, pv - fv, one - (pv - fv))
                grey += part * intensity[y0, x0]
                total += part
                if abs(reading - qz) < abs(best):
                    best = reading - qz
                    mark = wp.int32(marks[y0, x0])
        if total > LEAST_WEIGHT:
            gap = best
    return gap, grey / max(total, LEAST_WEIGHT), mark


@wp.kernel
def count_views(
    depth: Image, noise: Image, camera: Camera, t: Motion, old_depth: Image, old_intensity: Image, old_marks: Bytes,
    first: int, free: wp.array2d(dtype=wp.int32), surface: wp.array2d(dtype=wp.int32),
):  # fmt: skip
    """Frames that have seen through each point, and those that have seen a surface there; begun anew by the first."""
    v, u = wp.tid()
    gap, _grey, _mark = older(depth[v, u], v, u, camera, t, old_depth, old_intensity, old_marks)
    through, at = int(0), int(0)
    if gap > noise[v, u]:
        through = 1
    if abs(gap) <= noise[v, u]:
        at = 1
    if first == 0:
        through += free[v, u]
        at += surface[v, u]
    free[v, u] = through
    surface[v, u] = at


@wp.kernel
def eroded_views(free: wp.array2d(dtype=wp.int32), surface: wp.array2d(dtype=wp.int32), radius: int, out: Bytes):
    """Pixels in the middle of a square of free ones; beyond the image all are."""
    v, u = wp.tid()
    whole = int(1)
    for y in range(max(v - radius, 0), min(v + radius + 1, out.shape[0])):
        for x in range(max(u - radius, 0), min(u + radius + 1, out.shape[1])):
            if free[y, x] == 0 or 2 * free[y, x] < surface[y, x]:
                whole = 0
    out[v, u] = wp.uint8(whole)


@wp.kernel
def dilated(image: Bytes, radius: int, out: Bytes):
    """Pixels in the middle of a square with a marked one."""
    v, u = wp.tid()
    any_ = int(0)
    for y in range(max(v - radius, 0), min(v + radius + 1, out.shape[0])):
        for x in range(max(u - radius, 0), min(u + radius + 1, out.shape[1])):
            if image[y, x] != wp.uint8(0):
                any_ = 1
    out[v, u] = wp.uint8(any_)
