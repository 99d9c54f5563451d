"""Loops over the label image: histogram of residuals, log odds, comparison with older frames, opening of a mask.

One thread per pixel; the loops are those of ``evidence``, ``reprojection`` and ``segmentation`` in ``kernels/``.
"""

import warp as wp

from dudmap.gpu.kernels.formulas import (
    Motion,
    edge_tolerance,
    noise_limit,
    project,
    ray,
    residual_bin,
    static_sigma,
    surface_log_odds,
    transform,
)
from dudmap.gpu.kernels.structs import Camera, EvidenceParameters, NoiseParameters
from dudmap.kernels import evidence, parameters, reprojection

wp.set_module_options({"enable_backward": False})

BINS = wp.constant(evidence.BINS)
UNKNOWN, SURFACE, FREE = (wp.constant(n) for n in (parameters.UNKNOWN, parameters.SURFACE, parameters.FREE))
NEAREST = wp.constant(wp.float32(float(reprojection.NEAREST)))
LEAST_WEIGHT = wp.constant(wp.float32(float(reprojection.LEAST_WEIGHT)))
FAR = wp.constant(wp.float32(1.0e9))
Image = wp.array2d(dtype=wp.float32)
Bytes = wp.array2d(dtype=wp.uint8)
Counts = wp.array(dtype=wp.int32)
Labels = wp.array2d(dtype=wp.int32)
Sums = wp.array2d(dtype=wp.int64)
RUN = wp.constant(8)
"""Pixels of a row that one thread adds up over segments."""
PER_SIGMA, PER_UNIT = wp.constant(wp.float32(2.0**20)), wp.constant(wp.float32(2.0**30))
"""Steps of the sums over segments, per standard deviation of a distance and per unit of the intensity: the sums over
any image are exact in 64 bits."""
LEAST_SHARE = wp.constant(wp.float32(float(evidence.LEAST_SHARE)))


