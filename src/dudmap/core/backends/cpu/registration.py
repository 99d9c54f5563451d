"""Direct SDF and intensity registration (thesis eq. 4.27-4.47): a linearisation, and a level's descent.

Rows are processed in stages: addresses, loads of eight voxels into buffers, residuals and sums. LLVM vectorises the
first and last, free of loads and branches.
"""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.neighbors import AHEAD, last_corner, load_row, locate
from dudmap.core.backends.cpu.teams import NO_BAND, announce, done, finish, take, wait_for_all, wait_for_work
from dudmap.core.backends.cpu.vectors import wide_vectors
from dudmap.core.backends.parameters import BLOCK, ImageStack, NormalEquations
from dudmap.core.backends.threads import kernel, scalar
from dudmap.core.formulas.damping import accelerated, damped_step, judged, moved
from dudmap.core.formulas.pixel import elements, rotate
from dudmap.core.formulas.residual import normal_terms, trilinear, weigh, within_range
from dudmap.core.formulas.voxel import intensity_of, sdf_steps

NUM_SUMS = 32
"""Sums of a linearisation: 21 of H, 6 of b, cost, pixels on the map, weight of all pixels with depth, weight on the
map, weighted squared distances."""

SYMMETRIC = np.zeros((6, 6), dtype=np.intp)
"""Index of each element of H among the sums (upper triangle by rows)."""
SYMMETRIC[np.triu_indices(6)] = SYMMETRIC.T[np.triu_indices(6)] = np.arange(21)

COST = 27


@scalar
def write_lattice(T, voxel_size, origin, out):
    """Write ``to_lattice`` of a pose (4, 4) by elements; an array assignment compiles for a second."""
    for i in range(3):
        for j in range(4):
            shift = np.float64(origin[i] * BLOCK) if j == 3 else np.float64(0)
            out[i, j] = np.float32(T[i, j] / voxel_size - shift)


