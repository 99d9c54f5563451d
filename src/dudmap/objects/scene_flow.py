"""How far bodies went between two images, by their pixels."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.kernels.median import median

PAIRED_PIXELS = 60
"""Pixels of a body that are looked for in the last frame."""
FEWEST_PIXELS = 15
"""Pixels with a known motion that make a velocity."""
WINDOW = 9
"""Width of the patch that is looked for, pixels."""


@dataclass(frozen=True, eq=False)
class Seen:
    """The moving pixels of a frame.

    Attributes:
        timestamp: Seconds.
        grey: (h, w) uint8.
        ids: (h, w) int32, whose each pixel is, 0 = nobody's.
        points: (h, w, 3) float32, metres, world frame, 0 where nothing moves.
    """

    timestamp: float
    grey: NDArray[np.uint8]
    ids: NDArray[np.int32]
    points: NDArray[np.float32]


def displacements(last: Seen, now: Seen, known: Collection[int], max_jump: float) -> dict[int, NDArray[np.float64]]:
    """Median displacement (3,) of each body's pixels, paired by optical flow there and back (Lucas and Kanade 1981).

    Args:
        last, now: Two frames, of one size.
        known: Numbers of the bodies that are in both.
        max_jump: Pairs that are farther apart than this are wrong, metres.

    Returns:
        Metres, world frame, by number; only where enough pixels can be paired.
    """
    import cv2

    ids = now.ids.astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    inner = (now.ids > 0) & (cv2.erode(ids, kernel) == cv2.dilate(ids, kernel))
    flat = np.flatnonzero(inner)
    number = now.ids.reshape(-1)[flat]
    chosen = [
        of[:: max(1, len(of) // PAIRED_PIXELS)]
        for of in (flat[number == i] for i in np.unique(number) if int(i) in known)
        if len(of) >= FEWEST_PIXELS
    ]
    if not chosen:
        return {}
    flat = np.concatenate(chosen)
    h, w = now.ids.shape
    v_now, u_now = np.divmod(flat, w)
    here = np.stack([u_now, v_now], axis=1).astype(np.float32)
    then, found = _flow(now.grey, last.grey, here)
    back, again = _flow(last.grey, now.grey, then)
    u, v = np.rint(then).astype(np.int64).T
    good = found & again & (np.abs(back - here).max(axis=1) < 0.5)
    good &= (u >= 0) & (v >= 0) & (u < w) & (v < h)
    number = now.ids[v_now, u_now]
    good[good] = last.ids[v[good], u[good]] == number[good]
    way = now.points[v_now[good], u_now[good]] - _between(last.points, last.ids, then[good])
    number = number[good]
    near = np.linalg.norm(way, axis=1) < max_jump  # NaN where the pixels around are another's
    way, number = way[near], number[near]
    return {
        int(i): median(way[number == i]).astype(np.float64)
        for i in np.unique(number)
        if np.count_nonzero(number == i) >= FEWEST_PIXELS
    }


def _flow(
    image: NDArray[np.uint8], other: NDArray[np.uint8], pixels: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Places (n, 2) in another image that look like those in this one, and (n,) whether they were found."""
    import cv2

    there = pixels.copy(order="C")
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        image, other, pixels, there, winSize=(WINDOW, WINDOW), maxLevel=2, minEigThreshold=1e-4
    )
    return np.asarray(there, dtype=np.float32), np.asarray(found)[:, 0] > 0


def _between(points: NDArray[np.float32], ids: NDArray[np.int32], pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Points (n, 3) of an image (h, w, 3) at places (n, 2) between its pixels, NaN where those are not one body's."""
    h, w = points.shape[:2]
    u0 = np.clip(np.floor(pixels[:, 0]).astype(np.int64), 0, w - 2)
    v0 = np.clip(np.floor(pixels[:, 1]).astype(np.int64), 0, h - 2)
    du, dv = (pixels - np.stack([u0, v0], axis=1)).T[:, :, None]
    corners = points[v0, u0], points[v0, u0 + 1], points[v0 + 1, u0], points[v0 + 1, u0 + 1]
    owners = ids[v0, u0], ids[v0, u0 + 1], ids[v0 + 1, u0], ids[v0 + 1, u0 + 1]
    between = (1 - dv) * ((1 - du) * corners[0] + du * corners[1]) + dv * ((1 - du) * corners[2] + du * corners[3])
    between[(owners[0] != owners[1]) | (owners[0] != owners[2]) | (owners[0] != owners[3])] = np.nan
    return between
