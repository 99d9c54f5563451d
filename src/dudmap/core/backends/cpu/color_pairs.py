"""Loops over points seen by two frames: intensity and depth differences, and derivatives.

Loads and tests are separate loops, so that the arithmetic of the rest is vectorised.
"""

import numpy as np

from dudmap.core.backends.cpu.vectors import wide_vectors
from dudmap.core.backends.threads import kernel, scalar
from dudmap.core.formulas.pixel import elements, rotate, sigma, transform

f32 = np.float32
UNKNOWNS = 21
SHARED, POSE = 13, 6
"""Unknowns: calibration (13), relative pose as a twist (6), gain and offset of the intensities (2)."""
MARGIN = f32(8)
"""Unused border of the colour images, pixels: twice the wider Gaussian."""
NEAREST = f32(0.05)
"""Smallest depth in the colour camera, metres."""
POINTS, PADDED = 1040, 16
"""Points processed together, and size of a portion."""


@scalar
def _central(image, u, v):
    i, j = int(u), int(v)
    a, b = u - f32(i), v - f32(j)
    p, q, r, s = image[j, i], image[j, i + 1], image[j + 1, i], image[j + 1, i + 1]
    value = (p + (q - p) * a) * (f32(1) - b) + (r + (s - r) * a) * b
    left = image[j, i - 1] + (image[j + 1, i - 1] - image[j, i - 1]) * b
    right = image[j, i + 2] + (image[j + 1, i + 2] - image[j, i + 2]) * b
    near, far = p + (r - p) * b, q + (s - q) * b
    top = image[j - 1, i] + (image[j - 1, i + 1] - image[j - 1, i]) * a
    bottom = image[j + 2, i] + (image[j + 2, i + 1] - image[j + 2, i]) * a
    above, below = p + (q - p) * a, r + (s - r) * a
    half = f32(0.5)
    du = half * ((far - left) * (f32(1) - a) + (right - near) * a)
    dv = half * ((below - top) * (f32(1) - b) + (bottom - above) * b)
    return value, du, dv


@scalar
def _seen(place, twist, intrinsics, lens, offset, readout, height, x, y, z):
    """Projection of a depth camera's point into a colour image.

    Args:
        place: Elements of T_color_depth.
        twist: (6) motion of the depth camera per second.
        intrinsics: (4) at the size of the image.
        lens: (5) k1, k2, p1, p2, k3.
        offset, readout: Seconds.
        height: Height of the image.
        x, y, z: The point.

    Returns:
        Pixel u, v; point in the colour camera; its motion per second of delay; coordinates at depth 1; radial factor
        and its growth; share of the readout.
    """
    ax = twist[0] + twist[4] * z - twist[5] * y
    ay = twist[1] + twist[5] * x - twist[3] * z
    az = twist[2] + twist[3] * y - twist[4] * x
    bx = twist[4] * az - twist[5] * ay
    by = twist[5] * ax - twist[3] * az
    bz = twist[3] * ay - twist[4] * ax
    x0, y0, z0 = transform(place, x, y, z)
    x1, y1, z1 = rotate(place, ax, ay, az)
    x2, y2, z2 = rotate(place, bx, by, bz)
    half, tau, share = f32(0.5), offset, f32(0)
    for _ in range(2):
        c = half * tau * tau
        row = (y0 - tau * y1 + c * y2) / max(z0 - tau * z1 + c * z2, NEAREST) * intrinsics[1] + intrinsics[3]
        share = (min(max(row, f32(0)), height) + half) / height - half
        tau = offset + readout * share
    c = half * tau * tau
    qx, qy, qz = x0 - tau * x1 + c * x2, y0 - tau * y1 + c * y2, z0 - tau * z1 + c * z2
    a, d = qx / qz, qy / qz
    r2 = a * a + d * d
    radial = f32(1) + r2 * (lens[0] + r2 * (lens[1] + r2 * lens[4]))
    growth = lens[0] + r2 * (f32(2) * lens[1] + f32(3) * r2 * lens[4])
    u = (a * radial + f32(2) * lens[2] * a * d + lens[3] * (r2 + f32(2) * a * a)) * intrinsics[0] + intrinsics[2]
    v = (d * radial + lens[2] * (r2 + f32(2) * d * d) + f32(2) * lens[3] * a * d) * intrinsics[1] + intrinsics[3]
    u = u if qz >= NEAREST else f32(-1)
    return u, v, qx, qy, qz, tau * x2 - x1, tau * y2 - y1, tau * z2 - z1, a, d, radial, growth, share


