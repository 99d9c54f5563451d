"""Corners and their sparse optical flow between two images (Lucas and Kanade 1981)."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.threads import bands, run_bands
from dudmap.core.frames.observation import Level

Number = TypeVar("Number", np.float32, np.float64)
CELLS = 40
"""Corners across the image: the strongest of each cell."""
SIMILAR = 1.5
"""A match is as good as another if the mean grey difference of its windows is at most this multiple of the other's."""
WINDOW = 11
"""Edge of the window that a corner is matched by, pixels of an image 320 wide."""
RETURN_PX = 0.5
"""Largest error of a corner that is tracked forward and back, pixels of an image 320 wide."""
FEWEST = 128
"""Fewest pixels whose flow is worth another thread."""
FLOW_WIDTH = 320
"""Image width that these distances are given for; they grow in proportion to the width of an image."""


def grey(level: Level) -> NDArray[np.uint8]:
    """Intensities (h, w) in grey values from 0 to 255."""
    return np.clip(255 * level.intensity, 0, 255).astype(np.uint8)


def scaled_window(edge: int, width: int, reference_width: int = FLOW_WIDTH) -> int:
    """Odd edge of a window in an image of some width that shows as much as one of an odd edge at a reference width."""
    return 2 * round((edge - 1) / 2 * width / reference_width) + 1


def lengths(vectors: NDArray[Number]) -> NDArray[Number]:
    """Lengths (n,) of vectors (n, 2)."""
    squares = vectors * vectors
    return np.sqrt(squares[:, 0] + squares[:, 1])


def corners(level: Level, image: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Strongest corners (n, 2) int, pixels u, v, one per cell of an image (Shi and Tomasi 1994).

    A corner has a depth reading and lies on the nearest surface in its window: a window across a depth edge follows the
    foreground, not the surface behind it.
    """
    import cv2

    strength = cv2.cornerMinEigenVal(image, 5)
    cell = max(1, image.shape[1] // CELLS)
    height, width = image.shape[0] // cell, image.shape[1] // cell
    tiles = strength[: height * cell, : width * cell].reshape(height, cell, width, cell).swapaxes(1, 2)
    tiles = tiles.reshape(height * width, cell * cell)
    strongest = tiles.argmax(axis=1)
    rows = np.arange(height * width) // width * cell + strongest // cell
    columns = np.arange(height * width) % width * cell + strongest % cell
    z = level.depth[rows, columns]
    window = scaled_window(WINDOW, image.shape[1])
    nearest = cv2.erode(np.where(level.depth > 0, level.depth, np.float32(np.inf)), np.ones((window, window), np.uint8))
    useful = (tiles.max(axis=1) > 1e-4) & (z > 0) & (np.asarray(nearest)[rows, columns] > np.float32(0.93) * z)
    return np.stack([columns, rows], axis=1)[useful]


def lucas_kanade(
    first: NDArray[np.uint8],
    second: NDArray[np.uint8],
    pixels: NDArray[np.number],
    guess: NDArray[np.number],
    window: int,
    halvings: int,
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32]]:
    """Pyramidal Lucas-Kanade flow of pixels (n, 2) u, v of the first image (h, w), searched from a guess (n, 2) with a
    window of so many pixels, in copies of the images halved up to ``halvings`` times before the images themselves.

    Returns:
        Positions (n, 2) in the second image, arbitrary where not found; whether each was found (n,); mean absolute
        difference (n,) of the grey values of the two windows.
    """
    import cv2

    if len(pixels) == 0:
        return np.empty((0, 2), np.float32), np.zeros(0, dtype=bool), np.empty(0, np.float32)
    positions, found, difference = cv2.calcOpticalFlowPyrLK(
        first,
        second,
        np.ascontiguousarray(pixels, np.float32),
        np.array(guess, np.float32, order="C"),  # a copy: it is overwritten with the result
        winSize=(window, window),
        maxLevel=halvings,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(positions, np.float32), found[:, 0] > 0, np.asarray(difference, np.float32)[:, 0]


def track_forward_backward(
    first: NDArray[np.uint8],
    second: NDArray[np.uint8],
    pixels: NDArray[np.integer],
    expected: NDArray[np.number],
    window: int,
    halvings: int,
    limit: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Pixels of an image that pass the forward-backward check: tracked back from where they were found in the images
    themselves, they return.

    Args:
        first, second: (h, w) uint8 images.
        pixels: (n, 2) int, pixels u, v of the first.
        expected: (n, 2) predicted positions in the second, from which the search starts.
        window, halvings: As of ``lucas_kanade``, of the search forward.
        limit: Smallest error of a pixel that does not return, pixels.

    Returns:
        Positions (n, 2) in the second image and the mean differences (n,) of the grey values of the windows, arbitrary
        for those that do not pass; whether each passes (n,).
    """
    n = len(pixels)

    def track(start: int, stop: int) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
        begin = pixels[start:stop]
        positions, found, difference = lucas_kanade(first, second, begin, expected[start:stop], window, halvings)
        back, found_back, _ = lucas_kanade(second, first, positions, begin, window, 0)
        return positions, difference, found & found_back & (lengths(back - begin.astype(np.float32)) < limit)

    parts = run_bands(track, bands(n, max(FEWEST, -(-n // 2))) or [(0, 0)])
    positions, difference, good = (np.concatenate(part) for part in zip(*parts, strict=True))
    return positions, difference, good


def consistent_with_static(
    first: NDArray[np.uint8],
    second: NDArray[np.uint8],
    pixels: NDArray[np.int64],
    expected: NDArray[np.float64],
    allowed: NDArray[np.float64],
    difference: NDArray[np.floating],
) -> NDArray[np.bool_]:
    """Whether corners (n,) that were found elsewhere match as well at the position of a static point.

    The coarse levels of the search see more than the window and may follow a nearer surface, and textures repeat.
    Therefore the search is repeated from the position of a static point, at full resolution alone.

    ``expected`` (n, 2) are these positions, ``allowed`` (n,) the largest distances of a match from there, pixels, and
    ``difference`` (n,) those of ``lucas_kanade`` for the matches found elsewhere.
    """
    guess = expected.astype(np.float32)
    positions, static, other = lucas_kanade(first, second, pixels, guess, scaled_window(WINDOW, first.shape[1]), 0)
    near = lengths((positions - guess)[static]) < allowed[static]
    static[static] = near & (other[static] <= SIMILAR * difference[static])
    return static