@scalar
def linearize_rows(
    row_start, row_stop, depth, intensity, weights, intrinsics, T, window, shape, geometry, voxel_size, sdf_unit,
    parameters, residuals, sums,
):  # fmt: skip
    """Add the normal equations of pixel rows to ``sums`` and write residuals.

    Args:
        depth, intensity, weights, intrinsics: See ``LevelImage``.
        T: (3, 4) float32, camera to the window's lattice, see ``to_lattice``.
        window, shape, geometry, voxel_size, sdf_unit: See ``VoxelGrid``; ``geometry`` is flat.
        parameters: RegistrationParameters.
        residuals: (2, h, w) float32 out: signed distance (m), intensity difference; NaN off the map or without weight.
        sums: (NUM_SUMS,) float64 in and out. Twist (v, omega) about the camera's centre, world axes.
    """
    wide_vectors()
    w = depth.shape[1]
    cells, voxels, crossing = np.zeros(w + AHEAD, np.int32), np.zeros(w + AHEAD, np.int32), np.empty(w, np.int32)
    outer, words = np.empty(w, np.int32), np.empty((8, -(-w // 8) * 8), np.int32)
    fx = np.empty(w, np.float32)
    fy = np.empty(w, np.float32)
    fz = np.empty(w, np.float32)
    px = np.empty(w, np.float32)
    py = np.empty(w, np.float32)
    pz = np.empty(w, np.float32)
    wanted = np.empty(w, np.uint8)

    zero, one = np.float32(0), np.float32(1)
    by_unit = sdf_unit / voxel_size
    by_voxel = one / voxel_size
    by_255 = np.float32(1 / 255)
    by_fx, by_fy = one / intrinsics[0], one / intrinsics[1]
    cx, cy = intrinsics[2], intrinsics[3]
    last, size_y, size_z = last_corner(shape), shape[1], shape[2]
    t = elements(T)

    for v in range(row_start, row_stop):
        row_y = (np.float32(v) - cy) * by_fy
        for u in range(w):
            z = depth[v, u]
            x = (np.float32(u) - cx) * by_fx * z
            y = row_y * z
            rx, ry, rz = rotate(t, x, y, z)
            gx, gy, gz = rx + t[3], ry + t[7], rz + t[11]
            cells[u], voxels[u], crosses, within, fx[u], fy[u], fz[u] = locate(gx, gy, gz, last, size_y, size_z)
            ok = within & (z > zero) & (weights[v, u] > zero)
            crossing[u] = crosses if ok else np.int32(0)
            px[u], py[u], pz[u] = rx * voxel_size, ry * voxel_size, rz * voxel_size
            wanted[u] = ok

        load_row(window, shape, geometry, cells, voxels, crossing, outer, words)

        h00 = h01 = h02 = h11 = h12 = h22 = zero
        m00 = m01 = m02 = m10 = m11 = m12 = m20 = m21 = m22 = zero
        n00 = n01 = n02 = n11 = n12 = n22 = zero
        b0 = b1 = b2 = b3 = b4 = b5 = zero
        cost = on_map = readings = total_weight = chi = zero
        for u in range(w):
            c0, c1, c2, c3 = words[0, u], words[1, u], words[2, u], words[3, u]
            c4, c5, c6, c7 = words[4, u], words[5, u], words[6, u], words[7, u]
            ax, ay, az = fx[u], fy[u], fz[u]
            z = depth[v, u]
            low = min(
                min(min(c0 & 0xFF00, c1 & 0xFF00), min(c2 & 0xFF00, c3 & 0xFF00)),
                min(min(c4 & 0xFF00, c5 & 0xFF00), min(c6 & 0xFF00, c7 & 0xFF00)),
            )
            distance, gx, gy, gz = trilinear(
                sdf_steps(c0), sdf_steps(c1), sdf_steps(c2), sdf_steps(c3),
                sdf_steps(c4), sdf_steps(c5), sdf_steps(c6), sdf_steps(c7), ax, ay, az,
            )  # fmt: skip
            r = distance * sdf_unit
            gx, gy, gz = gx * by_unit, gy * by_unit, gz * by_unit
            # intensity in 0..1 and its gradient per metre
            i0, i1, i2, i3 = intensity_of(c0), intensity_of(c1), intensity_of(c2), intensity_of(c3)
            i4, i5, i6, i7 = intensity_of(c4), intensity_of(c5), intensity_of(c6), intensity_of(c7)
            darkest = min(min(min(i0, i1), min(i2, i3)), min(min(i4, i5), min(i6, i7)))
            shade, kx_, ky_, kz_ = trilinear(i0, i1, i2, i3, i4, i5, i6, i7, ax, ay, az)
            scale_c = by_255 * by_voxel
            kx_, ky_, kz_ = kx_ * scale_c, ky_ * scale_c, kz_ * scale_c
            rc, kx_, ky_, kz_ = within_range(shade * by_255, kx_, ky_, kz_, intensity[v, u], parameters)

            known = (low > 0) & (wanted[u] > 0) & (darkest > zero)  # a corner in the air is not part of a surface
            valid, used, paid, forfeit, square, wg, wc = weigh(r, rc, z, weights[v, u], known, parameters)
            residuals[0, v, u] = r if known else np.float32(np.nan)
            residuals[1, v, u] = rc if valid else np.float32(np.nan)
            cost += paid
            cost += forfeit
            on_map += one if valid else zero
            readings += weights[v, u] if z > zero else zero
            total_weight += used
            chi += square
            terms = normal_terms(wg, wc, gx, gy, gz, kx_, ky_, kz_, r, rc, px[u], py[u], pz[u])
            h00 += terms[0]
            h01 += terms[1]
            h02 += terms[2]
            h11 += terms[3]
            h12 += terms[4]
            h22 += terms[5]
            m00 += terms[6]
            m01 += terms[7]
            m02 += terms[8]
            m10 += terms[9]
            m11 += terms[10]
            m12 += terms[11]
            m20 += terms[12]
            m21 += terms[13]
            m22 += terms[14]
            n00 += terms[15]
            n01 += terms[16]
            n02 += terms[17]
            n11 += terms[18]
            n12 += terms[19]
            n22 += terms[20]
            b0 += terms[21]
            b1 += terms[22]
            b2 += terms[23]
            b3 += terms[24]
            b4 += terms[25]
            b5 += terms[26]

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


@kernel
def descend(
    leads, team, rows, depth, intensity, weights, intrinsics, window, shape, origin, geometry, voxel_size, sdf_unit,
    parameters, T_first, is_known, first, rules, poses, buffers, residuals, sums,
):  # fmt: skip
    """Levenberg-Marquardt steps of a level (the loop of ``descent.py``), for a team of threads.

    Args:
        leads, team: See ``run_team``; a step is a linearisation.
        rows: Image rows of a band.
        depth, intensity, weights, intrinsics, window, shape, geometry, parameters: As for ``linearize_rows``.
        origin: (3,) int64 first block.
        voxel_size, sdf_unit: Float64.
        T_first: (4, 4) camera to world.
        is_known: Whether ``first`` holds the sums at this pose.
        first: (NUM_SUMS,) float64, changed.
        rules: DescentRules.
        poses: (limit + 1, 3, 4) float32 out, lattice pose of each linearisation.
        buffers: (limit + 1,) int64 out, buffer of each linearisation.
        residuals: (2, 2, h, w) float32 out, two buffers.
        sums: (2, bands, NUM_SUMS) float64 out, two buffers.

    Returns:
        The last accepted pose (4, 4), its sums (NUM_SUMS,), its buffer (-1 for known sums at the first pose),
        linearisations, and whether a stop criterion was met.
    """
    wide_vectors()
    num_bands, height = sums.shape[1], depth.shape[0]
    unit, step_size = np.float32(voxel_size), np.float32(sdf_unit)
    T, accepted, T_trial = T_first, first, T_first
    kept, count, settled, damping, length = -1, 0, False, rules.damping, np.inf
    last, taken, step, plain, follows = np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(6), False
    while True:
        if leads:
            if count > 0 or is_known:
                if count - (0 if is_known else 1) >= rules.max_steps:
                    break
                H, largest = np.empty((6, 6)), np.float64(0)
                for i in range(6):
                    for j in range(6):
                        H[i, j] = accepted[SYMMETRIC[i, j]]
                    largest = max(largest, H[i, i])
                if not largest > 0:
                    break
                plain = damped_step(H, accepted[21:27], rules.basis, damping)
                step = accelerated(plain, last, taken) if follows else plain
                T_trial, length = moved(T, step), np.sqrt(np.sum(step * step))
                if length < rules.stop:  # too short to need another linearisation
                    T, settled = T_trial, True
                    break
            write_lattice(T_trial, voxel_size, origin, poses[count])
            buffers[count] = 1 if kept == 0 else 0
            announce(team, count)
            band, number = take(team, num_bands)
        else:
            band, number = wait_for_work(team, num_bands)
            if band == NO_BAND:
                break
        while band != NO_BAND:
            buffer = buffers[number]
            out = sums[buffer, band]
            out[:] = 0
            linearize_rows(
                band * rows, min(band * rows + rows, height), depth, intensity, weights, intrinsics, poses[number],
                window, shape, geometry, unit, step_size, parameters, residuals[buffer], out,
            )  # fmt: skip
            done(team)
            band, number = take(team, num_bands)
        if leads:
            wait_for_all(team, num_bands)
            buffer = buffers[count]
            total = np.zeros(NUM_SUMS)
            for band in range(num_bands):
                total += sums[buffer, band]
            count += 1
            if count == 1 and not is_known:
                accepted, kept = total, buffer
                continue
            change = np.float64(0)  # from the mean of the gradients before and after the step
            for i in range(6):
                change += (accepted[21 + i] + total[21 + i]) / 2 * step[i]
            better, damping, settled = judged(change, accepted[COST], length, damping, rules)
            if better:
                T, accepted, kept = T_trial, total, buffer
            last, taken, follows = plain, step, better
            if settled:
                break
    if leads:
        finish(team)
    return T, accepted, kept, count, settled


def normal_equations(sums: NDArray[np.float64], residuals: ImageStack) -> NormalEquations:
    """The normal equations from the sums (NUM_SUMS,) of all pixels."""
    cost, num_inliers, readings, weight, chi_square = sums[COST:].tolist()
    return NormalEquations(
        sums[SYMMETRIC], sums[21:27], cost, int(num_inliers), readings, weight, chi_square, residuals
    )