@scalar
def _by_point(seen, intrinsics, lens, su, sv):
    qz, a, d, radial, growth = seen[4], seen[8], seen[9], seen[10], seen[11]
    across = f32(2) * (a * d * growth + lens[2] * a + lens[3] * d)
    along_x = radial + f32(2) * (a * a * growth + lens[2] * d) + f32(6) * lens[3] * a
    along_y = radial + f32(2) * (d * d * growth + lens[3] * a) + f32(6) * lens[2] * d
    fu, fv = su * intrinsics[0] / qz, sv * intrinsics[1] / qz
    gx, gy = fu * along_x + fv * across, fu * across + fv * along_y
    return gx, gy, -(gx * a + gy * d)


@scalar
def _by_parameters(seen, place, intrinsics, scale, su, sv, g):
    u, v, a, d, share = seen[0], seen[1], seen[8], seen[9], seen[12]
    rx, ry, rz = seen[2] - place[3], seen[3] - place[7], seen[4] - place[11]
    r2 = a * a + d * d
    bent = (su * intrinsics[0] * a + sv * intrinsics[1] * d) * r2
    delay = g[0] * seen[5] + g[1] * seen[6] + g[2] * seen[7]
    return (
        g[0], g[1], g[2], ry * g[2] - rz * g[1], rz * g[0] - rx * g[2], rx * g[1] - ry * g[0],
        su * (u - intrinsics[2]) + sv * (v - intrinsics[3]), su * scale, sv * scale, bent, bent * r2, delay,
        delay * share,
    )  # fmt: skip


@scalar
def _back(place, g):
    return (
        place[0] * g[0] + place[4] * g[1] + place[8] * g[2],
        place[1] * g[0] + place[5] * g[1] + place[9] * g[2],
        place[2] * g[0] + place[6] * g[1] + place[10] * g[2],
    )


@scalar
def _along(g, a, b, c, d, e, f):
    return g[0] * a + g[1] * b + g[2] * c, g[0] * d + g[1] * e + g[2] * f


@scalar
def _padded(count):
    return (count + PADDED - 1) & -PADDED


@scalar
def _six(values):
    return values[0], values[1], values[2], values[3], values[4], values[5]


@scalar
def _add_products(rows, count, begin, place, H, b):
    """Add the products of all rows to the normal equations; the last row holds the residuals.

    Unknowns before ``begin`` are omitted; unknown k is number ``place + k`` of ``H`` and ``b``.
    """
    last, padded = len(rows) - 1, _padded(count)
    for k in range(begin, last + 1):
        for n in range(count, padded):
            rows[k, n] = f32(0)
    for k in range(begin, last + 1):
        for m in range(begin, min(k, last - 1) + 1):
            total = f32(0)
            for n in range(padded):
                total += rows[k, n] * rows[m, n]
            if k == last:
                b[place + m] += total
            else:
                H[place + k, place + m] += total


@scalar
def _measured_points(start, stop, points, T, depth, intrinsics, step, residuals, number, at):
    """Points ``start`` to ``stop`` on the same surface of the second depth image; returns their number.

    Fills ``number`` and rows of ``at``: positions in both depth cameras, depth difference, slopes along u and v.
    """
    h, w = depth.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    count, one = 0, f32(1)
    for n in range(start, stop):
        residuals[0, n] = residuals[1, n] = f32(np.nan)
        X, Y, Z = points[n, 0], points[n, 1], points[n, 2]
        x, y, z = transform(T, X, Y, Z)
        if z < NEAREST:
            continue
        u, v = x / z * fx + cx, y / z * fy + cy
        if not ((u >= one) & (v >= one) & (u < f32(w - 2)) & (v < f32(h - 2))):
            continue
        i, j = int(u), int(v)
        p, q, r, s = depth[j, i], depth[j, i + 1], depth[j + 1, i], depth[j + 1, i + 1]
        near, far = min(min(p, q), min(r, s)), max(max(p, q), max(r, s))
        if near <= f32(0) or far - near > step * near:
            continue
        a, b = u - f32(i), v - f32(j)
        upper, lower = p + (q - p) * a, r + (s - r) * a
        difference = upper + (lower - upper) * b - z
        if abs(difference) > step * near:
            continue
        number[count] = n
        at[0, count], at[1, count], at[2, count] = X, Y, Z
        at[3, count], at[4, count], at[5, count] = x, y, z
        at[6, count], at[7, count], at[8, count] = difference, (q - p) + ((s - r) - (q - p)) * b, lower - upper
        count += 1
    return count


