"""Corners followed from one image to another (Lucas and Kanade 1981)."""

import numpy as np
from numpy.typing import NDArray

from dudmap.frames.observation import Level

CELLS = 40
"""Corners across the image: the strongest of each cell."""
ALIKE, ALIKE_GREY = 1.5, 2.0
"""A window that differs by less than this times another's difference, and this many of 255 grey values, is as good."""
WINDOW = 11
"""Edge of the window a corner is recognised by, pixels."""


def grey(level: Level) -> NDArray[np.uint8]:
    """Intensities (h, w) as the search takes them."""
    return np.clip(255 * level.intensity, 0, 255).astype(np.uint8)


def corners(level: Level, image: NDArray[np.uint8]) -> NDArray[np.int64]:
    """The strongest corner (n, 2) int of each cell of an image, where there is one, on a surface of some extent."""
    import cv2

    strength = cv2.cornerMinEigenVal(image, 5)
    cell = max(6, image.shape[1] // CELLS)
    height, width = image.shape[0] // cell, image.shape[1] // cell
    tiles = strength[: height * cell, : width * cell].reshape(height, cell, width, cell).swapaxes(1, 2)
    tiles = tiles.reshape(height * width, cell * cell)
    place = tiles.argmax(axis=1)
    rows = np.arange(height * width) // width * cell + place // cell
    columns = np.arange(height * width) % width * cell + place % cell
    # a window that also shows something nearer follows that, not the surface behind
    z = level.depth[rows, columns]
    nearest = cv2.erode(np.where(level.depth > 0, level.depth, np.float32(np.inf)), np.ones((WINDOW, WINDOW), np.uint8))
    useful = (tiles.max(axis=1) > 1e-4) & (z > 0) & (np.asarray(nearest)[rows, columns] > np.float32(0.93) * z)
    return np.stack([columns, rows], axis=1)[useful]


def track_forward_backward(
    first: NDArray[np.uint8],
    second: NDArray[np.uint8],
    pixels: NDArray[np.int64],
    expected: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Corners (m, 2) int, their places (m, 2) in a second image, found there and back, and what differs.

    The last is the mean difference (m,) of the grey values of their windows.

    Args:
        first, second: (h, w) uint8 images.
        pixels: (n, 2) int, corners in the first.
        expected: (n, 2) where they are looked for first.
    """
    import cv2

    if len(pixels) == 0:
        return pixels, np.empty((0, 2)), np.empty(0)
    start = pixels.astype(np.float32).reshape(-1, 1, 2)
    guess = expected.astype(np.float32).reshape(-1, 1, 2)
    size, flags = (WINDOW, WINDOW), cv2.OPTFLOW_USE_INITIAL_FLOW
    there, found, unlike = cv2.calcOpticalFlowPyrLK(first, second, start, guess, winSize=size, maxLevel=3, flags=flags)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(
        second, first, there, start.copy(), winSize=size, maxLevel=0, flags=flags
    )
    good = (found[:, 0] > 0) & (found_back[:, 0] > 0)
    good[good] = np.linalg.norm((back - start)[good, 0], axis=1) < 0.5
    return pixels[good], there[good, 0].astype(np.float64), unlike[good, 0].astype(np.float64)


def consistent_with_static(
    first: NDArray[np.uint8],
    second: NDArray[np.uint8],
    pixels: NDArray[np.int64],
    expected: NDArray[np.float64],
    allowed: NDArray[np.float64],
    unlike: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Corners (n,) that were found elsewhere, but could as well be where a static world would have put them.

    The coarse levels of the search see more than the window and follow what is nearer, and textures repeat. So the
    search is done once more, from the place of a static point on and at full size alone.

    Args:
        first, second: (h, w) uint8 images.
        pixels: (n, 2) int, corners in the first.
        expected: (n, 2) where they were if the world stood still.
        allowed: (n,) farthest from there that it still may, pixels.
        unlike: (n,) mean difference of the grey values of their windows where they were found.
    """
    import cv2

    if len(pixels) == 0:
        return np.zeros(0, dtype=bool)
    start = pixels.astype(np.float32).reshape(-1, 1, 2)
    guess = expected.astype(np.float32).reshape(-1, 1, 2)
    there, found, other = cv2.calcOpticalFlowPyrLK(
        first, second, start, guess.copy(), winSize=(WINDOW, WINDOW), maxLevel=0, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    rests = found[:, 0] > 0  # what was not found has arbitrary numbers
    near = np.linalg.norm((there - guess)[rests, 0], axis=1) < allowed[rests]
    rests[rests] = near & (other[rests, 0] < ALIKE * unlike[rests] + ALIKE_GREY)
    return rests
