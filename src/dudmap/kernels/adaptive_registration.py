"""Registration and samples of a map with several voxel sizes: as in ``registration.py``, by the finest voxels.

Finer voxels are read within one coarsest voxel of the surface; farther off, where their narrower band ends, the
coarsest level has the distance.
"""

import numpy as np
from numpy.typing import NDArray

from dudmap.kernels.cpu import PIXELS_PER_BAND
from dudmap.kernels.finest import corners_at, finest_at, least_weight
from dudmap.kernels.neighbors import load_row
from dudmap.kernels.parameters import MapSample, NormalEquations, RegistrationParameters, VoxelGrid, single
from dudmap.kernels.pixel import elements, ray, rotate, transform
from dudmap.kernels.registration import NUM_SUMS, normal_equations
from dudmap.kernels.residual import normal_terms, trilinear, weigh
from dudmap.kernels.threads import bands, kernel, run_bands
from dudmap.kernels.voxel import intensity_of, sdf_steps

f32 = np.float32


@kernel
def _interpolated(corners, ax, ay, az):
    """Signed distance in stored steps between eight voxels."""
    value, _, _, _ = trilinear(
        sdf_steps(corners[0, 0]), sdf_steps(corners[1, 0]), sdf_steps(corners[2, 0]), sdf_steps(corners[3, 0]),
        sdf_steps(corners[4, 0]), sdf_steps(corners[5, 0]), sdf_steps(corners[6, 0]), sdf_steps(corners[7, 0]),
        ax, ay, az,
    )  # fmt: skip
    return value


@kernel
def near_surface(window, shape, tree, voxels, x, y, z, near, corners):
    """Finest level of which all eight voxels around a lattice point are known and that is near its surface; 0 = none.

    Args:
        window, shape: Of the coarsest level.
        tree, voxels: As of ``linearize_finest_rows``.
        x, y, z: Point, coarsest voxels.
        near: Distance from the surface that is near, stored steps.
        corners: (8, 1) int32 out, the words of the eight voxels if the level is not 0.

    Returns:
        Level, and place between the voxels in [0, 1).
    """
    level = finest_at(window, shape, tree[0], tree[1], x, y, z)
    while level > 0:
        ax, ay, az = corners_at(
            level, window, shape, tree[0], tree[1], voxels[0], voxels[1], voxels[2], x, y, z, corners
        )
        if least_weight(corners) > 0 and abs(_interpolated(corners, ax, ay, az)) < near:
            return level, ax, ay, az
        level -= 1
    return 0, f32(0), f32(0), f32(0)