@scalar
def _depth_terms(count, at, intrinsics, noise, by_depth, huber, rows, plain):
    fx, fy = intrinsics[0], intrinsics[1]
    for n in range(_padded(count)):
        x, y, z, difference = at[3, n], at[4, n], at[5, n], at[6, n]
        deviation = sigma(z, noise)
        # the step along the ray is longer than the distance to a slanted surface
        sx, sy = at[7, n] * fx / z, at[8, n] * fy / z
        sz = -(sx * x + sy * y) / z - f32(1)
        scaled = by_depth / deviation / np.sqrt(sx * sx + sy * sy + sz * sz)
        root = np.sqrt(huber / max(abs(difference * scaled), huber)) * scaled
        rows[0, n], rows[1, n], rows[2, n] = root * sx, root * sy, root * sz
        rows[3, n], rows[4, n], rows[5, n] = (
            root * (y * sz - z * sy), root * (z * sx - x * sz), root * (x * sy - y * sx)
        )  # fmt: skip
        rows[6, n] = root * difference
        plain[n] = difference / deviation


@scalar
def _colored_points(count, tangents, first, second, number, at, pixels, shades):
    """Keep the points that both colour images show at ``pixels``; returns their number. They move to the front of
    ``number`` and ``at``, whose rows from 6 receive the tangents; ``shades``: values and slopes."""
    height, width = f32(first.shape[0]) - MARGIN, f32(first.shape[1]) - MARGIN
    left = 0
    for n in range(count):
        u, v, s, t = pixels[0, n], pixels[1, n], pixels[2, n], pixels[3, n]
        if not ((u >= MARGIN) & (v >= MARGIN) & (u < width) & (v < height)):
            continue
        if not ((s >= MARGIN) & (t >= MARGIN) & (s < width) & (t < height)):
            continue
        before, fu, fv = _central(first, u, v)
        after, gu, gv = _central(second, s, t)
        slopes = fu + fv + gu + gv
        # NaN next to moving pixels; for sums, the compiler may decompose isfinite()
        if not (np.isfinite(before) & np.isfinite(after) & (slopes == slopes)):
            continue
        m = number[n]
        number[left] = m
        for k in range(6):
            at[k, left] = at[k, n]
        for k in range(6):
            at[6 + k, left] = tangents[m, k]
        shades[0, left], shades[1, left], shades[2, left] = before, fu, fv
        shades[3, left], shades[4, left], shades[5, left] = after, gu, gv
        left += 1
    return left


