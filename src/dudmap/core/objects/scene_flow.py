"""Displacement of moving objects between two images, by optical flow and depth."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.median import median
from dudmap.core.frames.observation import scaled_window
from dudmap.core.frames.optical_flow import track_forward_backward

PAIRED_PIXELS = 60
"""Number of pixels of an object that are tracked into the last frame."""
FEWEST_PIXELS = 15
"""Smallest number of matched pixels that determine the displacement of an object."""
WINDOW = 9
"""Edge of the matching window, pixels of an image WINDOW_WIDTH wide."""
RETURN_PX = 0.5
"""Largest forward-backward error of a tracked pixel, pixels of an image WINDOW_WIDTH wide."""
WINDOW_WIDTH = 160
"""Default width of the label image."""


@dataclass(frozen=True, eq=False)
class InstanceFrame:
    """Moving pixels of a frame.

    ``grey``: image (h, w). ``ids``: object (h, w) in each pixel, 0 = none. ``points``: (h, w, 3) float32, metres, world
    frame, 0 at static pixels.
    """

    timestamp: float
    grey: NDArray[np.uint8]
    ids: NDArray[np.int32]
    points: NDArray[np.float32]


def displacements(
    last: InstanceFrame, now: InstanceFrame, known: Collection[int], max_jump: float
) -> dict[int, NDArray[np.float64]]:
    """Median displacement (3,) of each object's pixels, matched by forward-backward optical flow: metres, world frame.

    It contains the ``known`` objects with enough matched pixels in both frames. Displacements beyond ``max_jump``
    metres are mismatches.
    """
    import cv2

    ids = now.ids.astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    inner = (now.ids > 0) & (cv2.erode(ids, kernel) == cv2.dilate(ids, kernel))
    flat = np.flatnonzero(inner)
    number = now.ids.reshape(-1)[flat]
    chosen = [
        of[:: max(1, len(of) // PAIRED_PIXELS)]
        for of in (flat[number == i] for i in sorted(known))
        if len(of) >= FEWEST_PIXELS
    ]
    if not chosen:
        return {}
    flat = np.concatenate(chosen)
    h, w = now.ids.shape
    v_now, u_now = np.divmod(flat, w)
    pixels = np.stack([u_now, v_now], axis=1)
    window = scaled_window(WINDOW, w, WINDOW_WIDTH)
    limit = RETURN_PX * w / WINDOW_WIDTH
    matches, _, good = track_forward_backward(now.grey, last.grey, pixels, pixels, window, 2, limit)
    u, v = np.rint(matches).astype(np.int64).T
    good &= (u >= 0) & (v >= 0) & (u < w) & (v < h)
    number = now.ids[v_now, u_now]
    good[good] = last.ids[v[good], u[good]] == number[good]
    displacement = now.points[v_now[good], u_now[good]] - _interpolated(last.points, last.ids, matches[good])
    number = number[good]
    plausible = np.linalg.norm(displacement, axis=1) < max_jump  # false for NaN: several objects nearby
    displacement, number = displacement[plausible], number[plausible]
    return {
        i: median(displacement[number == i]).astype(np.float64)
        for i in sorted(known)
        if np.count_nonzero(number == i) >= FEWEST_PIXELS
    }


def _interpolated(
    points: NDArray[np.float32], ids: NDArray[np.int32], pixels: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Bilinearly interpolated points (n, 3) at pixels (n, 2); NaN if the four pixels show several objects."""
    h, w = points.shape[:2]
    u0 = np.clip(np.floor(pixels[:, 0]).astype(np.int64), 0, w - 2)
    v0 = np.clip(np.floor(pixels[:, 1]).astype(np.int64), 0, h - 2)
    du, dv = (pixels - np.stack([u0, v0], axis=1)).T[:, :, None]
    corners = points[v0, u0], points[v0, u0 + 1], points[v0 + 1, u0], points[v0 + 1, u0 + 1]
    owners = ids[v0, u0], ids[v0, u0 + 1], ids[v0 + 1, u0], ids[v0 + 1, u0 + 1]
    out = (1 - dv) * ((1 - du) * corners[0] + du * corners[1]) + dv * ((1 - du) * corners[2] + du * corners[3])
    out[(owners[0] != owners[1]) | (owners[0] != owners[2]) | (owners[0] != owners[3])] = np.nan
    return out
