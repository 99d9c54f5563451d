"""Sparse optical flow of pixels between two images (Lucas and Kanade 1981)."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.exposure import LARGE_GAIN, fit_exposure
from dudmap.core.backends.threads import bands, run_bands
from dudmap.core.frames.observation import WINDOW, Pyramid, exposed, scaled_window, shown_range

Number = TypeVar("Number", np.float32, np.float64)
SIMILAR = 1.5
"""Largest ratio of mean grey differences of equally good matches."""
RETURN_PX = 0.5
"""Largest forward-backward error of a corner, pixels of an image 320 wide."""
FEWEST = 128
"""Pixels for which another thread pays off."""


def lengths(vectors: NDArray[Number]) -> NDArray[Number]:
    """Lengths (n,) of vectors (n, 2)."""
    squares = vectors * vectors
    return np.sqrt(squares[:, 0] + squares[:, 1])


def equally_exposed(before: Pyramid, after: Pyramid) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Grey values (h, w) of two images for matching; after a change of light both have one exposure and the common
    range."""
    pair = [before, after]
    dark, bright = sorted(pair, key=lambda pyramid: float(pyramid.coarse.intensity.mean()))
    darker, brighter = dark.coarse.intensity, bright.coarse.intensity
    if brighter.mean() < LARGE_GAIN * darker.mean():
        return before.fine.grey, after.fine.grey
    seen = (brighter < bright.fine.ceiling).astype(np.float32)
    exposure = fit_exposure(darker, brighter - darker, seen, dark.fine.ceiling)
    low, high = shown_range(exposure, dark.fine.ceiling, bright.fine.ceiling)
    intensities = [exposed(p.fine, exposure).intensity if p is dark else p.fine.intensity for p in pair]
    first, second = (np.clip(255 * np.clip(i, low, high), 0, 255).astype(np.uint8) for i in intensities)
    return first, second


def lucas_kanade(
    first: NDArray[np.uint8],
    second: NDArray[np.uint8],
    pixels: NDArray[np.number],
    guess: NDArray[np.number],
    window: int,
    halvings: int,
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32]]:
    """Pyramidal Lucas-Kanade flow of pixels (n, 2) u, v of the first image (h, w).

    Args:
        first, second: (h, w) uint8 images.
        pixels: (n, 2), u, v in the first image.
        guess: (n, 2) initial positions in the second image.
        window: Edge of the window, pixels.
        halvings: Halvings to the coarsest level.

    Returns:
        Positions (n, 2), arbitrary if not found; found (n,); mean absolute grey difference (n,) of the windows.
    """
    import cv2

    if len(pixels) == 0:
        return np.empty((0, 2), np.float32), np.zeros(0, dtype=bool), np.empty(0, np.float32)
    positions, found, difference = cv2.calcOpticalFlowPyrLK(
        first,
        second,
        np.ascontiguousarray(pixels, np.float32),
        np.array(guess, np.float32, order="C"),  # a copy, because it is overwritten with the result
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
    """Track pixels into a second image, with the forward-backward check at full resolution.

    Args:
        first, second: (h, w) uint8 images.
        pixels: (n, 2) int, u, v in the first image.
        expected: (n, 2) initial positions in the second image.
        window, halvings: See ``lucas_kanade``.
        limit: Forward-backward error, pixels.

    Returns:
        Positions (n, 2) and mean grey differences (n,), arbitrary for failed pixels; whether each passes (n,).
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
    """Whether corners (n,) found elsewhere match as well at the static position, because coarse levels may follow a
    nearer surface.

    Args:
        first, second: (h, w) uint8 images.
        pixels: (n, 2) corners in the first image.
        expected: (n, 2) positions of static points in the second image.
        allowed: (n,) largest distances of a match, pixels.
        difference: (n,) grey differences of the found matches.
    """
    guess = expected.astype(np.float32)
    positions, static, other = lucas_kanade(first, second, pixels, guess, scaled_window(WINDOW, first.shape[1]), 0)
    near = lengths((positions - guess)[static]) < allowed[static]
    static[static] = near & (other[static] <= SIMILAR * difference[static])
    return static