@scalar
def linearize_pair(
    points, tangents, T, depth, depth_intrinsics, first, second, first_twist, second_twist, first_offset, second_offset,
    place, intrinsics, lens, scale, readout, gain, bias, step, noise, by_color, by_depth, huber, begin, residuals, H, b,
):  # fmt: skip
    """Normal equations of the differences between two frames at the points of the first.

    The gradient g in the second image is the mean of both images', because separate derivatives are mostly noise. With
    the affinity A of the surface tangents, a step d_i in the first image is A d_i in the second: the derivative is g
    (d_j - A d_i).

    Args:
        points: (n, 3) float32, camera of the first depth image.
        tangents: (n, 6) float32, two surface directions per point.
        T: (3, 4) float32, first to second depth camera.
        depth: (h, w) float32 of the second frame, metres, 0 = none.
        depth_intrinsics: (4,) float32.
        first, second: (h, w) float32 recorded colour intensities, NaN = unused.
        first_twist, second_twist: (6,) float32, motion of the depth camera per second.
        first_offset, second_offset: Delay of the middle row, s.
        place: (3, 4) float32 T_color_depth.
        intrinsics: (4,) float32 at the size of the colour images.
        lens: (5,) float32 k1, k2, p1, p2, k3.
        scale: Colour image over full size.
        readout: Of the colour images, s.
        gain, bias: Second intensity = gain first + bias.
        step: Largest depth difference of one surface, share of the depth.
        noise: SensorNoise, of float32.
        by_color, by_depth: Reciprocal standard deviations of intensity, and of depth in ``noise``.
        huber: Constant of the robust weight, standard deviations.
        begin: First unknown: 0, or SHARED for a known calibration.
        residuals: (2, n) float32 out: intensity difference, depth difference over ``noise``; NaN = none.
        H: (UNKNOWNS, UNKNOWNS) float64 out.
        b: (UNKNOWNS,) float64 out, gradient.
    """
    wide_vectors()
    T, place, own, other = elements(T), elements(place), _six(first_twist), _six(second_twist)
    intrinsics = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    lens = lens[0], lens[1], lens[2], lens[3], lens[4]
    height, half, zero = f32(first.shape[0]), f32(0.5), f32(0)
    number, at, plain = np.empty(POINTS, np.int64), np.empty((12, POINTS), f32), np.empty(POINTS, f32)
    pixels, shades = np.empty((4, POINTS), f32), np.empty((6, POINTS), f32)
    # derivatives and, last, residuals, unknown by unknown, each times the root of its weight
    distance, color = np.empty((POSE + 1, POINTS), f32), np.empty((UNKNOWNS + 1, POINTS), f32)
    H[:], b[:] = 0.0, 0.0
    for start in range(0, points.shape[0], POINTS):
        stop = min(start + POINTS, points.shape[0])
        count = _measured_points(start, stop, points, T, depth, depth_intrinsics, step, residuals, number, at)
        _depth_terms(count, at, depth_intrinsics, noise, by_depth, huber, distance, plain)
        _add_products(distance, count, 0, SHARED, H, b)
        for n in range(count):
            residuals[1, number[n]] = plain[n]
        for n in range(_padded(count)):
            seen = _seen(place, own, intrinsics, lens, first_offset, readout, height, at[0, n], at[1, n], at[2, n])
            pixels[0, n], pixels[1, n] = seen[0], seen[1]
            seen = _seen(place, other, intrinsics, lens, second_offset, readout, height, at[3, n], at[4, n], at[5, n])
            pixels[2, n], pixels[3, n] = seen[0], seen[1]
        count = _colored_points(count, tangents, first, second, number, at, pixels, shades)
        for n in range(_padded(count)):
            X, Y, Z, x, y, z = at[0, n], at[1, n], at[2, n], at[3, n], at[4, n], at[5, n]
            before, fu, fv = shades[0, n], shades[1, n], shades[2, n]
            after, gu, gv = shades[3, n], shades[4, n], shades[5, n]
            seen = _seen(place, own, intrinsics, lens, first_offset, readout, height, X, Y, Z)
            seen_after = _seen(place, other, intrinsics, lens, second_offset, readout, height, x, y, z)
            # pixel derivatives along the tangents in the first image and, along the rotated tangents, in the second
            a, c, d = at[6, n], at[7, n], at[8, n]
            e, f, g = at[9, n], at[10, n], at[11, n]
            p0, p1 = _along(_back(place, _by_point(seen, intrinsics, lens, f32(1), zero)), a, c, d, e, f, g)
            p2, p3 = _along(_back(place, _by_point(seen, intrinsics, lens, zero, f32(1))), a, c, d, e, f, g)
            a, c, d = rotate(T, a, c, d)
            e, f, g = rotate(T, e, f, g)
            q0, q1 = _along(_back(place, _by_point(seen_after, intrinsics, lens, f32(1), zero)), a, c, d, e, f, g)
            q2, q3 = _along(_back(place, _by_point(seen_after, intrinsics, lens, zero, f32(1))), a, c, d, e, f, g)
            det, turned = p0 * p3 - p1 * p2, q0 * q3 - q1 * q2
            alike = det * turned > zero
            by_det = f32(1) / (det if alike else f32(1))
            a0, a1 = (q0 * p3 - q1 * p2) * by_det, (q1 * p0 - q0 * p1) * by_det
            a2, a3 = (q2 * p3 - q3 * p2) * by_det, (q3 * p0 - q2 * p1) * by_det
            area = a0 * a3 - a1 * a2
            alike &= (area > f32(0.25)) & (area < f32(4))  # otherwise the views differ too much
            by_area = f32(1) / (area if alike else f32(1))
            # mean texture gradient in the second image; A^-T transforms the gradient of the first
            gu = half * (gu + gain * (a3 * fu - a2 * fv) * by_area)
            gv = half * (gv + gain * (a0 * fv - a1 * fu) * by_area)
            difference = after - gain * before - bias
            root = np.sqrt(huber / max(abs(difference * by_color), huber)) * by_color
            root = root if alike else zero
            plain[n] = difference if alike else f32(np.nan)
            gu, gv = root * gu, root * gv
            su, sv = -(gu * a0 + gv * a2), -(gu * a1 + gv * a3)
            by_point = _by_point(seen_after, intrinsics, lens, gu, gv)
            jx, jy, jz = _back(place, by_point)
            one = _by_parameters(seen, place, intrinsics, scale, su, sv, _by_point(seen, intrinsics, lens, su, sv))
            two = _by_parameters(seen_after, place, intrinsics, scale, gu, gv, by_point)
            color[0, n], color[1, n], color[2, n] = one[0] + two[0], one[1] + two[1], one[2] + two[2]
            color[3, n], color[4, n], color[5, n] = one[3] + two[3], one[4] + two[4], one[5] + two[5]
            color[6, n], color[7, n], color[8, n] = one[6] + two[6], one[7] + two[7], one[8] + two[8]
            color[9, n], color[10, n], color[11, n] = one[9] + two[9], one[10] + two[10], one[11] + two[11]
            color[12, n], color[13, n], color[14, n], color[15, n] = one[12] + two[12], jx, jy, jz
            color[16, n], color[17, n], color[18, n] = y * jz - z * jy, z * jx - x * jz, x * jy - y * jx
            color[19, n], color[20, n] = -root * before, -root
            color[21, n] = root * difference
        for n in range(count):
            residuals[0, number[n]] = plain[n]
        _add_products(color, count, begin, 0, H, b)
    for k in range(UNKNOWNS):
        for m in range(k):
            H[m, k] = H[k, m]