@wp.kernel
def reading_noise(depth: Image, p: NoiseParameters, sigma: Image, tolerance: Image, gap: Image, bounded: Image):
    """Noise of each reading: see ``evidence.reading_noise``."""
    v, u = wp.tid()
    z = depth[v, u]
    s = static_sigma(z, p.base, p.scale, p.map_variance)
    sigma[v, u] = s
    tolerance[v, u] = edge_tolerance(s, z, p.edge_sigmas, p.edge_slope)
    gap[v, u] = p.gap * noise_limit(s, p.floor, p.sigmas)
    bounded[v, u] = max(p.least_sigma, s)


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
    """Gap to an older frame, its intensity and its mark at a point, as of ``reprojection.Reprojection``; the gap is NaN
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


@wp.kernel
def marked_within(
    depth: Image, camera: Camera, t: Motion, old_depth: Image, old_intensity: Image, old_marks: Bytes,
    max_gap: wp.float32, out: Bytes,
):  # fmt: skip
    """Points that a marked reading of an older frame shows: see ``evidence.seen_marked``."""
    v, u = wp.tid()
    gap, _grey, mark = older(depth[v, u], v, u, camera, t, old_depth, old_intensity, old_marks)
    found = int(0)
    if mark > 0 and abs(gap) < max_gap:
        found = 1
    out[v, u] = wp.uint8(found)


@wp.kernel
def compare_with_frame(
    depth: Image, intensity: Image, camera: Camera, t: Motion, old_depth: Image, old_intensity: Image,
    old_marks: Bytes, sigma: Image, max_sigmas: wp.float32, distance: Image, difference: Image, occupancy: Bytes,
    moving: Bytes,
):  # fmt: skip
    """An older frame in place of a sample of the map, and the points that are not where it has seen them."""
    v, u = wp.tid()
    gap, grey, _mark = older(depth[v, u], v, u, camera, t, old_depth, old_intensity, old_marks)
    space, moves = UNKNOWN, int(0)
    if not wp.isnan(gap):
        space = SURFACE
        if abs(gap) > max_sigmas * sigma[v, u]:
            moves = 1
    distance[v, u] = gap
    difference[v, u] = grey - intensity[v, u]
    occupancy[v, u] = wp.uint8(space)
    moving[v, u] = wp.uint8(moves)


@wp.kernel
def count_segments(labels: Labels, mask: Bytes, counts: Counts, all_: int, first: int):
    """Pixels of each segment in a mask, from ``counts[first]`` on; without one where ``all_`` is not 0.

    One thread per run of pixels of a row, which adds to the count of a segment once per stretch of it.
    """
    v, run = wp.tid()
    last, count = int(-1), int(0)
    for k in range(RUN):
        u = run * RUN + k
        if u < labels.shape[1]:
            n = labels[v, u]
            if n != last:
                if count > 0:
                    wp.atomic_add(counts, first + last, count)
                last = n
                count = 0
            inside = all_
            if all_ == 0:
                inside = wp.int32(mask[v, u])
            if inside != 0:
                count += 1
    if count > 0:
        wp.atomic_add(counts, first + last, count)


@wp.func
def reflected(n: int, size: int):
    """Index of a pixel mirrored at the borders of an image, without repeating the outermost one."""
    m = n
    if m < 0:
        m = -m
    if m >= size:
        m = 2 * size - 2 - m
    return m


@wp.kernel
def compare_with_map(
    difference: Image, occupancy: Bytes, intensity: Image, gain: wp.float32, offset: wp.float32, labels: Labels,
    started: wp.array(dtype=wp.uint8), dynamic: Bytes, radius: int, mean: Image, out: Bytes,
):  # fmt: skip
    """Mean difference of the compared pixels of a window, and the dynamic pixels: see ``evidence.compare_segments``."""
    v, u = wp.tid()
    h, w = labels.shape[0], labels.shape[1]
    total, count = float(0.0), float(0.0)
    for dv in range(-radius, radius + 1):
        for du in range(-radius, radius + 1):
            y, x = reflected(v + dv, h), reflected(u + du, w)
            if wp.int32(occupancy[y, x]) == SURFACE:
                count += wp.float32(1.0)
                value = difference[y, x] + ((wp.float32(1.0) - gain) * intensity[y, x] - offset)
                if not wp.isnan(value):
                    total += value
    side = wp.float32(2 * radius + 1)
    share = wp.float32(1.0) / (side * side)
    mean[v, u] = total * share / max(count * share, LEAST_SHARE)
    moving = wp.int32(dynamic[v, u])
    if wp.int32(occupancy[v, u]) == UNKNOWN and started[labels[v, u]] == wp.uint8(0):
        moving = 0
    out[v, u] = wp.uint8(moving)


@wp.func
def flush(sums: Sums, n: int, counts: wp.vec4i, distance: wp.int64, difference: wp.int64, gradient: wp.int64):
    """Add what a stretch of pixels has gathered to the sums of its segment."""
    if n > 0:
        for column in range(4):
            if counts[column] != 0:
                wp.atomic_add(sums, n, column, wp.int64(counts[column]))
        if counts[3] != 0:
            wp.atomic_add(sums, n, 4, distance)
            wp.atomic_add(sums, n, 5, difference)
            wp.atomic_add(sums, n, 6, gradient)


@wp.kernel
def add_segments(
    labels: Labels, occupancy: Bytes, moving: Bytes, distance: Image, sigma: Image, mean: Image, gradient: Image,
    sums: Sums,
):  # fmt: skip
    """Sums over segments but for the last column: see ``segmentation.add_segment_sums``.

    They are sums of whole multiples of a step, which are exact, so that they do not depend on the order.
    """
    v, run = wp.tid()
    last = int(0)
    counts = wp.vec4i()
    far, apart, steep = wp.int64(0), wp.int64(0), wp.int64(0)
    for k in range(RUN):
        u = run * RUN + k
        if u < labels.shape[1]:
            n = labels[v, u]
            if n != last:
                flush(sums, last, counts, far, apart, steep)
                last = n
                counts = wp.vec4i()
                far = wp.int64(0)
                apart = wp.int64(0)
                steep = wp.int64(0)
            compared, moves = int(0), int(0)
            if wp.int32(occupancy[v, u]) == SURFACE:
                compared = 1
            if moving[v, u] != wp.uint8(0):
                moves = 1
            static = compared * (1 - moves)
            counts = counts + wp.vec4i(1, compared, moves, static)
            if static == 1:
                far += wp.int64(distance[v, u] / sigma[v, u] * PER_SIGMA)
                apart += wp.int64(mean[v, u] * PER_UNIT)
                steep += wp.int64(gradient[v, u] * PER_UNIT)
    flush(sums, last, counts, far, apart, steep)


@wp.kernel
def add_deviations(labels: Labels, occupancy: Bytes, moving: Bytes, mean: Image, sums: Sums):
    """The last column of the sums over segments, when the others are known."""
    v, run = wp.tid()
    last = int(0)
    total = wp.int64(0)
    middle = wp.float32(0.0)
    for k in range(RUN):
        u = run * RUN + k
        if u < labels.shape[1]:
            n = labels[v, u]
            if n != last:
                if last > 0:
                    wp.atomic_add(sums, last, 7, total)
                last = n
                total = wp.int64(0)
                middle = wp.float32(sums[n, 5]) / PER_UNIT / wp.float32(max(sums[n, 3], wp.int64(1)))
            if wp.int32(occupancy[v, u]) == SURFACE and moving[v, u] == wp.uint8(0):
                total += wp.int64(abs(mean[v, u] - middle) * PER_UNIT)
    if last > 0:
        wp.atomic_add(sums, last, 7, total)
