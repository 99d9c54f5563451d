"""Formulas of a residual: interpolation, robust costs and weights, normal equations.

``weigh`` is the only residual weight; ``residual_weights`` applies it to an image.
"""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.parameters import ImageStack, RegistrationParameters, single
from dudmap.core.backends.threads import kernel, scalar, written_out
from dudmap.core.formulas.pixel import band_front, sigma

f32 = np.float32
GATE = f32(0.95)
"""Share of the truncation band of pixels on the map."""
WORST_COLOR = f32(0.3)
"""Intensity residual charged to a pixel off the map."""


@scalar
def trilinear(v0, v1, v2, v3, v4, v5, v6, v7, ax, ay, az):
    """Trilinear interpolation of eight corner values, corner 4 dx + 2 dy + dz, at (ax, ay, az) in [0, 1]^3.

    Returns:
        Value, and its derivatives along x, y and z.
    """
    v01, v23 = v0 + (v1 - v0) * az, v2 + (v3 - v2) * az
    v45, v67 = v4 + (v5 - v4) * az, v6 + (v7 - v6) * az
    low, high = v01 + (v23 - v01) * ay, v45 + (v67 - v45) * ay
    along_y = (v23 - v01) + ((v67 - v45) - (v23 - v01)) * ax
    d01, d23, d45, d67 = v1 - v0, v3 - v2, v5 - v4, v7 - v6
    d_low, d_high = d01 + (d23 - d01) * ay, d45 + (d67 - d45) * ay
    return low + (high - low) * ax, high - low, along_y, d_low + (d_high - d_low) * ax


@scalar
def within_range(shade, kx, ky, kz, intensity, p):
    """Intensity difference, clipped to the unsaturated range, and its gradient, 0 outside."""
    inside = (shade > p.darkest) & (shade < p.brightest)
    part = f32(1) if inside else f32(0)
    difference = min(max(shade, p.darkest), p.brightest) - min(max(intensity, p.darkest), p.brightest)
    return difference, kx * part, ky * part, kz * part


@scalar
def huber_weight(a, k):
    """Huber weight of an absolute residual (thesis eq. 4.44)."""
    return k / max(a, k)


@scalar
def huber_cost(a, k):
    """Huber cost of an absolute residual."""
    return min(a, k) * (a - f32(0.5) * min(a, k))


@written_out
def noise_scale(z, p):
    """sigma(reference depth) / sigma(z), at most 1."""
    return min(p.sigma_at_reference / max(sigma(z, p.band.noise), f32(1e-6)), f32(1))


@written_out
def weigh(r, rc, z, static, known, p):
    """Weights and costs of the residuals of a pixel (thesis eq. 4.43-4.46).

    Args:
        r, rc: Distance, metres, and intensity difference.
        z: Depth, metres, 0 = none.
        static: Static weight of the pixel.
        known: Whether the map has both.
        p: RegistrationParameters.

    Returns:
        - Whether the pixel is on the map.
        - Its static weight there, else 0.
        - Its cost.
        - The cost off the map.
        - Weighted squared distance at one metre.
        - Weights of distance and intensity.
    """
    zero = f32(0)
    gate = band_front(z, p.band) * GATE
    scale = noise_scale(z, p)
    valid = known & (abs(r) < gate)
    rn = r * scale
    a = abs(rn)
    outlier = a > p.huber  # selected and not limited: the compiler then orders the products as in earlier versions
    robust = p.huber / a if outlier else f32(1)
    cost = p.huber * (a - f32(0.5) * p.huber) if outlier else f32(0.5) * a * a
    worst = huber_cost(gate * scale, p.huber)
    ac = abs(rc)
    color_robust, color_cost = huber_weight(ac, p.color_huber), huber_cost(ac, p.color_huber)
    used = static if valid else zero
    missing = static - used if z > zero else zero
    return (
        valid,
        used,
        used * (cost + p.color_weight * color_cost),
        missing * (worst + p.color_weight * huber_cost(WORST_COLOR, p.color_huber)),
        used * robust * rn * rn,
        used * robust * scale * scale,
        used * color_robust * p.color_weight,
    )


@kernel
def _weigh_image(depth, distances, differences, static, parameters, out):
    height, width = depth.shape
    for v in range(height):
        for u in range(width):
            r, rc = distances[v, u], differences[v, u]
            known = abs(rc) < np.inf
            _, _, _, _, square, of_distance, of_intensity = weigh(r, rc, depth[v, u], static[v, u], known, parameters)
            if known:
                out[0, v, u], out[1, v, u], out[2, v, u] = of_distance, of_intensity, square


def residual_weights(
    depth: NDArray[np.float32], residuals: ImageStack, static: NDArray[np.float32], parameters: RegistrationParameters
) -> NDArray[np.float32]:
    """Registration weights of the residuals of an image.

    Args:
        depth: (h, w) metres, 0 = none.
        residuals: (2, h, w) of a linearisation, NaN off the map.
        static: (h, w) static weights.
        parameters: Parameters of the linearisation.

    Returns:
        (3, h, w) weights of distances and intensities, and weighted squared distances at one metre; 0 off the map.
    """
    out = np.zeros((3, *depth.shape), np.float32)
    images = (np.ascontiguousarray(image, np.float32) for image in (depth, residuals[0], residuals[1], static))
    _weigh_image(*images, single(parameters), out)
    return out


@written_out
def normal_terms(wg, wc, gx, gy, gz, kx, ky, kz, r, rc, x, y, z):
    """A pixel's terms of the normal equations (thesis eq. 4.47).

    With J = [g, p x g] and A = w g g', the blocks of J' w J are A, M = A hat(p)' and N = hat(p) M.

    Args:
        wg, wc: Weights.
        gx, gy, gz: Gradient of the distance.
        kx, ky, kz: Gradient of the intensity, 1/m.
        r, rc: Residuals.
        x, y, z: Point about the camera's centre, world axes, metres.

    Returns:
        Upper triangle of A (6), M (9), upper triangle of N (6), b (6), row by row.
    """
    a00 = wg * gx * gx + wc * kx * kx
    a01 = wg * gx * gy + wc * kx * ky
    a02 = wg * gx * gz + wc * kx * kz
    a11 = wg * gy * gy + wc * ky * ky
    a12 = wg * gy * gz + wc * ky * kz
    a22 = wg * gz * gz + wc * kz * kz
    q0 = wg * gx * r + wc * kx * rc
    q1 = wg * gy * r + wc * ky * rc
    q2 = wg * gz * r + wc * kz * rc
    r00, r01, r02 = a02 * y - a01 * z, a00 * z - a02 * x, a01 * x - a00 * y
    r10, r11, r12 = a12 * y - a11 * z, a01 * z - a12 * x, a11 * x - a01 * y
    r20, r21, r22 = a22 * y - a12 * z, a02 * z - a22 * x, a12 * x - a02 * y
    return (
        a00, a01, a02, a11, a12, a22,
        r00, r01, r02, r10, r11, r12, r20, r21, r22,
        y * r20 - z * r10, y * r21 - z * r11, y * r22 - z * r12,
        z * r01 - x * r21, z * r02 - x * r22, x * r12 - y * r02,
        q0, q1, q2, y * q2 - z * q1, z * q0 - x * q2, x * q1 - y * q0,
    )  # fmt: skip