@kernel
def linearize_finest_rows(
    row_start, row_stop, depth, intensity, weights, intrinsics, T, window, shape, tree, voxels, voxel_size, sdf_unit,
    parameters, residuals, sums,
):  # fmt: skip
    """``registration.linearize_rows`` by the finest voxels near the surface.

    Args:
        tree: Slots of the children by slot, of two levels, (slots, 8) int32 each.
        voxels: Packed voxels of three levels: (slots * 512,), (slots, 512) and (slots, 512) int32.

    The others are those of ``linearize_rows``, of the coarsest level.
    """
    geometry = voxels[0]
    w = depth.shape[1]
    cells = np.empty(w, np.int32)
    local = np.empty(w, np.int32)
    crossing = np.empty(w, np.int32)
    lists = np.empty((2, w + 1), np.int32)
    positions = np.empty(w, np.int64)
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
    places = np.empty((3, w), np.float32)
    finer = np.empty(w, np.float32)
    found = np.empty((8, 1), np.int32)

    zero, one = np.float32(0), np.float32(1)
    by_unit = sdf_unit / voxel_size
    by_voxel = one / voxel_size
    by_255 = np.float32(1 / 255)
    by_fx, by_fy = one / intrinsics[0], one / intrinsics[1]
    cx, cy = intrinsics[2], intrinsics[3]
    last_x, last_y, last_z = np.int32(shape[0] * 8 - 2), np.int32(shape[1] * 8 - 2), np.int32(shape[2] * 8 - 2)
    size_y, size_z = shape[1], shape[2]
    t = elements(T)
    near = voxel_size / sdf_unit

    for v in range(row_start, row_stop):
        row_y = (np.float32(v) - cy) * by_fy
        for u in range(w):
            z = depth[v, u]
            x = (np.float32(u) - cx) * by_fx * z
            y = row_y * z
            rx, ry, rz = rotate(t, x, y, z)
            gx, gy, gz = rx + t[3], ry + t[7], rz + t[11]
            lx, ly, lz = np.floor(gx), np.floor(gy), np.floor(gz)
            jx, jy, jz = np.int32(lx), np.int32(ly), np.int32(lz)
            kx = min(max(jx, np.int32(0)), last_x)
            ky = min(max(jy, np.int32(0)), last_y)
            kz = min(max(jz, np.int32(0)), last_z)
            ok = (z > zero) & (jx == kx) & (jy == ky) & (jz == kz)
            cells[u] = np.int32(((kx >> 3) * size_y + (ky >> 3)) * size_z + (kz >> 3))
            local[u] = np.int32(((kx & 7) * 8 + (ky & 7)) * 8 + (kz & 7))
            crossing[u] = np.int32((((kx & 7) + 1) | ((ky & 7) + 1) | ((kz & 7) + 1)) >> 3)
            fx[u], fy[u], fz[u] = gx - lx, gy - ly, gz - lz
            px[u], py[u], pz[u] = rx * voxel_size, ry * voxel_size, rz * voxel_size
            inside[u] = one if ok else zero
            places[0, u], places[1, u], places[2, u] = gx, gy, gz

        load_row(window, shape, geometry, cells, local, crossing, lists, positions, corners, pairs)
        for u in range(w):
            finer[u] = one
            if inside[u] == zero:
                continue
            level, fx_, fy_, fz_ = near_surface(
                window, shape, tree, voxels, places[0, u], places[1, u], places[2, u], near, found
            )
            if level > 0:
                finer[u] = np.float32(1 << level)
                fx[u], fy[u], fz[u] = fx_, fy_, fz_
                for m in range(4):
                    words[m, 2 * u], words[m, 2 * u + 1] = found[2 * m, 0], found[2 * m + 1, 0]

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
            distance, gx, gy, gz = trilinear(
                sdf_steps(c0), sdf_steps(c1), sdf_steps(c2), sdf_steps(c3),
                sdf_steps(c4), sdf_steps(c5), sdf_steps(c6), sdf_steps(c7), ax, ay, az,
            )  # fmt: skip
            r = distance * sdf_unit
            scale = finer[u]
            gx, gy, gz = gx * by_unit * scale, gy * by_unit * scale, gz * by_unit * scale
            # intensity in 0..1 and its gradient per metre
            i0, i1, i2, i3 = intensity_of(c0), intensity_of(c1), intensity_of(c2), intensity_of(c3)
            i4, i5, i6, i7 = intensity_of(c4), intensity_of(c5), intensity_of(c6), intensity_of(c7)
            darkest = min(min(min(i0, i1), min(i2, i3)), min(min(i4, i5), min(i6, i7)))
            shade, kx_, ky_, kz_ = trilinear(i0, i1, i2, i3, i4, i5, i6, i7, ax, ay, az)
            rc = shade * by_255 - intensity[v, u]
            scale_c = by_255 * by_voxel * scale
            kx_, ky_, kz_ = kx_ * scale_c, ky_ * scale_c, kz_ * scale_c

            known = (low > 0) & (inside[u] > zero) & (darkest > zero)  # a corner in the air is not part of a surface
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
def refine_sample_rows(
    row_start, row_stop, depth, intensity, intrinsics, T, window, shape, tree, voxels, sdf_unit, voxel_size,
    distance, difference,
):  # fmt: skip
    """Replace the distances and differences of a sample of the coarsest level where finer voxels are near the surface.

    Args:
        row_start, row_stop: Rows of the band.
        depth, intensity, intrinsics, T, window, shape, sdf_unit, voxel_size: As of ``sampling.sample_rows``.
        tree, voxels: As of ``linearize_finest_rows``.
        distance, difference: (h, w) float32, in and out.
    """
    corners = np.empty((8, 1), np.int32)
    t = elements(T)
    near = voxel_size / sdf_unit
    for v in range(row_start, row_stop):
        for u in range(depth.shape[1]):
            z = depth[v, u]
            if z <= 0 or not np.isfinite(distance[v, u]):
                continue
            x, y = ray(u, intrinsics[2], intrinsics[0]) * z, ray(v, intrinsics[3], intrinsics[1]) * z
            gx, gy, gz = transform(t, x, y, z)
            level, ax, ay, az = near_surface(window, shape, tree, voxels, gx, gy, gz, near, corners)
            if level == 0:
                continue
            distance[v, u] = _interpolated(corners, ax, ay, az) * sdf_unit
            darkest = f32(255)
            for m in range(8):
                darkest = min(darkest, intensity_of(corners[m, 0]))
            if darkest > f32(0):
                shade, _, _, _ = trilinear(
                    intensity_of(corners[0, 0]), intensity_of(corners[1, 0]), intensity_of(corners[2, 0]),
                    intensity_of(corners[3, 0]), intensity_of(corners[4, 0]), intensity_of(corners[5, 0]),
                    intensity_of(corners[6, 0]), intensity_of(corners[7, 0]), ax, ay, az,
                )  # fmt: skip
                difference[v, u] = shade / f32(255) - intensity[v, u]


