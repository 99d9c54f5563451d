"""Loop over points that two frames see: intensity and depth differences, and their derivatives."""

import numpy as np

from dudmap.core.backends.threads import kernel, scalar
from dudmap.core.formulas.pixel import elements, rotate, sigma, transform

f32 = np.float32
UNKNOWNS = 21
SHARED, POSE = 13, 6
"""Parameters of the calibration (13), relative pose as a twist (6), gain and offset of the intensities (2)."""
MARGIN = f32(8)
"""Border of the colour images that is not used, pixels: twice the wider Gaussian of their filter."""
NEAREST = f32(0.05)
"""Depth in the colour camera below which a point is not seen, metres."""


@scalar
def _bilinear(image, u, v):
    """Value and derivatives along u and v of an image at a place that has four neighbours."""
    i, j = int(u), int(v)
    a, b = u - f32(i), v - f32(j)
    p, q, r, s = image[j, i], image[j, i + 1], image[j + 1, i], image[j + 1, i + 1]
    upper, lower = p + (q - p) * a, r + (s - r) * a
    return upper + (lower - upper) * b, (q - p) + ((s - r) - (q - p)) * b, lower - upper


@scalar
def _central(image, u, v):
    """Value of an image at a place that has sixteen neighbours, and its interpolated central differences.

    The noise of these derivatives is uncorrelated with that of the value, which the slopes between the four nearest
    pixels are not: at whole pixels their product has the mean of the noise's variance, a bias of all estimates.
    """
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
def _color(image, place, twist, intrinsics, lens, scale, offset, readout, x, y, z, D):
    """Intensity that a colour image gives a point of its depth camera, and how the point moves in it.

    Args:
        image: (h, w) float32 at ``scale`` times the full size of the colour image.
        place: (3, 4) float32 T_color_depth.
        twist: (6,) float32 motion of the depth camera per second.
        intrinsics: (4,) float32 at the size of ``image``.
        lens: (5,) float32 k1, k2, p1, p2, k3.
        scale: Size of ``image`` over the full size.
        offset, readout: Seconds.
        x, y, z: The point.
        D: (2, 16) float32 out, derivatives of the pixel u, v by the parameters and by the point.

    Returns:
        Intensity, NaN outside the image, at its border or where ``image`` is; its derivatives along u and v.
    """
    h, w = image.shape
    p = elements(place)
    ax = twist[0] + twist[4] * z - twist[5] * y
    ay = twist[1] + twist[5] * x - twist[3] * z
    az = twist[2] + twist[3] * y - twist[4] * x
    bx = twist[4] * az - twist[5] * ay
    by = twist[5] * ax - twist[3] * az
    bz = twist[3] * ay - twist[4] * ax
    x0, y0, z0 = transform(p, x, y, z)
    x1, y1, z1 = rotate(p, ax, ay, az)
    x2, y2, z2 = rotate(p, bx, by, bz)
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    half, tau, share, zero = f32(0.5), offset, f32(0), f32(0)
    for _ in range(2):
        c = half * tau * tau
        row = (y0 - tau * y1 + c * y2) / max(z0 - tau * z1 + c * z2, NEAREST) * fy + cy
        share = (min(max(row, zero), f32(h)) + half) / f32(h) - half
        tau = offset + readout * share
    c = half * tau * tau
    qx, qy, qz = x0 - tau * x1 + c * x2, y0 - tau * y1 + c * y2, z0 - tau * z1 + c * z2
    if qz < NEAREST:
        return f32(np.nan), zero, zero
    by_z = f32(1) / qz
    a, d = qx * by_z, qy * by_z
    k1, k2, p1, p2, k3 = lens[0], lens[1], lens[2], lens[3], lens[4]
    r2 = a * a + d * d
    radial, growth = f32(1) + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (f32(2) * k2 + f32(3) * r2 * k3)
    u = (a * radial + f32(2) * p1 * a * d + p2 * (r2 + f32(2) * a * a)) * fx + cx
    v = (d * radial + p1 * (r2 + f32(2) * d * d) + f32(2) * p2 * a * d) * fy + cy
    if not ((u >= MARGIN) & (v >= MARGIN) & (u < f32(w) - MARGIN) & (v < f32(h) - MARGIN)):
        return f32(np.nan), zero, zero
    across = f32(2) * (a * d * growth + p1 * a + p2 * d)
    along_x = radial + f32(2) * (a * a * growth + p1 * d) + f32(6) * p2 * a
    along_y = radial + f32(2) * (d * d * growth + p2 * a) + f32(6) * p1 * d
    value, gu, gv = _central(image, u, v)
    rx, ry, rz = qx - p[3], qy - p[7], qz - p[11]
    mx, my, mz = tau * x2 - x1, tau * y2 - y1, tau * z2 - z1
    for k in range(2):
        # derivative of one pixel coordinate by the point in the colour camera
        f = (fx if k == 0 else fy) * by_z
        gx, gy = (f * along_x, f * across) if k == 0 else (f * across, f * along_y)
        gz = -(gx * a + gy * d)
        D[k, 0], D[k, 1], D[k, 2] = gx, gy, gz
        D[k, 3], D[k, 4], D[k, 5] = ry * gz - rz * gy, rz * gx - rx * gz, rx * gy - ry * gx
        D[k, 6] = u - cx if k == 0 else v - cy
        D[k, 7], D[k, 8] = (scale, zero) if k == 0 else (zero, scale)
        D[k, 9] = fx * a * r2 if k == 0 else fy * d * r2
        D[k, 10] = D[k, 9] * r2
        D[k, 11] = gx * mx + gy * my + gz * mz
        D[k, 12] = D[k, 11] * share
        D[k, 13] = p[0] * gx + p[4] * gy + p[8] * gz
        D[k, 14] = p[1] * gx + p[5] * gy + p[9] * gz
        D[k, 15] = p[2] * gx + p[6] * gy + p[10] * gz
    return value, gu, gv


