"""Loops that cut a depth image into surfaces: along depth edges and where two surfaces meet in a hollow."""

import numpy as np

from dudmap.kernels.threads import kernel

STEP = np.float32(0.35)
"""Largest step off the plane of the neighbour within one piece, as a share of the largest depth step."""


@kernel
def concave_edges(depth, intrinsics, tolerance, reach, sine, normals, edge):
    """Pixels in a hollow: those between whose neighbours the surface turns towards the camera.

    With points a, b on either side of a pixel and their normals, (n_b - n_a) . (b - a) is negative in a hollow and
    positive on a ridge (Stein et al. 2014): a thing on the floor is cut off along its foot, the faces of a box hang
    together.

    Args:
        depth: (h, w) float32, metres, 0 = none.
        intrinsics: (4,) float32.
        tolerance: (h, w) float32, largest depth step to a neighbour of the same surface, metres.
        reach: Pixels from the middle to either side.
        sine: Least turn of the normals, as the sine of half the angle.
        normals: (h, w, 3) float32 out, camera frame, towards the camera; 0 = unknown.
        edge: (h, w) bool out.
    """
    h, w = depth.shape
    normals[:] = 0
    by_x, by_y = np.float32(1) / intrinsics[0], np.float32(1) / intrinsics[1]
    two = np.float32(2)
    for v in range(h):
        y = (np.float32(v) - intrinsics[3]) * by_y
        for u in range(w):
            z = depth[v, u]
            if z <= 0:
                continue
            left, right = _end(depth, tolerance, v, u, 0, -1), _end(depth, tolerance, v, u, 0, 1)
            up, down = _end(depth, tolerance, v, u, -1, 0), _end(depth, tolerance, v, u, 1, 0)
            if left + right == 0 or up + down == 0:
                continue
            x = (np.float32(u) - intrinsics[2]) * by_x
            zu = (depth[v, u + right] - depth[v, u - left]) / np.float32(left + right) * intrinsics[0]
            zv = (depth[v + down, u] - depth[v - up, u]) / np.float32(up + down) * intrinsics[1]
            # gradient of z over the image plane; towards the camera
            nx, ny, nz = zu, zv, -(z + x * zu + y * zv)
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            normals[v, u, 0], normals[v, u, 1], normals[v, u, 2] = nx / length, ny / length, nz / length
    for v in range(h):
        for u in range(w):
            edge[v, u] = False
            for k in range(2):
                dv, du = reach * k, reach * (1 - k)
                va, ua, vb, ub = v - dv, u - du, v + dv, u + du
                if va < 0 or ua < 0 or vb >= h or ub >= w:
                    continue
                za, zb, z = depth[va, ua], depth[vb, ub], depth[v, u]
                limit = np.float32(reach) * tolerance[v, u]
                if za <= 0 or zb <= 0 or z <= 0 or abs(za - z) > limit or abs(zb - z) > limit:
                    continue
                if normals[va, ua, 2] == 0 or normals[vb, ub, 2] == 0:
                    continue
                ex = ((np.float32(ub) - intrinsics[2]) * zb - (np.float32(ua) - intrinsics[2]) * za) * by_x
                ey = ((np.float32(vb) - intrinsics[3]) * zb - (np.float32(va) - intrinsics[3]) * za) * by_y
                ez = zb - za
                turn = (
                    (normals[vb, ub, 0] - normals[va, ua, 0]) * ex
                    + (normals[vb, ub, 1] - normals[va, ua, 1]) * ey
                    + (normals[vb, ub, 2] - normals[va, ua, 2]) * ez
                )
                if turn < -two * sine * np.sqrt(ex * ex + ey * ey + ez * ez):
                    edge[v, u] = True


@kernel
def _step(depth, intrinsics, normals, v, u, vn, un):
    """Height of a step between two pixels, metres: how far each lies off the other's plane, the smaller of both."""
    z, zn = depth[v, u], depth[vn, un]
    ex = ((np.float32(un) - intrinsics[2]) * zn - (np.float32(u) - intrinsics[2]) * z) / intrinsics[0]
    ey = ((np.float32(vn) - intrinsics[3]) * zn - (np.float32(v) - intrinsics[3]) * z) / intrinsics[1]
    ez = zn - z
    a = abs(normals[v, u, 0] * ex + normals[v, u, 1] * ey + normals[v, u, 2] * ez)
    b = abs(normals[vn, un, 0] * ex + normals[vn, un, 1] * ey + normals[vn, un, 2] * ez)
    return min(a, b)