def linearize(
    grid: VoxelGrid,
    tree: tuple[NDArray[np.int32], ...],
    finer: tuple[NDArray[np.int32], ...],
    depth: NDArray[np.float32],
    intensity: NDArray[np.float32],
    weights: NDArray[np.float32],
    intrinsics: NDArray[np.float32],
    T_grid_camera: NDArray[np.float32],
    parameters: RegistrationParameters,
) -> NormalEquations:
    """Normal equations by the finest voxels; see ``Backend.linearize``.

    Args:
        grid: The coarsest level.
        tree: Two arrays (slots, 8) int32, see ``finest.py``.
        finer: Packed voxels (slots, 512) int32 of two finer levels.
        depth, intensity, weights, intrinsics, T_grid_camera, parameters: As of ``Backend.linearize``.
    """
    grid = grid.on_host()
    height, width = depth.shape
    ranges = bands(height, -(-PIXELS_PER_BAND // width))
    sums = np.zeros((len(ranges), NUM_SUMS))
    residuals = np.empty((2, height, width), dtype=np.float32)
    p, voxels = single(parameters), (np.asarray(grid.geometry).reshape(-1), *finer)
    voxel_size, sdf_unit = f32(grid.voxel_size), f32(grid.sdf_unit)
    run_bands(
        lambda start, stop, out: linearize_finest_rows(
            start, stop, depth, intensity, weights, intrinsics, T_grid_camera, grid.window, grid.shape, tree, voxels,
            voxel_size, sdf_unit, p, residuals, out,
        ),
        ranges, list(sums),
    )  # fmt: skip
    return normal_equations(sums.sum(axis=0), residuals)


def refine_sample(
    sample: MapSample,
    grid: VoxelGrid,
    tree: tuple[NDArray[np.int32], ...],
    finer: tuple[NDArray[np.int32], ...],
    depth: NDArray[np.float32],
    intensity: NDArray[np.float32],
    intrinsics: NDArray[np.float32],
    T_grid_camera: NDArray[np.float32],
) -> None:
    """Replace distances and differences of a sample of the coarsest level by those of finer voxels near the surface.

    Arguments as of ``linearize``.
    """
    grid = grid.on_host()
    voxels = (np.asarray(grid.geometry).reshape(-1), *finer)
    run_bands(
        lambda start, stop: refine_sample_rows(
            start, stop, depth, intensity, intrinsics, T_grid_camera, grid.window, grid.shape, tree, voxels,
            f32(grid.sdf_unit), f32(grid.voxel_size), sample.distance, sample.difference,
        ),
        bands(depth.shape[0], max(8, -(-depth.shape[0] // 8))),
    )  # fmt: skip
