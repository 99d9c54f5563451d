"""Reprojection of an image into older ones of one camera, and their agreement."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.evidence import edge_tolerance, exact_sigma
from dudmap.core.backends.cpu.exposure import fit_exposure
from dudmap.core.backends.cpu.teams import NO_BAND, done, finish, first_band, run_team, take, wait_for_all
from dudmap.core.backends.median import nth
from dudmap.core.backends.threads import exact, kernel, scalar

NEAREST = np.float32(0.05)
"""Smallest depth of a projected point, metres."""
LEAST_WEIGHT = np.float32(0.25)
"""Smallest sum of bilinear weights of pixels with depth."""
PARTS = 2


class Reprojection(NamedTuple):
    """Differences to n older frames, at the image's pixels.

    Attributes:
        gap: (n, h, w) float32, metres: older depth minus depth of the point in the older camera, smallest of four
            pixels; NaN = none.
        difference: (n, h, w) float32, older minus this intensity; NaN = none.
        marks: (n, h, w) uint8, of the selected older pixel, 0 outside.
    """

    gap: NDArray[np.float32]
    difference: NDArray[np.float32]
    marks: NDArray[np.uint8]


def reproject(
    depth: NDArray[np.float32],
    intensity: NDArray[np.float32],
    intrinsics: NDArray[np.float32],
    Ts_older_camera: NDArray[np.float64],
    older: NDArray[np.float32],
    marks: NDArray[np.uint8],
) -> Reprojection:
    """Differences of an image to n older frames of the same camera.

    Args:
        depth, intensity: (h, w) float32; depth in metres, 0 = none.
        intrinsics: (4,) float32 fx, fy, cx, cy.
        Ts_older_camera: (n, 4, 4), image to older cameras.
        older: (n, 2, h, w) float32, depth and intensity.
        marks: (n, h, w) uint8.
    """
    shape, Ts = marks.shape, Ts_older_camera.astype(np.float32)
    gap, difference = np.empty((2, *shape), np.float32)
    out = Reprojection(gap, difference, np.empty(shape, np.uint8))
    run_team(reproject_all, PARTS * shape[0], depth, intensity, intrinsics, Ts, older, marks, *out)
    return out


@kernel
def reproject_all(leads, team, depth, intensity, intrinsics, Ts, older, old_marks, gap, difference, marks):
    """Loop of ``reproject`` for a team of threads (``teams.py``)."""
    num_bands = PARTS * len(older)
    band, _ = first_band(leads, team, 0, num_bands)
    while band != NO_BAND:
        n, part, h = band // PARTS, band % PARTS, len(depth)
        reproject_rows(
            part * h // PARTS, (part + 1) * h // PARTS, depth, intensity, intrinsics, Ts[n], older[n, 0], older[n, 1],
            old_marks[n], gap[n], difference[n], marks[n],
        )  # fmt: skip
        done(team)
        band, _ = take(team, num_bands)
    if leads:
        wait_for_all(team, num_bands)
        finish(team)


@scalar
def reproject_rows(
    start, stop, depth, intensity, intrinsics, T, old_depth, old_intensity, old_marks, gap, difference, marks
):  # fmt: skip
    """Differences of some rows to an older frame; ``T``: (4, 4) float32; the last three arguments are output."""
    h, w = depth.shape
    zero, one, nan, far = np.float32(0), np.float32(1), np.float32(np.nan), np.float32(1e9)
    by_fx, by_fy = one / intrinsics[0], one / intrinsics[1]
    first = np.empty(w, np.int32)  # index of the upper left of the four older pixels around the point
    projected = np.empty((4, w), np.float32)  # position between the four (2), depth in the older camera, inside
    readings, old_greys = np.empty((4, w), np.float32), np.empty((4, w), np.float32)
    stored = np.empty((4, w), np.float32)
    last_u, last_v = np.float32(w - 1), np.float32(h - 1)
    flat_depth, flat_intensity, flat_marks = old_depth.reshape(-1), old_intensity.reshape(-1), old_marks.reshape(-1)
    for v in range(start, stop):
        row_y = (np.float32(v) - intrinsics[3]) * by_fy
        row = depth[v]
        for u in range(w):
            z = row[u]
            x, y = (np.float32(u) - intrinsics[2]) * by_fx * z, row_y * z
            qx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            qy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            qz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            by_z = one / max(qz, NEAREST)
            pu = qx * by_z * intrinsics[0] + intrinsics[2]
            pv = qy * by_z * intrinsics[1] + intrinsics[3]
            fu, fv = np.floor(pu), np.floor(pv)
            ok = (z > zero) & (qz > NEAREST) & (fu >= zero) & (fv >= zero) & (fu < last_u) & (fv < last_v)
            first[u] = np.int32(fv * np.float32(w) + fu if ok else zero)
            projected[0, u], projected[1, u], projected[2, u], projected[3, u] = (
                pu - fu,
                pv - fv,
                qz,
                one if ok else zero,
            )
        for u in range(w):
            start = np.int64(first[u])
            for k in range(4):
                n = np.uintp(start + (k >> 1) * w + (k & 1))
                readings[k, u], old_greys[k, u] = flat_depth[n], flat_intensity[n]
                stored[k, u] = np.float32(flat_marks[n])
        for u in range(w):
            au, av, qz, inside = projected[0, u], projected[1, u], projected[2, u], projected[3, u]
            best, mark, grey, total = far, zero, zero, zero
            for k in range(4):
                reading = readings[k, u]
                part = (au if k & 1 else one - au) * (av if k >> 1 else one - av)
                part = part if reading > zero else zero
                grey += part * old_greys[k, u]
                total += part
                step = reading - qz if reading > zero else far
                nearer = abs(step) < abs(best)
                best = step if nearer else best
                mark = stored[k, u] if nearer else mark
            known = (inside > zero) & (total > LEAST_WEIGHT)
            gap[v, u] = best if known else nan
            difference[v, u] = grey / max(total, LEAST_WEIGHT) - intensity[v, u] if known else nan
            marks[v, u] = np.int32(mark if inside > zero else zero)


AGREEING_SIGMAS = 3 * np.sqrt(2)
"""Largest difference of two depths of one surface, standard deviations."""
ZERO, HALF = np.float32(0), np.float32(0.5)


@exact
def compare_images(depth, intensity, moving, gap, difference, marks, noise, fewest, ceilings):
    """Displacement between two images, and pixels of equal depth.

    Args:
        moving: (h, w) bool.
        gap, difference, marks: See ``Reprojection``; marks are moving pixels.
        noise: NoiseParameters, all float32.
        fewest: Pixels of the same static surface.
        ceilings: Saturation limits, this and older.

    Returns:
        - Displacement, see ``ImageConsistency.compare``, pixels; NaN with too few pixels.
        - Depths that agree within AGREEING_SIGMAS.
        - All depths.
        - Depths with depth in the older image.
    """
    h, w = depth.shape
    agreeing, readings, seen, count = 0, 0, 0, 0
    common, contrasts, errors = np.empty((h, w), np.bool_), np.empty(h * w, np.float32), np.empty(h * w, np.float32)
    for v in range(h):
        for u in range(w):
            z, step = depth[v, u], abs(gap[v, u])
            sigma = exact_sigma(z, noise.base, noise.scale)
            agreeing += step < AGREEING_SIGMAS * sigma
            readings += z != ZERO
            seen += np.isfinite(step)
            tolerance = edge_tolerance(sigma, z, noise.edge_sigmas, noise.edge_slope)
            common[v, u] = marks[v, u] == 0 and not moving[v, u] and step < tolerance
            count += common[v, u]
    if count < fewest:
        return np.nan, agreeing, readings, seen
    gain, offset = fit_exposure(intensity, difference, common, ceilings[0])
    slope, shift, count = np.float32(1 - gain), np.float32(offset), 0
    for v in range(h):
        for u in range(w):
            older = difference[v, u] + intensity[v, u]
            if common[v, u] and ZERO < intensity[v, u] < ceilings[0] and ZERO < older < ceilings[1]:
                down = intensity[min(v + 1, h - 1), u] - intensity[max(v - 1, 0), u]
                across = intensity[v, min(u + 1, w - 1)] - intensity[v, max(u - 1, 0)]
                down = HALF * down if 0 < v < h - 1 else down
                across = HALF * across if 0 < u < w - 1 else across
                contrasts[count] = np.sqrt(down * down + across * across)
                errors[count] = abs(difference[v, u] + slope * intensity[v, u] - shift)
                count += 1
    if count < fewest:
        return np.nan, agreeing, readings, seen
    contrast = gain * np.float64(nth(contrasts[:count], count // 2))
    error = np.float64(nth(errors[:count], count // 2))
    return (np.sqrt(2.0) * error / contrast if contrast > 0 else np.nan), agreeing, readings, seen
