"""Depth smoothing (thesis section 4.3): zero pixels, then the bilateral filter."""

import cv2
import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.threads import bands, run_bands
from dudmap.thesis.kernels.bilateral import filter_rows

WINDOW = 5
"""Edge of the window whose mean replaces a zero, pixels (section 4.3)."""
ROWS = 60
"""Rows that one thread filters."""


def fill_zeros(D: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth (H, W) with each zero replaced by the mean of its 5x5 window, if any.

    Reading: the mean is over valid pixels, because zeros are missing.
    """
    valid = (D > 0).astype(np.float32)
    total, count = (
        cv2.boxFilter(image, -1, (WINDOW, WINDOW), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for image in (D, valid)
    )
    return np.where((D == 0) & (count > 0), total / np.maximum(count, 1), D).astype(np.float32)


def bilateral(D: NDArray[np.float32], alpha: float, sigma_s: float, radius: int) -> NDArray[np.float32]:
    """Depth-adaptive bilateral filter (eq. 4.8-4.11) of a depth image (H, W), metres, 0 = no measurement.

    D^(u) = 1/W sum_k w_s(u - u_k) w_c(D(u) - D(u_k)) D(u_k), with sigma_c = alpha D(u)^2.

    Reading: eq. 4.8 has D(u) before the sum, and is then the identity; the sum is over D(u_k).

    Args:
        alpha: 1/m.
        sigma_s: Pixels.
        radius: Half width of N(u_k), pixels.
    """
    out, padded = np.empty_like(D), np.pad(D, radius)
    run_bands(lambda start, stop: filter_rows(start, stop, padded, alpha, sigma_s, radius, out), bands(len(D), ROWS))
    return out
