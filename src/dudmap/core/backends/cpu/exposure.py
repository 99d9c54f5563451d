"""Robust fit of gain and offset between image and map intensities."""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.median import nth
from dudmap.core.backends.threads import scalar

LARGE_GAIN = 1.25
"""Larger gains, up or down, are changes of the light."""
FEWEST = 100
"""Fewest pixels of a fit."""
LOWEST, HIGHEST = 0.5 / 255, 254.5 / 255
"""Unsaturated intensities of 8 bits."""


@scalar
def fit_exposure(
    intensity: NDArray[np.float32],
    difference: NDArray[np.float32],
    weights: NDArray[np.float32],
    ceiling: float = HIGHEST,
) -> tuple[float, float]:
    """Gain and offset with ``gain * intensity + offset`` closest to the map's, robust, without saturated pixels.

    If median or contrast change by more than LARGE_GAIN, a second candidate comes from the quartiles, corrected by a
    second fit below LARGE_GAIN; the smaller median error wins.

    Args:
        intensity: (h, w) float32 of the image.
        difference: (h, w) float32 map minus image, NaN off the map.
        weights: (h, w) static weights.
        ceiling: Saturation of a channel.
    """
    h, w = intensity.shape
    used, count = np.empty(h * w, np.int32), 0
    for v in range(h):
        for u in range(w):
            if np.isfinite(difference[v, u]) and weights[v, u] > 0.5:
                used[count] = v * w + u
                count += 1
    if count < FEWEST:
        return 1.0, 0.0
    stride = max(1, count // 1000)  # a thousand pixels determine two numbers well
    x, y = np.empty(-(-count // stride)), np.empty(-(-count // stride))
    lit, x_lit, y_lit = 0, np.empty(len(x)), np.empty(len(x))
    for n in range(len(x)):
        v, u = used[n * stride] // w, used[n * stride] % w
        x[n] = intensity[v, u]
        y[n] = x[n] + difference[v, u]
        if LOWEST < x[n] < min(ceiling, HIGHEST) and LOWEST < y[n] < HIGHEST:
            x_lit[lit], y_lit[lit] = x[n], y[n]
            lit += 1
    if lit < FEWEST:
        return 1.0, nth(y, len(y) // 2) - nth(x, len(x) // 2)
    x, y = x_lit[:lit], y_lit[:lit]
    gain, offset = _fit(x, y)
    low, middle, high = lit // 4, lit // 2, 3 * lit // 4
    brightening = gain + offset / max(nth(x, middle), LOWEST)
    if 1 / LARGE_GAIN < min(gain, brightening) and max(gain, brightening) < LARGE_GAIN:
        return gain, offset
    other = (nth(y, high) - nth(y, low)) / max(nth(x, high) - nth(x, low), LOWEST)
    beyond = nth(y, middle) - other * nth(x, middle)
    change, shift = _fit(other * x + beyond, y)
    if 1 / LARGE_GAIN < change < LARGE_GAIN:
        other, beyond = change * other, change * beyond + shift
    better = nth(np.abs(y - other * x - beyond), middle) < nth(np.abs(y - gain * x - offset), middle)
    return (other, beyond) if better else (gain, offset)


@scalar
def _fit(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    middle, count = len(x) // 2, len(x)
    errors = y - x
    gain, offset = 1.0, nth(errors, middle)
    for _ in range(3):  # iteratively reweighted least squares, Cauchy weights
        for n in range(count):
            errors[n] = abs(y[n] - gain * x[n] - offset)
        scale = max(1.5 * nth(errors, middle), 0.01)
        total = x_sum = y_sum = 0.0
        for n in range(count):
            errors[n] = 1 / (1 + (errors[n] / scale) ** 2)  # now the weight
            total += errors[n]
            x_sum += errors[n] * x[n]
            y_sum += errors[n] * y[n]
        x_mean, y_mean = x_sum / total, y_sum / total
        # prior of the gain at 1: equals a tenth of the pixels at a contrast of 0.2
        variance = covariance = 0.1 * total * 0.04
        for n in range(count):
            variance += errors[n] * (x[n] - x_mean) ** 2
            covariance += errors[n] * (x[n] - x_mean) * (y[n] - y_mean)
        gain = min(max(covariance / variance, 0.5), 2.0)
        offset = y_mean - gain * x_mean
    return gain, offset