@kernel
def _end(depth, tolerance, v, u, dv, du):
    """Pixels (0 to 2) that one can go in a direction without leaving the surface."""
    z = depth[v, u]
    for step in range(1, 3):
        vn, un = v + dv * step, u + du * step
        if vn < 0 or un < 0 or vn >= depth.shape[0] or un >= depth.shape[1]:
            return step - 1
        if depth[vn, un] <= 0 or abs(depth[vn, un] - z) > tolerance[v, u]:
            return step - 1
        z = depth[vn, un]
    return 2


@kernel
def segments(depth, intrinsics, tolerance, normals, edge, labels, passes):
    """Connected pieces of surface, cut along depth and concave edges; pixels on a concave edge join their neighbour.

    Args:
        depth, intrinsics, tolerance, normals, edge: See ``concave_edges``.
        labels: (h, w) int32 out: number from 1, 0 = no reading.
        passes: Pixels that a piece may reach into a hollow.

    Returns:
        Number of pieces.
    """
    h, w = depth.shape
    stack = np.empty(h * w, np.int32)
    labels[:] = 0
    count = 0
    for v0 in range(h):
        for u0 in range(w):
            if labels[v0, u0] != 0 or edge[v0, u0] or depth[v0, u0] <= 0:
                continue
            count += 1
            labels[v0, u0] = count
            stack[0] = v0 * w + u0
            top = 1
            while top > 0:
                top -= 1
                v, u = stack[top] // w, stack[top] % w
                z = depth[v, u]
                for k in range(4):
                    vn = v + (1 if k == 0 else -1 if k == 1 else 0)
                    un = u + (1 if k == 2 else -1 if k == 3 else 0)
                    if vn < 0 or un < 0 or vn >= h or un >= w or labels[vn, un] != 0:
                        continue
                    if edge[vn, un] or depth[vn, un] <= 0 or abs(depth[vn, un] - z) > tolerance[v, u]:
                        continue
                    if _step(depth, intrinsics, normals, v, u, vn, un) > STEP * tolerance[v, u]:
                        continue
                    labels[vn, un] = count
                    stack[top] = vn * w + un
                    top += 1
    for _ in range(passes):
        # pixels that join do so all at once: the result does not depend on the order of the scan
        for v in range(h):
            for u in range(w):
                if labels[v, u] != 0 or depth[v, u] <= 0:
                    continue
                best, owner = tolerance[v, u], 0
                for k in range(4):
                    vn = v + (1 if k == 0 else -1 if k == 1 else 0)
                    un = u + (1 if k == 2 else -1 if k == 3 else 0)
                    if vn < 0 or un < 0 or vn >= h or un >= w or labels[vn, un] <= 0:
                        continue
                    step = abs(depth[vn, un] - depth[v, u])
                    if step <= best:
                        best, owner = step, labels[vn, un]
                labels[v, u] = -owner
        for v in range(h):
            for u in range(w):
                labels[v, u] = abs(labels[v, u])
    return count


@kernel
def sums(labels, used, moving, distance, sigma, difference, gradient, out):
    """Sums over the pixels of each piece.

    Args:
        labels: (h, w) int32 numbers from 1, 0 = none.
        used: (h, w) bool, pixels whose distance and difference are known.
        moving: (h, w) bool.
        distance: (h, w) float32, metres.
        sigma: (h, w) float32, metres.
        difference: (h, w) float32, of intensities.
        gradient: (h, w) float32, intensity per pixel.
        out: (count + 1, 8) float64 out: pixels, used pixels, moving pixels, and over the used pixels that do not move
            the number, and the sums of distance / sigma, difference and gradient; last the sum over those of the
            difference's distance from its mean.
    """
    out[:] = 0.0
    h, w = labels.shape
    for v in range(h):
        for u in range(w):
            n = labels[v, u]
            if n == 0:
                continue
            out[n, 0] += 1
            if used[v, u]:
                out[n, 1] += 1
            if used[v, u] and not moving[v, u]:
                out[n, 3] += 1
                out[n, 4] += distance[v, u] / sigma[v, u]
                out[n, 5] += difference[v, u]
                out[n, 6] += gradient[v, u]
            if moving[v, u]:
                out[n, 2] += 1
    for v in range(h):
        for u in range(w):
            n = labels[v, u]
            if n > 0 and used[v, u] and not moving[v, u]:
                out[n, 7] += abs(difference[v, u] - out[n, 5] / out[n, 3])


