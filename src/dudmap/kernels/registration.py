"""One linearisation of the direct SDF and intensity registration (thesis eq. 4.27-4.47).

A row of pixels is worked through in three stages: vector arithmetic for addresses, scalar loads of eight voxels into
buffers, vector arithmetic for residuals and sums. No stage mixes loads with branches, so LLVM vectorises the first
and the last on every CPU.
"""

import numpy as np

from dudmap.kernels.neighbors import load_row
from dudmap.kernels.threads import kernel

NUM_SUMS = 32
"""21 of H, 6 of b, cost, pixels on the map, weight of all readings, weight of those on the map, weighted squares."""

SYMMETRIC = np.zeros((6, 6), dtype=np.intp)
"""Where the sums hold each element of H, its upper triangle row by row."""
SYMMETRIC[np.triu_indices(6)] = SYMMETRIC.T[np.triu_indices(6)] = np.arange(21)


@kernel
def linearize(
    row_start, row_stop, depth, intensity, weights, intrinsics, T, window, shape, geometry, parameters, residuals, sums
):
    """Add the normal equations of pixel rows ``row_start`` to ``row_stop`` to ``sums`` and write their residuals.

    Args:
        row_start, row_stop: Rows of the band.
        depth: (h, w) float32, metres, 0 = none.
        intensity: (h, w) float32 in [0, 1].
        weights: (h, w) float32 static weights in [0, 1].
        intrinsics: (4,) float32 fx, fy, cx, cy of this level.
        T: (3, 4) float32, camera to window lattice: voxel units, origin at the window's first voxel.
        window: (Wx * Wy * Wz,) int32 voxel slots, negative = no voxels.
        shape: (3,) int64 blocks of the window.
        geometry: (slots * 512,) int32 packed voxels.
        parameters: (12,) float32: voxel_size, sdf_unit, huber, tukey (0 = Huber), color weight, color Huber,
            sigma_base, sigma_scale, sigma at one metre, noise weighting (0 or 1), truncation, truncation_noise.
        residuals: (2, h, w) float32 out: signed distance (m) and intensity difference; NaN = not on the map.
        sums: (NUM_SUMS,) float64, see there. Twist (v, omega) about the camera's centre, world axes.
    """
    w = depth.shape[1]
    cells = np.empty(w, np.int32)
    voxels = np.empty(w, np.int32)
    crossing = np.empty(w, np.int32)
    lists = np.empty((2, w + 1), np.int32)
    places = np.empty(w, np.int64)
    corners = np.empty((w, 8), np.int64)
    pairs = np.empty((4, w), np.int64)
    words = pairs.view(np.int32)
    near_low, near_high, far_low, far_high = words[0], words[1], words[2], words[3]
    fx = np.empty(w, np.float32)
    fy = np.empty(w, np.float32)
    fz = np.empty(w, np.float32)
    px = np.empty(w, np.float32)
    py = np.empty(w, np.float32)
    pz = np.empty(w, np.float32)
    inside = np.empty(w, np.float32)

    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    voxel_size, unit, huber, tukey = parameters[0], parameters[1], parameters[2], parameters[3]
    color_weight, color_huber = parameters[4], parameters[5]
    sigma_base, sigma_scale, sigma_one, noisy = parameters[6], parameters[7], parameters[8], parameters[9]
    truncation, truncation_noise = parameters[10], parameters[11]
    by_unit = unit / voxel_size
    by_voxel = one / voxel_size
    by_255 = np.float32(1 / 255)
    by_fx, by_fy = one / intrinsics[0], one / intrinsics[1]
    cx, cy = intrinsics[2], intrinsics[3]
    use_tukey = tukey > zero
    by_tukey = one / tukey if use_tukey else one
    tukey_cost = tukey * tukey / np.float32(6)
    worst_color = min(np.float32(0.3), color_huber) * (np.float32(0.3) - half * min(np.float32(0.3), color_huber))
    last_x, last_y, last_z = np.int32(shape[0] * 8 - 2), np.int32(shape[1] * 8 - 2), np.int32(shape[2] * 8 - 2)
    size_y, size_z = shape[1], shape[2]
    t00, t01, t02, t03 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    t10, t11, t12, t13 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    t20, t21, t22, t23 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]

    for v in range(row_start, row_stop):
        row_y = (np.float32(v) - cy) * by_fy
        for u in range(w):
            z = depth[v, u]
            x = (np.float32(u) - cx) * by_fx * z
            y = row_y * z
            rx = t00 * x + t01 * y + t02 * z
            ry = t10 * x + t11 * y + t12 * z
            rz = t20 * x + t21 * y + t22 * z
            gx, gy, gz = rx + t03, ry + t13, rz + t23
            lx, ly, lz = np.floor(gx), np.floor(gy), np.floor(gz)
            jx, jy, jz = np.int32(lx), np.int32(ly), np.int32(lz)
            kx = min(max(jx, np.int32(0)), last_x)
            ky = min(max(jy, np.int32(0)), last_y)
            kz = min(max(jz, np.int32(0)), last_z)
            ok = (z > zero) & (jx == kx) & (jy == ky) & (jz == kz)
            cells[u] = np.int32(((kx >> 3) * size_y + (ky >> 3)) * size_z + (kz >> 3))
            voxels[u] = np.int32(((kx & 7) * 8 + (ky & 7)) * 8 + (kz & 7))
            crossing[u] = np.int32((((kx & 7) + 1) | ((ky & 7) + 1) | ((kz & 7) + 1)) >> 3)
            fx[u], fy[u], fz[u] = gx - lx, gy - ly, gz - lz
            px[u], py[u], pz[u] = rx * voxel_size, ry * voxel_size, rz * voxel_size
            inside[u] = one if ok else zero

        load_row(window, shape, geometry, cells, voxels, crossing, lists, places, corners, pairs)

        h00 = h01 = h02 = h11 = h12 = h22 = zero
        m00 = m01 = m02 = m10 = m11 = m12 = m20 = m21 = m22 = zero
        n00 = n01 = n02 = n11 = n12 = n22 = zero
        b0 = b1 = b2 = b3 = b4 = b5 = zero
        cost = on_map = readings = total_weight = chi = zero
        for u in range(w):
            c0, c1, c2, c3 = near_low[2 * u], near_low[2 * u + 1], near_high[2 * u], near_high[2 * u + 1]
            c4, c5, c6, c7 = far_low[2 * u], far_low[2 * u + 1], far_high[2 * u], far_high[2 * u + 1]
            ax, ay, az = fx[u], fy[u], fz[u]
            z = depth[v, u]
            low = min(
                min(min(c0 & 0xFF00, c1 & 0xFF00), min(c2 & 0xFF00, c3 & 0xFF00)),
                min(min(c4 & 0xFF00, c5 & 0xFF00), min(c6 & 0xFF00, c7 & 0xFF00)),
            )
            # signed distance, voxel units: value and gradient of the trilinear interpolation
            s0, s1 = np.float32(c0 >> 16), np.float32(c1 >> 16)
            s2, s3 = np.float32(c2 >> 16), np.float32(c3 >> 16)
            s4, s5 = np.float32(c4 >> 16), np.float32(c5 >> 16)
            s6, s7 = np.float32(c6 >> 16), np.float32(c7 >> 16)
            s01, s23 = s0 + (s1 - s0) * az, s2 + (s3 - s2) * az
            s45, s67 = s4 + (s5 - s4) * az, s6 + (s7 - s6) * az
            sl, sh = s01 + (s23 - s01) * ay, s45 + (s67 - s45) * ay
            r = (sl + (sh - sl) * ax) * unit
            gx = (sh - sl) * by_unit
            gy = ((s23 - s01) + ((s67 - s45) - (s23 - s01)) * ax) * by_unit
            d01, d23, d45, d67 = s1 - s0, s3 - s2, s5 - s4, s7 - s6
            dl, dh = d01 + (d23 - d01) * ay, d45 + (d67 - d45) * ay
            gz = (dl + (dh - dl) * ax) * by_unit
            # intensity 0..1, gradient per metre
            i0, i1 = np.float32(c0 & 0xFF), np.float32(c1 & 0xFF)
            i2, i3 = np.float32(c2 & 0xFF), np.float32(c3 & 0xFF)
            i4, i5 = np.float32(c4 & 0xFF), np.float32(c5 & 0xFF)
            i6, i7 = np.float32(c6 & 0xFF), np.float32(c7 & 0xFF)
            i01, i23 = i0 + (i1 - i0) * az, i2 + (i3 - i2) * az
            i45, i67 = i4 + (i5 - i4) * az, i6 + (i7 - i6) * az
            il, ih = i01 + (i23 - i01) * ay, i45 + (i67 - i45) * ay
            rc = (il + (ih - il) * ax) * by_255 - intensity[v, u]
            scale_c = by_255 * by_voxel
            kx_ = (ih - il) * scale_c
            ky_ = ((i23 - i01) + ((i67 - i45) - (i23 - i01)) * ax) * scale_c
            e01, e23, e45, e67 = i1 - i0, i3 - i2, i5 - i4, i7 - i6
            el, eh = e01 + (e23 - e01) * ay, e45 + (e67 - e45) * ay
            kz_ = (el + (eh - el) * ax) * scale_c

            sigma = sigma_base + sigma_scale * z * z
            gate = max(truncation, truncation_noise * sigma) * np.float32(0.95)
            scaled = min(sigma_one / max(sigma, np.float32(1e-6)), one)
            scale = noisy * scaled + (one - noisy)
            static = weights[v, u]
            known = (low > 0) & (inside[u] > zero)
            valid = known & (abs(r) < gate)
            residuals[0, v, u] = r if known else np.float32(np.nan)
            residuals[1, v, u] = rc if valid else np.float32(np.nan)

            rn = r * scale
            a = abs(rn)
            capped = min(a * by_tukey, one)
            inlier = one - capped * capped
            huber_weight = huber / max(a, huber)
            huber_cost = min(a, huber) * (a - half * min(a, huber))
            robust = inlier * inlier if use_tukey else huber_weight
            geometric_cost = tukey_cost * (one - inlier * inlier * inlier) if use_tukey else huber_cost
            gate_n = gate * scale
            worst = tukey_cost if use_tukey else min(gate_n, huber) * (gate_n - half * min(gate_n, huber))
            ac = abs(rc)
            color_robust = color_huber / max(ac, color_huber)
            color_cost = min(ac, color_huber) * (ac - half * min(ac, color_huber))

            used = static if valid else zero
            missing = static - used if z > zero else zero
            cost += used * (geometric_cost + color_weight * color_cost)
            cost += missing * (worst + color_weight * worst_color)
            on_map += one if valid else zero
            readings += static if z > zero else zero
            total_weight += used
            chi += used * robust * rn * rn

            wg = used * robust * scale * scale
            wc = used * color_robust * color_weight
            a00 = wg * gx * gx + wc * kx_ * kx_
            a01 = wg * gx * gy + wc * kx_ * ky_
            a02 = wg * gx * gz + wc * kx_ * kz_
            a11 = wg * gy * gy + wc * ky_ * ky_
            a12 = wg * gy * gz + wc * ky_ * kz_
            a22 = wg * gz * gz + wc * kz_ * kz_
            q0 = wg * gx * r + wc * kx_ * rc
            q1 = wg * gy * r + wc * ky_ * rc
            q2 = wg * gz * r + wc * kz_ * rc
            x, y, zz = px[u], py[u], pz[u]
            # J = [g, p x g]: with A = w g g', the blocks are A, M = A hat(p)' and N = hat(p) M
            h00 += a00
            h01 += a01
            h02 += a02
            h11 += a11
            h12 += a12
            h22 += a22
            r00, r01, r02 = a02 * y - a01 * zz, a00 * zz - a02 * x, a01 * x - a00 * y
            r10, r11, r12 = a12 * y - a11 * zz, a01 * zz - a12 * x, a11 * x - a01 * y
            r20, r21, r22 = a22 * y - a12 * zz, a02 * zz - a22 * x, a12 * x - a02 * y
            m00 += r00
            m01 += r01
            m02 += r02
            m10 += r10
            m11 += r11
            m12 += r12
            m20 += r20
            m21 += r21
            m22 += r22
            n00 += y * r20 - zz * r10
            n01 += y * r21 - zz * r11
            n02 += y * r22 - zz * r12
            n11 += zz * r01 - x * r21
            n12 += zz * r02 - x * r22
            n22 += x * r12 - y * r02
            b0 += q0
            b1 += q1
            b2 += q2
            b3 += y * q2 - zz * q1
            b4 += zz * q0 - x * q2
            b5 += x * q1 - y * q0

        sums[0] += h00
        sums[1] += h01
        sums[2] += h02
        sums[3] += m00
        sums[4] += m01
        sums[5] += m02
        sums[6] += h11
        sums[7] += h12
        sums[8] += m10
        sums[9] += m11
        sums[10] += m12
        sums[11] += h22
        sums[12] += m20
        sums[13] += m21
        sums[14] += m22
        sums[15] += n00
        sums[16] += n01
        sums[17] += n02
        sums[18] += n11
        sums[19] += n12
        sums[20] += n22
        sums[21] += b0
        sums[22] += b1
        sums[23] += b2
        sums[24] += b3
        sums[25] += b4
        sums[26] += b5
        sums[27] += cost
        sums[28] += on_map
        sums[29] += readings
        sums[30] += total_weight
        sums[31] += chi