@kernel
def linearize_pairs(
    pairs, starts, points, tangents, Ts, depths, depth_intrinsics, images, twists, offsets, place, intrinsics, lens,
    scale, readout, lights, step, noise, by_color, by_depth, huber, begin, residual_starts, residuals, Hs, bs,
):  # fmt: skip
    """``linearize_pair`` of several pairs, with its other arguments.

    Args:
        pairs: (P, 2) int64, first and second frame.
        starts: (F + 1,) int64, first point of each frame.
        points, tangents: (n, 3) and (n, 6) float32 of all F frames.
        Ts: (P, 3, 4) float32.
        depths, images: (F, h, w) float32.
        twists, offsets: (F, 6) and (F,) float32, motion and delay of the middle colour row.
        lights: (P, 2) float32, gain and bias.
        residual_starts: (P + 1,) int64, first residual of each pair.
        residuals: (2, r) float32 out.
        Hs, bs: (P, UNKNOWNS, UNKNOWNS) and (P, UNKNOWNS) float64 out.
    """
    for n in range(len(pairs)):
        first, second = pairs[n, 0], pairs[n, 1]
        own = slice(starts[first], starts[first + 1])
        linearize_pair(
            points[own], tangents[own], Ts[n], depths[second], depth_intrinsics, images[first], images[second],
            twists[first], twists[second], offsets[first], offsets[second], place, intrinsics, lens, scale, readout,
            lights[n, 0], lights[n, 1], step, noise, by_color, by_depth, huber, begin,
            residuals[:, residual_starts[n] : residual_starts[n + 1]], Hs[n], bs[n],
        )  # fmt: skip