@scalar
def _across_surface(D, tangents, T):
    """Derivatives (2 x 2, row by row) of a pixel by a step along two tangents of the surface, turned by ``T``."""
    a, b, c = rotate(T, tangents[0], tangents[1], tangents[2])
    d, e, f = rotate(T, tangents[3], tangents[4], tangents[5])
    return (
        D[0, 13] * a + D[0, 14] * b + D[0, 15] * c, D[0, 13] * d + D[0, 14] * e + D[0, 15] * f,
        D[1, 13] * a + D[1, 14] * b + D[1, 15] * c, D[1, 13] * d + D[1, 14] * e + D[1, 15] * f,
    )  # fmt: skip


@scalar
def _product(a, b, count):
    """Sum of the products of the first ``count`` elements."""
    total = f32(0)
    for n in range(count):
        total += a[n] * b[n]
    return total


@scalar
def linearize_pair(
    points, tangents, T, depth, depth_intrinsics, first, second, first_twist, second_twist, first_offset, second_offset,
    place, intrinsics, lens, scale, readout, gain, bias, step, noise, by_color, by_depth, huber, begin, residuals, H, b,
):  # fmt: skip
    """Normal equations of the differences between two frames at the points of the first.

    Both intensities show the same texture, so their derivatives are taken from it once, as the mean of those of both
    images in the second: a step d_i in the first image is a step A d_i in the second, with the affinity A that the
    surface's tangents give. The derivative by a parameter is then that of the difference of two displacements,
    g (d_j - A d_i). The difference of the two images' own derivatives would be mostly their noise, which makes the
    normal equations too large, and steps and covariances too small.

    Args:
        points: (n, 3) float32, camera of the first depth image.
        tangents: (n, 6) float32, two directions of the surface at each.
        T: (3, 4) float32, first to second depth camera.
        depth: (h, w) float32 of the second frame, metres, 0 = none.
        depth_intrinsics: (4,) float32.
        first, second: (h, w) float32 colour intensities as recorded.
        first_twist, second_twist: (6,) float32 per second.
        first_offset, second_offset: Delay of the middle row of each colour image, s.
        place, intrinsics, lens, scale, readout: As for ``_color``.
        gain, bias: The second intensity is gain times the first plus bias.
        step: Depth differences beyond this share of the depth are another surface.
        noise: SensorNoise, of float32.
        by_color: Reciprocal standard deviation of the intensity difference.
        by_depth: Reciprocal standard deviation of the depth difference in units of ``noise``.
        huber: Constant of the robust weight, standard deviations.
        begin: First unknown that is wanted: 0, or SHARED for a calibration that is known; what is before it stays 0.
        residuals: (2, n) float32 out: intensity difference, depth difference over ``noise``; NaN where there is none.
        H: (UNKNOWNS, UNKNOWNS) float64 out.
        b: (UNKNOWNS,) float64 out, gradient.
    """
    t = elements(T)
    unturned = (f32(1), f32(0), f32(0), f32(0), f32(0), f32(1), f32(0), f32(0), f32(0), f32(0), f32(1), f32(0))
    h, w = depth.shape
    fx, fy, cx, cy = depth_intrinsics[0], depth_intrinsics[1], depth_intrinsics[2], depth_intrinsics[3]
    J, one, two = np.zeros(UNKNOWNS, f32), np.zeros((2, 16), f32), np.zeros((2, 16), f32)
    # derivatives and, last, residuals of all points times the root of their weights, unknown by unknown: sums of
    # products over the points are vectorised, those over the unknowns of a point are not
    of_color = np.empty((UNKNOWNS + 1, points.shape[0]), f32)
    of_depth = np.empty((POSE + 1, points.shape[0]), f32)
    colored, measured = 0, 0
    nan, half = f32(np.nan), f32(0.5)
    for n in range(points.shape[0]):
        residuals[0, n], residuals[1, n] = nan, nan
        X, Y, Z = points[n, 0], points[n, 1], points[n, 2]
        x, y, z = transform(t, X, Y, Z)
        if z < NEAREST:
            continue
        u, v = x / z * fx + cx, y / z * fy + cy
        if not ((u >= f32(1)) & (v >= f32(1)) & (u < f32(w - 2)) & (v < f32(h - 2))):
            continue
        i, j = int(u), int(v)
        near = min(min(depth[j, i], depth[j, i + 1]), min(depth[j + 1, i], depth[j + 1, i + 1]))
        far = max(max(depth[j, i], depth[j, i + 1]), max(depth[j + 1, i], depth[j + 1, i + 1]))
        if near <= f32(0) or far - near > step * near:
            continue
        surface, du, dv = _bilinear(depth, u, v)
        difference = surface - z
        if abs(difference) > step * near:
            continue
        deviation = sigma(z, noise)
        residuals[1, n] = difference / deviation
        # the step along the ray is longer than the distance to a slanted surface
        sx, sy = du * fx / z, dv * fy / z
        sz = -(sx * x + sy * y) / z - f32(1)
        scaled = by_depth / deviation / np.sqrt(sx * sx + sy * sy + sz * sz)
        r = difference * scaled
        weight = huber / max(abs(r), huber)
        J[13], J[14], J[15] = sx, sy, sz
        J[16], J[17], J[18] = y * sz - z * sy, z * sx - x * sz, x * sy - y * sx
        root = np.sqrt(weight)
        for k in range(POSE):
            of_depth[k, measured] = root * scaled * J[SHARED + k]
        of_depth[POSE, measured] = root * r
        measured += 1
        before, fu, fv = _color(first, place, first_twist, intrinsics, lens, scale, first_offset, readout, X, Y, Z, one)
        after, gu, gv = _color(
            second, place, second_twist, intrinsics, lens, scale, second_offset, readout, x, y, z, two
        )
        slopes = fu + fv + gu + gv
        # NaN beside what moves; of sums, the compiler may take isfinite() apart
        if not (np.isfinite(before) & np.isfinite(after) & (slopes == slopes)):
            continue
        p0, p1, p2, p3 = _across_surface(one, tangents[n], unturned)
        q0, q1, q2, q3 = _across_surface(two, tangents[n], t)
        det, turned = p0 * p3 - p1 * p2, q0 * q3 - q1 * q2
        if det * turned <= f32(0):
            continue
        a0, a1 = (q0 * p3 - q1 * p2) / det, (q1 * p0 - q0 * p1) / det
        a2, a3 = (q2 * p3 - q3 * p2) / det, (q3 * p0 - q2 * p1) / det
        area = a0 * a3 - a1 * a2
        if not ((area > f32(0.25)) & (area < f32(4))):  # seen too differently to look alike
            continue
        # mean derivative of the texture in the second image: A^-T takes that of the first there
        gu = half * (gu + gain * (a3 * fu - a2 * fv) / area)
        gv = half * (gv + gain * (a0 * fv - a1 * fu) / area)
        difference = after - gain * before - bias
        residuals[0, n] = difference
        r = difference * by_color
        root = np.sqrt(huber / max(abs(r), huber)) * by_color
        for k in range(begin, SHARED):
            J[k] = gu * (two[0, k] - a0 * one[0, k] - a1 * one[1, k]) + gv * (
                two[1, k] - a2 * one[0, k] - a3 * one[1, k]
            )
        for k in range(SHARED, SHARED + 3):
            J[k] = gu * two[0, k] + gv * two[1, k]
        J[16], J[17], J[18] = y * J[15] - z * J[14], z * J[13] - x * J[15], x * J[14] - y * J[13]
        J[19], J[20] = -before, f32(-1)
        for k in range(begin, UNKNOWNS):
            of_color[k, colored] = root * J[k]
        of_color[UNKNOWNS, colored] = root * difference
        colored += 1
    H[:], b[:] = 0.0, 0.0
    for k in range(begin, UNKNOWNS):
        b[k] = _product(of_color[k], of_color[UNKNOWNS], colored)
        for m in range(begin, k + 1):
            H[k, m] = _product(of_color[k], of_color[m], colored)
    for k in range(POSE):
        b[SHARED + k] += _product(of_depth[k], of_depth[POSE], measured)
        for m in range(k + 1):
            H[SHARED + k, SHARED + m] += _product(of_depth[k], of_depth[m], measured)
    for k in range(UNKNOWNS):
        for m in range(k):
            H[m, k] = H[k, m]


@kernel
def linearize_pairs(
    pairs, starts, points, tangents, Ts, depths, depth_intrinsics, images, twists, offsets, place, intrinsics, lens,
    scale, readout, lights, step, noise, by_color, by_depth, huber, begin, residual_starts, residuals, Hs, bs,
):  # fmt: skip
    """``linearize_pair`` of several pairs of frames.

    Args:
        pairs: (P, 2) int64, numbers of the first and the second frame of each.
        starts: (F + 1,) int64, where the points of each frame begin in ``points`` and ``tangents``.
        points, tangents: (n, 3) and (n, 6) float32 of all F frames.
        Ts: (P, 3, 4) float32.
        depths: (F, h, w) float32.
        images: (F, h, w) float32.
        twists, offsets: (F, 6) and (F,) float32, motion and delay of the middle row of the colour image of each frame.
        lights: (P, 2) float32, gain and bias.
        residual_starts: (P + 1,) int64, where the residuals of each pair begin.
        residuals: (2, r) float32 out.
        Hs: (P, UNKNOWNS, UNKNOWNS) float64 out.
        bs: (P, UNKNOWNS) float64 out.

    The others are as for ``linearize_pair``.
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
