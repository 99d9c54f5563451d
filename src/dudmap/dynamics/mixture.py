"""Mixture of two half-normal densities of the normalised residual (thesis section 4.6, eq. 4.52-4.56)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.kernels import labeling

BINS = 128
"""Bins of the histogram of normalised residuals."""
MAX_RESIDUAL = 16.0
"""Upper edge of the histogram, standard deviations of a reading; larger residuals count in the last bin."""
EDGES = np.linspace(0, MAX_RESIDUAL, BINS + 1)
"""Edges of its bins."""
START = 0.1, 1.0, 6.0
"""Prior of the dynamic density and standard deviations, static and dynamic, from which the EM starts."""
PRIOR_BOUNDS = 0.02, 0.98
"""Bounds of the prior of the dynamic density; they keep its logarithm finite."""
STATIC_BOUNDS = 0.5, 2.0
"""Bounds of the standard deviation of the static density, which is 1 where the sensor model is exact."""
SEPARATION = 3.0
"""Least ratio of the standard deviations, dynamic : static, so that the components cannot swap."""


@dataclass(frozen=True)
class Mixture:
    """Two half-normal densities of the normalised residual (eq. 4.52, 4.56), static and dynamic.

    Attributes:
        prior: Prior probabilities of both components.
        sigma: Their standard deviations.
    """

    prior: tuple[float, float]
    sigma: tuple[float, float]

    def log_odds(self, residual: NDArray[np.floating]) -> NDArray[np.float32]:
        """Log odds static : dynamic of normalised residuals >= 0."""
        (p_static, p_dynamic), (s, d) = self.prior, self.sigma
        r2 = np.square(residual, dtype=np.float32)
        return (np.log(p_static / p_dynamic * d / s) + r2 * np.float32(0.5 / d**2 - 0.5 / s**2)).astype(np.float32)

    def density(self, residual: NDArray[np.floating]) -> NDArray[np.float64]:
        """Densities (2, ...) of both components, priors included."""
        r = np.asarray(residual, dtype=np.float64)
        return np.stack(
            [
                p * np.sqrt(2 / np.pi) / s * np.exp(-0.5 * (r / s) ** 2)
                for p, s in zip(self.prior, self.sigma, strict=True)
            ]
        )


def residual_histogram(residuals: NDArray[np.float32]) -> NDArray[np.int64]:
    """Histogram (BINS,) of normalised residuals (n,) >= 0 up to MAX_RESIDUAL."""
    bins = np.minimum(residuals, np.float32(MAX_RESIDUAL - 1e-3)) * np.float32(BINS / MAX_RESIDUAL)
    return np.bincount(bins.astype(np.int64), minlength=BINS)


def fit_mixture(histogram: NDArray[np.integer], edges: NDArray[np.float64], iterations: int = 30) -> Mixture:
    """Expectation maximisation on a histogram of normalised residuals (eq. 4.52-4.56; Dempster et al. 1977).

    Args:
        histogram: (n,) counts.
        edges: (n + 1,) edges of the bins.
        iterations: Most iterations.
    """
    centers = (edges[:-1] + edges[1:]) / 2
    prior, static, dynamic = labeling.fit_mixture(
        histogram.astype(np.float64), centers, iterations, START, PRIOR_BOUNDS, STATIC_BOUNDS, SEPARATION, MAX_RESIDUAL
    )
    return Mixture((1 - prior, prior), (static, dynamic))
