"""Labels of a frame and its masks: the mixture of its normalised residuals (thesis section 4.6, eq. 4.52-4.56)."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu import labeling
from dudmap.core.backends.cpu.evidence import MAX_RESIDUAL, MixtureRules, mixture_log_odds
from dudmap.core.dynamics.segments import Segmentation, pixel_scale, scaled_side
from dudmap.core.frames.observation import Level
from dudmap.core.map.volume import MapSample

START = 0.1, 1.0, 6.0
"""Initial prior of the dynamic density, and standard deviations, static and dynamic."""
PRIOR_BOUNDS = 0.02, 0.98
"""Bounds of the prior, so that its logarithm is finite."""
STATIC_BOUNDS = 0.5, 2.0
"""Bounds of the static standard deviation, which is 1 for an exact sensor model."""
SEPARATION = 3.0
"""Smallest ratio of the standard deviations, so that the components cannot swap."""

RULES = MixtureRules(30, START, PRIOR_BOUNDS, STATIC_BOUNDS, SEPARATION)


@dataclass(frozen=True)
class Mixture:
    """Half-normal densities of the normalised residual (eq. 4.52, 4.56), static and dynamic.

    Attributes:
        prior: Prior probabilities.
        sigma: Standard deviations.
    """

    prior: tuple[float, float]
    sigma: tuple[float, float]

    @property
    def coefficients(self) -> tuple[float, float]:
        """Offset and slope of the log odds static : dynamic over the squared residual."""
        (p_static, p_dynamic), (s, d) = self.prior, self.sigma
        return np.log(p_static / p_dynamic * d / s), 0.5 / d**2 - 0.5 / s**2

    def log_odds(self, residual: NDArray[np.floating]) -> NDArray[np.float32]:
        """Log odds static : dynamic of normalised residuals >= 0."""
        offset, slope = self.coefficients
        return mixture_log_odds.py_func(np.square(residual, dtype=np.float32), offset, np.float32(slope))

    def density(self, residual: NDArray[np.floating]) -> NDArray[np.float64]:
        """Densities (2, ...), priors included."""
        r = np.asarray(residual, dtype=np.float64)
        return np.stack(
            [
                p * np.sqrt(2 / np.pi) / s * np.exp(-0.5 * (r / s) ** 2)
                for p, s in zip(self.prior, self.sigma, strict=True)
            ]
        )


def fit_mixture(
    histogram: NDArray[np.integer], edges: NDArray[np.float64], iterations: int = RULES.iterations
) -> Mixture:
    """Expectation maximisation on a histogram of normalised residuals (eq. 4.52-4.56; Dempster et al. 1977).

    Args:
        histogram: (n,) counts.
        edges: (n + 1,) edges of the bins.
        iterations: Largest number of iterations.
    """
    centers = (edges[:-1] + edges[1:]) / 2
    prior, static, dynamic = labeling.fit_mixture(
        histogram.astype(np.float64), centers, iterations, START, PRIOR_BOUNDS, STATIC_BOUNDS, SEPARATION, MAX_RESIDUAL
    )
    return Mixture((1 - prior, prior), (static, dynamic))


@dataclass(frozen=True, eq=False)
class Labels:
    """Static and dynamic pixels of one frame, at label resolution.

    Attributes:
        static_probability: (h, w) float32 in [0, 1]; weights of the second registration.
        dynamic: (h, w) bool.
        mixture: The fitted densities; None for carried labels.
        histogram: (BINS,) counts of the normalised residuals; 0 for carried labels.
        sample: Distance, intensity difference and occupancy of the map at the pixels.
        segmentation: Surface segments.
        hidden: (h, w) bool, pixels without depth in front of known background; None if not examined.
    """

    static_probability: NDArray[np.float32]
    dynamic: NDArray[np.bool_]
    mixture: Mixture | None
    histogram: NDArray[np.int64]
    sample: MapSample
    segmentation: Segmentation | None = None
    hidden: NDArray[np.bool_] | None = None


SEAM = 1
"""Half width of seams along depth edges that fit no map, pixels at REFERENCE_WIDTH."""
CLOSING_RADIUS = 2
"""Half width of depth holes that belong to the dynamic region around them, pixels at REFERENCE_WIDTH."""


def opened_mask(mask: NDArray[np.bool_], level: Level) -> NDArray[np.bool_]:
    """Mask (h, w) without parts as thin as the seams along depth edges."""
    import cv2

    side = scaled_side(SEAM, level)
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((side, side), np.uint8)) > 0


def full_mask(labels: Labels, level: Level, depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Dynamic pixels (H, W) bool at full size, including depth holes within dynamic regions.

    ``level``: the labelled image. ``depth``: (H, W) float32, metres, 0 = none.
    """
    import cv2

    hidden = labels.hidden is not None and labels.hidden.any()
    if not (hidden or labels.dynamic.any()):
        return np.zeros(depth.shape, dtype=bool)
    element = elliptical_kernel(CLOSING_RADIUS * pixel_scale(level))
    low = cv2.morphologyEx(labels.dynamic.view(np.uint8), cv2.MORPH_CLOSE, element)
    low[(level.depth > 0) & ~labels.dynamic] = 0
    if labels.hidden is not None and hidden:
        low[_hidden_region(labels.hidden, labels.dynamic, level.depth)] = 1
    return full_size(low.view(np.bool_), level.depth, depth)


def _hidden_region(
    hidden: NDArray[np.bool_], dynamic: NDArray[np.bool_], depth: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Pixels without depth nearer to a hidden pixel than to a static measurement."""
    import cv2

    empty = depth <= 0
    seeds = (hidden, ~(empty | dynamic))
    near, far = (cv2.distanceTransform((~seed).astype(np.uint8), cv2.DIST_L2, 3) for seed in seeds)
    return empty & (near < far)


def full_size(low: NDArray[np.bool_], low_depth: NDArray[np.float32], depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Mask (h, w) of a pyramid level at full resolution (H, W); see ``labeling.upsample_labels``.

    Args:
        low: (h, w) bool.
        low_depth: (h, w) float32, metres, 0 = none.
        depth: (H, W) float32, metres, 0 = none.
    """
    halvings = round(math.log2(depth.shape[1] / low.shape[1]))
    return labeling.upsample_labels(low, low_depth, depth, 1 << halvings)


def grown_mask(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    """Mask (H, W) dilated by ``pixels``."""
    import cv2

    marks = mask.view(np.uint8)
    x, y, width, height = cv2.boundingRect(marks)
    if pixels == 0 or width == 0:
        return mask
    grown = np.zeros(mask.shape, np.uint8)
    around = np.s_[max(y - pixels, 0) : y + height + pixels, max(x - pixels, 0) : x + width + pixels]
    grown[around] = cv2.dilate(marks[around], elliptical_kernel(pixels))
    return grown.view(np.bool_)


@lru_cache(maxsize=16)
def elliptical_kernel(radius: float) -> NDArray[np.uint8]:
    """Elliptical structuring element of at least 3x3 pixels."""
    import cv2

    side = 2 * max(round(radius), 1) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)).astype(np.uint8)