@kernel
def reproject_difference(
    row_start, row_stop, depth, intensity, intrinsics, T, old_depth, old_intensity, old_marks, gap, difference, marks
):
    """A depth image against an older one of the same camera, seen from where the older one was.

    Args:
        row_start, row_stop: Rows of the band.
        depth, intensity: (h, w) float32.
        intrinsics: (4,) float32.
        T: (3, 4) float32, this camera to the older one.
        old_depth, old_intensity: (h, w) float32.
        old_marks: (h, w) uint8.
        gap: (h, w) float32 out: older reading minus this point's depth there, metres; the smallest among the four
            readings around it; NaN where there is none.
        difference: (h, w) float32 out: older minus this intensity, NaN likewise.
        marks: (h, w) uint8 out: that reading's mark.
    """
    h, w = depth.shape
    zero, one, nan, far = np.float32(0), np.float32(1), np.float32(np.nan), np.float32(1e9)
    by_fx, by_fy = one / intrinsics[0], one / intrinsics[1]
    place = np.empty(w, np.int32)
    seen = np.empty((4, w), np.float32)  # between the older pixels (2), depth there, inside
    readings, greys, old = np.empty((4, w), np.float32), np.empty((4, w), np.float32), np.empty((4, w), np.float32)
    last_u, last_v = np.float32(w - 1), np.float32(h - 1)
    flat_depth, flat_intensity, flat_marks = old_depth.reshape(-1), old_intensity.reshape(-1), old_marks.reshape(-1)
    for v in range(row_start, row_stop):
        row_y = (np.float32(v) - intrinsics[3]) * by_fy
        row = depth[v]
        for u in range(w):
            z = row[u]
            x, y = (np.float32(u) - intrinsics[2]) * by_fx * z, row_y * z
            qx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            qy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            qz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            by_z = one / max(qz, np.float32(0.05))
            pu = qx * by_z * intrinsics[0] + intrinsics[2]
            pv = qy * by_z * intrinsics[1] + intrinsics[3]
            fu, fv = np.floor(pu), np.floor(pv)
            ok = (z > zero) & (qz > np.float32(0.05)) & (fu >= zero) & (fv >= zero) & (fu < last_u) & (fv < last_v)
            place[u] = np.int32(fv * np.float32(w) + fu if ok else zero)
            seen[0, u], seen[1, u], seen[2, u], seen[3, u] = pu - fu, pv - fv, qz, one if ok else zero
        for u in range(w):
            first = np.int64(place[u])
            for k in range(4):
                n = np.uintp(first + (k >> 1) * w + (k & 1))
                readings[k, u], greys[k, u], old[k, u] = flat_depth[n], flat_intensity[n], np.float32(flat_marks[n])
        for u in range(w):
            au, av, qz, inside = seen[0, u], seen[1, u], seen[2, u], seen[3, u]
            best, mark, grey, total = far, zero, zero, zero
            for k in range(4):
                reading = readings[k, u]
                part = (au if k & 1 else one - au) * (av if k >> 1 else one - av)
                part = part if reading > zero else zero
                grey += part * greys[k, u]
                total += part
                step = reading - qz if reading > zero else far
                nearer = abs(step) < abs(best)
                best = step if nearer else best
                mark = old[k, u] if nearer else mark
            known = (inside > zero) & (total > np.float32(0.25))
            gap[v, u] = best if known else nan
            difference[v, u] = grey / max(total, np.float32(0.25)) - intensity[v, u] if known else nan
            marks[v, u] = np.int32(mark if inside > zero else zero)
