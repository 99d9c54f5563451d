"""Robust fit of gain and offset between the intensities of an image and those of the map."""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.median import nth
from dudmap.core.backends.threads import scalar

LARGE_GAIN, MORE_ROUNDS, MAX_GAIN = 1.25, 3, 4.0
"""A gain above this is fitted again, at most so often, and grows no further beyond the last."""


@scalar
def fit_exposure(
    intensity: NDArray[np.float32], difference: NDArray[np.float32], weights: NDArray[np.float32]
) -> tuple[float, float]:
    """Gain and offset with ``gain * intensity + offset`` closest to the map's intensities, by a robust fit.

    Auto-exposure changes all intensities at once; without this model such a change would look like motion. The prior of
    the gain outweighs the low contrast of an image that is suddenly dark, so a large gain is applied and fitted again.
    A small one is not: it is also what an image gives that shows something else.

    Args:
        intensity: (h, w) float32 of the image.
        difference: (h, w) float32 map minus image, NaN off the map.
        weights: (h, w) static weights.
    """
    h, w = intensity.shape
    used, count = np.empty(h * w, np.int32), 0
    for v in range(h):
        for u in range(w):
            if np.isfinite(difference[v, u]) and weights[v, u] > 0.5:
                used[count] = v * w + u
                count += 1
    if count < 100:
        return 1.0, 0.0
    stride = max(1, count // 1000)  # a thousand pixels determine two numbers well
    x, y = np.empty(-(-count // stride)), np.empty(-(-count // stride))
    for n in range(len(x)):
        v, u = used[n * stride] // w, used[n * stride] % w
        x[n] = intensity[v, u]
        y[n] = x[n] + difference[v, u]
    gain, offset = 1.0, 0.0
    for _ in range(1 + MORE_ROUNDS):
        change, shift = _fit(gain * x + offset, y)
        gain, offset = change * gain, change * offset + shift
        if change < LARGE_GAIN or gain > MAX_GAIN / change:
            break
    return gain, offset


@scalar
def _fit(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """One robust fit of ``gain * x + offset`` to y (n,), with a prior of the gain at 1."""
    middle, count = len(x) // 2, len(x)
    errors = y - x
    gain, offset = 1.0, nth(errors, middle)
    for _ in range(3):  # iteratively reweighted least squares, Cauchy weights
        for n in range(count):
            errors[n] = abs(y[n] - gain * x[n] - offset)
        scale = max(1.5 * nth(errors, middle), 0.01)
        total = x_sum = y_sum = 0.0
        for n in range(count):
            errors[n] = 1 / (1 + (errors[n] / scale) ** 2)  # the weight from here on
            total += errors[n]
            x_sum += errors[n] * x[n]
            y_sum += errors[n] * y[n]
        x_mean, y_mean = x_sum / total, y_sum / total
        # prior of the gain at 1: worth a tenth of the pixels at a contrast of 0.2
        variance = covariance = 0.1 * total * 0.04
        for n in range(count):
            variance += errors[n] * (x[n] - x_mean) ** 2
            covariance += errors[n] * (x[n] - x_mean) * (y[n] - y_mean)
        gain = min(max(covariance / variance, 0.5), 2.0)
        offset = y_mean - gain * x_mean
    return gain, offset
