"""Image sums of gradient noise in the normal equations (``core/tracking/observability.py``)."""

import numpy as np

from dudmap.core.backends.threads import kernel, scalar
from dudmap.core.formulas.pixel import sigma
from dudmap.core.formulas.residual import weigh

NUM_MOMENTS = 10
"""Sums of w, w x, w y, w z, w xx, w xy, w xz, w yy, w yz, w zz over points."""
NUM_SUMS = 3 + 2 * NUM_MOMENTS
"""Pixels on the map, sums of depths and distance weights; moments of the noise of distances and intensities."""


@scalar
def noise_sums(
    stride, depth, residuals, weights, intrinsics, parameters, filter_px, scale_px, voxel_size, interpolated, steepest,
    sums,
):  # fmt: skip
    """Add the gradient noise of every ``stride``-th pixel, across and down, to ``sums``.

    Args:
        residuals: (h, w) float32 distances and (h, w) float32 intensity differences, NaN off the map.
        weights: (h, w) float32.
        parameters: RegistrationParameters.
        filter_px: Standard deviation of the depth filter, pixels of this image.
        scale_px: Pixels per pixel of the fused images.
        voxel_size: Metres.
        interpolated: Gradient variance of interpolated independent values.
        steepest: Tangent of the largest angle of incidence.
        sums: (NUM_SUMS,) float64 in and out, about the camera's centre, camera axes.
    """
    height, width = depth.shape
    distances, differences = residuals
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    p, tiny = parameters, np.float32(1e-6)
    for v in range(stride // 2, height, stride):
        for u in range(stride // 2, width, stride):
            static = weights[v, u]
            if not (static > 0 and abs(differences[v, u]) < np.inf):
                continue
            z = depth[v, u]
            pixel = z / fx
            _, _, _, _, _, w, of_color = weigh(distances[v, u], differences[v, u], z, static, True, p)
            across = depth[v, min(u + 1, width - 1)] - depth[v, max(u - 1, 0)]
            down = depth[min(v + 1, height - 1), u] - depth[max(v - 1, 0), u]
            step = min(np.sqrt(across * across + down * down) / 2, steepest * pixel) * scale_px
            noise = max(sigma(z, p.band.noise), tiny) * pixel
            blur = (filter_px * pixel) ** 2 + (voxel_size / 2) ** 2
            variance = noise * noise / (8 * np.pi * blur * blur) + interpolated * step * step / 12 / voxel_size**2
            x, y = (u - cx) / fx * z, (v - cy) / fy * z
            sums[0] += 1
            sums[1] += z
            sums[2] += w
            for term in range(2):
                share = w * variance if term == 0 else of_color
                n = 3 + NUM_MOMENTS * term
                sums[n] += share
                sums[n + 1] += share * x
                sums[n + 2] += share * y
                sums[n + 3] += share * z
                sums[n + 4] += share * x * x
                sums[n + 5] += share * x * y
                sums[n + 6] += share * x * z
                sums[n + 7] += share * y * y
                sums[n + 8] += share * y * z
                sums[n + 9] += share * z * z


@scalar
def isotropic(moments, R, share, regular, out):
    """Sum of w J' J, J = [I, -hat(p)], over rotated points, from moments.

    Args:
        moments: (NUM_MOMENTS,) float64.
        R: (3, 3) float64.
        share: Factor.
        regular: Increase of the diagonal, for collinear points.
        out: (6, 6) float64 out.
    """
    second = np.empty((3, 3))
    second[0, 0], second[0, 1], second[0, 2] = moments[4], moments[5], moments[6]
    second[1, 1], second[1, 2], second[2, 2] = moments[7], moments[8], moments[9]
    second[1, 0], second[2, 0], second[2, 1] = moments[5], moments[6], moments[8]
    trace = moments[4] + moments[7] + moments[9]
    x = R[0, 0] * moments[1] + R[0, 1] * moments[2] + R[0, 2] * moments[3]
    y = R[1, 0] * moments[1] + R[1, 1] * moments[2] + R[1, 2] * moments[3]
    z = R[2, 0] * moments[1] + R[2, 1] * moments[2] + R[2, 2] * moments[3]
    out[:] = 0.0
    out[3, 1], out[4, 0], out[3, 2], out[5, 0], out[4, 2], out[5, 1] = -z, z, y, -y, -x, x
    for i in range(3):
        out[i, i] = moments[0]
        for j in range(3):
            out[i, 3 + j] = out[3 + j, i]
            total = trace if i == j else 0.0
            for k in range(3):
                for m in range(3):
                    total -= R[i, k] * second[k, m] * R[j, m]
            out[3 + i, 3 + j] = total
    for i in range(6):
        out[i, i] *= 1 + regular
        for j in range(6):
            out[i, j] *= share


@kernel
def noise_information(
    stride, depth, residuals, weights, intrinsics, parameters, numbers, R, of_intensity, regular, H, least, sums, out
):  # fmt: skip
    """Sums of ``noise_sums``, and information (2, 6, 6) of the noise; returns whether H minus ``least`` times it is
    positive definite.

    Args:
        stride, depth, residuals, weights, intrinsics, parameters, sums: As for ``noise_sums``.
        numbers: Other arguments of ``noise_sums``.
        R: (3, 3) float64, camera to world.
        of_intensity: Variance of an intensity gradient component.
        regular: As for ``isotropic``.
        H: (6, 6) of both terms, world axes.
        least: Factor of the noise.
        out: (2, 6, 6) float64 out.
    """
    filter_px, scale_px, voxel_size, interpolated, steepest = numbers
    noise_sums(
        stride, depth, residuals, weights, intrinsics, parameters, filter_px, scale_px, voxel_size, interpolated,
        steepest, sums,
    )  # fmt: skip
    for term in range(2):
        share = stride * stride * (1.0 if term == 0 else of_intensity)
        isotropic(sums[3 + NUM_MOMENTS * term : 3 + NUM_MOMENTS * (term + 1)], R, share, regular, out[term])
    L = np.empty((6, 6))  # Cholesky factor of the difference, if it exists
    for j in range(6):
        for i in range(j, 6):
            value = H[i, j] - least * (out[0, i, j] + out[1, i, j])
            for k in range(j):
                value -= L[i, k] * L[j, k]
            if i == j and not value > 0:
                return False
            L[i, j] = np.sqrt(value) if i == j else value / L[j, j]
    return True
