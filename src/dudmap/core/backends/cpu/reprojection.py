"""Reprojection of an image into older ones of the same camera: what they have at its points."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.threads import bands, kernel, run_bands

NEAREST = np.float32(0.05)
"""Points nearer to the camera plane than this, or behind it, are not projected, metres."""
LEAST_WEIGHT = np.float32(0.25)
"""Least sum of the bilinear weights of the pixels with a reading: a quarter, the weight of each at equal distance."""


class ReprojectionTarget(NamedTuple):
    """An older frame that an image is compared with.

    Attributes:
        T_target_camera: (4, 4), camera of the image to that of the older frame.
        depth, intensity: (h, w) float32; depth in metres, 0 = none.
        marks: (h, w) uint8.
    """

    T_target_camera: NDArray[np.float64]
    depth: NDArray[np.float32]
    intensity: NDArray[np.float32]
    marks: NDArray[np.uint8]


class Reprojection(NamedTuple):
    """Difference of an image to an older frame, at the pixels of the image.

    Attributes:
        gap: (h, w) float32, metres: older reading minus depth of this image's point in the older camera, the smallest
            in magnitude among the four readings around its projection; NaN where there is none.
        difference: (h, w) float32, older minus this intensity, NaN likewise.
        marks: (h, w) uint8, mark of that reading, 0 where the point projects outside of the older frame.
    """

    gap: NDArray[np.float32]
    difference: NDArray[np.float32]
    marks: NDArray[np.uint8]


def reproject(
    depth: NDArray[np.float32],
    intensity: NDArray[np.float32],
    intrinsics: NDArray[np.float32],
    targets: Sequence[ReprojectionTarget],
) -> list[Reprojection]:
    """Differences of an image to older frames of the same camera, one for each.

    Args:
        depth, intensity: (h, w) float32; depth in metres, 0 = none.
        intrinsics: (4,) float32 fx, fy, cx, cy.
        targets: The older frames.
    """

    def reproject_into(n: int, _: int) -> Reprojection:
        target, shape = targets[n], depth.shape
        out = Reprojection(np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.uint8))
        T = target.T_target_camera[:3].astype(np.float32)
        reproject_difference(depth, intensity, intrinsics, T, target.depth, target.intensity, target.marks, *out)
        return out

    return [reproject_into(0, 1)] if len(targets) == 1 else run_bands(reproject_into, bands(len(targets), 1))


@kernel
def reproject_difference(
    depth, intensity, intrinsics, T, old_depth, old_intensity, old_marks, gap, difference, marks
):  # fmt: skip
    """Loop of ``reproject``: ``T`` is (3, 4) float32, the last three arguments are written."""
    h, w = depth.shape
    zero, one, nan, far = np.float32(0), np.float32(1), np.float32(np.nan), np.float32(1e9)
    by_fx, by_fy = one / intrinsics[0], one / intrinsics[1]
    first = np.empty(w, np.int32)  # index of the upper left of the four older pixels around the point
    projected = np.empty((4, w), np.float32)  # position between the four (2), depth in the older camera, inside
    readings, old_greys = np.empty((4, w), np.float32), np.empty((4, w), np.float32)
    stored = np.empty((4, w), np.float32)
    last_u, last_v = np.float32(w - 1), np.float32(h - 1)
    flat_depth, flat_intensity, flat_marks = old_depth.reshape(-1), old_intensity.reshape(-1), old_marks.reshape(-1)
    for v in range(h):
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
